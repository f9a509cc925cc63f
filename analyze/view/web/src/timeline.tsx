/** Below the pictures: events, curves, and the replan that is shown. Everything is clicked. */
import { computed } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";

import type { Grid } from "./answers";
import { about, events, groups, layerPlace, layout, main, massesAt, numReplans, part, pickedKeys, playing, replan, setPart } from "./state";
import { range, sumOf } from "./sums";

interface Curve {
  readonly name: string;
  readonly values: readonly (number | null)[];
}

interface Curves {
  readonly steps: readonly number[];
  readonly curves: readonly Curve[];
}

const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#f0e442"];
const column = (grid: Grid | undefined): (number | null)[] => (grid ?? []).map((line) => line[layerPlace(groups.value.value!)] ?? null);

/** What can be drawn: of replans the ratio, masses, the own group; of steps the hand, the gripper and the actions. */
function kinds(): Record<string, { title: string; of: () => Curves | null }> {
  const episode = about.value.value;
  const [numbers, courses] = [groups.value.value, episode?.courses];
  const atReplans = (curves: Curve[]): Curves => ({ steps: episode?.starts ?? [], curves });
  const found: Record<string, { title: string; of: () => Curves | null }> = {};
  if (numbers?.ratio) found.ratio = { title: "ratio of pictures to text", of: () => atReplans([{ name: "ratio", values: column(numbers.ratio) }, { name: "if spread evenly", values: column(numbers.uniform_ratio) }]) };
  if (numbers) found.masses = { title: "parts of the attention", of: () => atReplans(Object.entries(numbers.groups).map(([name, { fraction }]) => ({ name, values: column(fraction) })).filter(({ values }) => values.some((one) => (one ?? 0) > 0.005))) };
  if (part("group")) found.group = { title: "own group", of: () => atReplans(["seen", "read"].map((side) => ({ name: side === "seen" ? "patches" : "words", values: range(numReplans.value).map((at) => (massesAt(at) ? sumOf(massesAt(at)!, pickedKeys({ scene: main, at })[side as "seen" | "read"]) : null)) })).filter(({ values }) => values.some(Boolean))) };
  if (courses) {
    const steps = range(courses.gap.length);
    found.hand = { title: "hand and gripper (cm)", of: () => ({ steps, curves: [{ name: "height of the hand", values: (courses.places[courses.hand] ?? []).map(([, , z]) => (z == null ? null : 100 * z)) }, { name: "gap between the fingers", values: courses.gap.map((one) => (one === null ? null : 100 * one)) }] }) };
    found.actions = { title: "executed actions", of: () => ({ steps: range(courses.executed.length), curves: range(courses.executed[0]?.length ?? 0).map((i) => ({ name: `action ${i}`, values: courses.executed.map((line) => line[i] ?? null) })) }) };
  } else if (episode?.actions) {
    found.actions = { title: "first action of each call", of: () => atReplans(range(episode.actions![0]?.[0]?.length ?? 0).map((i) => ({ name: `action ${i}`, values: episode.actions!.map(([first]) => first?.[i] ?? null) }))) };
  }
  return found;
}

function replanOf(step: number): number {
  return Math.max(0, (about.value.value?.starts ?? []).filter((start) => start <= step).length - 1);
}

function Plot({ curves, title }: { curves: Curves; title: string }) {
  const host = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot | null>(null);
  const end = about.value.value?.end ?? 0;
  useEffect(() => {
    const place = host.current!;
    const css = getComputedStyle(place);
    const axis = { stroke: css.color, grid: { stroke: css.borderTopColor, width: 1 }, ticks: { show: false } };
    const made = new uPlot(
      {
        width: place.clientWidth, height: 130, cursor: { drag: { x: false, y: false }, y: false }, legend: { live: false },
        scales: { x: { time: false, range: [0, end] } },
        axes: [{ ...axis, size: 28, label: undefined }, { ...axis, size: 46 }],
        series: [{ label: "step" }, ...curves.curves.map(({ name }, i) => ({ label: name, stroke: COLOURS[i % COLOURS.length]!, width: 1.5, points: { show: false }, dash: i >= COLOURS.length ? [4, 3] : undefined }))],
        hooks: {
          draw: [(one) => {
            const x = one.valToPos(about.value.value?.starts[replan.peek()] ?? 0, "x", true);
            one.ctx.save();
            one.ctx.strokeStyle = css.color;
            one.ctx.lineWidth = 1.5 * devicePixelRatio;
            one.ctx.beginPath();
            one.ctx.moveTo(x, one.bbox.top);
            one.ctx.lineTo(x, one.bbox.top + one.bbox.height);
            one.ctx.stroke();
            one.ctx.restore();
          }],
        },
      },
      [curves.steps, ...curves.curves.map(({ values }) => values)] as uPlot.AlignedData,
      place,
    );
    made.over.addEventListener("click", (event) => setPart({ replan: replanOf(made.posToVal(event.offsetX, "x")) }));
    plot.current = made;
    const watch = new ResizeObserver(() => made.setSize({ width: place.clientWidth, height: 130 }));
    watch.observe(place);
    return () => {
      watch.disconnect();
      made.destroy();
    };
  }, [curves, end]);
  const at = replan.value;
  useEffect(() => plot.current?.redraw(false), [at]);
  return <div class="plot" ref={host} role="img" aria-label={title} />;
}

/** The same object until other numbers are drawn: a plot is made anew for each. */
const drawn = computed(() => {
  const known = kinds();
  const names = Object.keys(known);
  const chosen = names.includes(part("curve")) ? part("curve") : names[0];
  return { known, chosen, curves: chosen === undefined ? null : known[chosen]!.of() };
});

export function Timeline() {
  const episode = about.value.value;
  if (!episode || !layout.value) return null;
  const { known, chosen, curves } = drawn.value;
  const last = numReplans.value - 1;
  return (
    <section class="timeline" aria-label="Timeline">
      <div class="scrub">
        <button aria-label={playing.value ? "Pause" : "Play"} onClick={() => {
          if (!playing.value && replan.value === last) setPart({ replan: 0 });
          playing.value = !playing.value;
        }}>{playing.value ? "❚❚" : "▶"}</button>
        <input type="range" aria-label="Replan" min="0" max={last} value={replan.value} onInput={(event) => setPart({ replan: event.currentTarget.value })} />
        <output>step {episode.starts[replan.value]} of {episode.end}, call {replan.value} of 0 to {last}</output>
      </div>
      <ol class="events">
        {events.value.map((event) => (
          <li key={`${event.step}${event.text}`} class={event.kind}>
            <button onClick={() => setPart({ replan: event.replan })} aria-current={event.replan === replan.value}>
              <span class="soft">{event.step}</span> {event.text}
            </button>
          </li>
        ))}
      </ol>
      <label class="soft curve">
        <select value={chosen} onChange={(event) => setPart({ curve: event.currentTarget.value })} aria-label="Curve">
          {Object.entries(known).map(([name, { title }]) => <option value={name}>{title}</option>)}
        </select>
      </label>
      {curves ? <Plot curves={curves} title={known[chosen!]!.title} key={`${chosen}${episode.name}`} /> : null}
    </section>
  );
}
