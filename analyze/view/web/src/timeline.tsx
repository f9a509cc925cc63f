/** Below the pictures: events, curves, and the replan that is shown. Everything is clicked. */
import { computed } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";

import type { Grid, Groups } from "./answers";
import {
  about,
  end,
  eventsOf,
  goTo,
  layerPlace,
  layout,
  massesOf,
  moment,
  moments,
  nameOf,
  part,
  pickedKeys,
  playing,
  type Scene,
  type Side,
  setPart,
  sides,
} from "./state";
import { range, sumOf } from "./sums";

interface Curve {
  readonly name: string;
  /** Of a group, as in every figure; else one of `COLOURS`. */
  readonly color?: string;
  readonly values: readonly (number | null)[];
}

interface Curves {
  readonly steps: readonly number[];
  readonly curves: readonly Curve[];
}

const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#f0e442"];
const columnOf =
  (numbers: Groups) =>
  (grid: Grid | undefined): (number | null)[] =>
    (grid ?? []).map((line) => line[layerPlace(numbers)] ?? null);

/** What can be drawn of an episode: of replans the ratio, masses, the own group; of steps hand, gripper and actions. */
function kinds(scene: Scene): Record<string, { title: string; of: () => Curves }> {
  const episode = scene.about.value.value;
  const [numbers, courses] = [scene.groups.value.value, episode?.courses];
  const column = numbers ? columnOf(numbers) : () => [];
  const atReplans = (curves: Curve[]): Curves => ({ steps: episode?.starts ?? [], curves });
  const found: Record<string, { title: string; of: () => Curves }> = {};
  if (numbers?.ratio)
    found.ratio = {
      title: "ratio of pictures to text",
      of: () =>
        atReplans([
          { name: "ratio", values: column(numbers.ratio) },
          { name: "if spread evenly", values: column(numbers.uniform_ratio) },
        ]),
    };
  if (numbers)
    found.masses = {
      title: "parts of the attention",
      of: () =>
        atReplans(
          Object.entries(numbers.groups)
            .map(([name, { color, fraction }]) => ({ name, color, values: column(fraction) }))
            .filter(({ values }) => values.some((one) => (one ?? 0) > 0.005)),
        ),
    };
  if (part("group"))
    found.group = {
      title: "own group",
      of: () =>
        atReplans(
          ["seen", "read"]
            .map((side) => ({
              name: side === "seen" ? "patches" : "words",
              values: (episode?.starts ?? []).map((_, at) =>
                massesOf(scene, at) ? sumOf(massesOf(scene, at)!, pickedKeys({ scene, at })[side as "seen" | "read"]) : null,
              ),
            }))
            .filter(({ values }) => values.some(Boolean)),
        ),
    };
  if (courses) {
    const steps = range(courses.gap.length);
    found.hand = {
      title: "hand and gripper (cm)",
      of: () => ({
        steps,
        curves: [
          { name: "height of the hand", values: (courses.places[courses.hand] ?? []).map(([, , z]) => (z == null ? null : 100 * z)) },
          { name: "gap between the fingers", values: courses.gap.map((one) => (one === null ? null : 100 * one)) },
        ],
      }),
    };
    found.actions = {
      title: "executed actions",
      of: () => ({
        steps: range(courses.executed.length),
        curves: range(courses.executed[0]?.length ?? 0).map((i) => ({
          name: `action ${i}`,
          values: courses.executed.map((line) => line[i] ?? null),
        })),
      }),
    };
  } else if (episode?.actions) {
    found.actions = {
      title: "first action of each call",
      of: () =>
        atReplans(
          range(episode.actions![0]?.[0]?.length ?? 0).map((i) => ({
            name: `action ${i}`,
            values: episode.actions!.map(([first]) => first?.[i] ?? null),
          })),
        ),
    };
  }
  return found;
}

function Plot({ curves, title }: { curves: Curves; title: string }) {
  const host = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot | null>(null);
  const last = end.value;
  useEffect(() => {
    const place = host.current!;
    const css = getComputedStyle(place);
    const axis = { stroke: css.color, grid: { stroke: css.borderTopColor, width: 1 }, ticks: { show: false } };
    const made = new uPlot(
      {
        width: place.clientWidth,
        height: 130,
        cursor: { drag: { x: false, y: false }, y: false },
        legend: { live: false },
        scales: { x: { time: false, range: [0, last] } },
        axes: [
          { ...axis, size: 28, label: undefined },
          { ...axis, size: 46 },
        ],
        series: [
          { label: "step" },
          ...curves.curves.map(({ name, color }, i) => ({
            label: name,
            stroke: color ?? COLOURS[i % COLOURS.length]!,
            width: 1.5,
            points: { show: false },
            spanGaps: true,
            dash: (color ? i >= curves.curves.length / sides.value.length : i >= COLOURS.length) ? [4, 3] : undefined,
          })),
        ],
        hooks: {
          draw: [
            (one) => {
              const x = one.valToPos(moment.peek(), "x", true);
              one.ctx.save();
              one.ctx.strokeStyle = css.color;
              one.ctx.lineWidth = 1.5 * devicePixelRatio;
              one.ctx.beginPath();
              one.ctx.moveTo(x, one.bbox.top);
              one.ctx.lineTo(x, one.bbox.top + one.bbox.height);
              one.ctx.stroke();
              one.ctx.restore();
            },
          ],
        },
      },
      [curves.steps, ...curves.curves.map(({ values }) => values)] as uPlot.AlignedData,
      place,
    );
    made.over.addEventListener("click", (event) => goTo(made.posToVal(event.offsetX, "x")));
    plot.current = made;
    const watch = new ResizeObserver(() => made.setSize({ width: place.clientWidth, height: 130 }));
    watch.observe(place);
    return () => {
      watch.disconnect();
      made.destroy();
    };
  }, [curves, last]);
  const at = moment.value;
  useEffect(() => plot.current?.redraw(false), [at]);
  return <div class="plot" ref={host} role="img" aria-label={title} />;
}

/** The curves of both episodes over one time line; those of one as they are. */
function together(each: readonly (readonly [Side, Curves])[]): Curves {
  if (each.length === 1) return each[0]![1];
  const tables = each.map(([, { steps, curves }]) => [steps, ...curves.map(({ values }) => values)] as uPlot.AlignedData);
  const [steps, ...values] = uPlot.join(tables);
  const all = each.flatMap(([side, { curves }]) => curves.map((curve) => ({ ...curve, name: `${nameOf(side)}: ${curve.name}` })));
  return { steps: [...steps], curves: all.map((curve, i) => ({ ...curve, values: [...values[i]!] as (number | null)[] })) };
}

/** The same object until other numbers are drawn: a plot is made anew for each. */
const drawn = computed(() => {
  const of = sides.value.map((side) => [side, kinds(side.scene)] as const);
  const known = of[0]![1];
  const names = Object.keys(known);
  const chosen = names.includes(part("curve")) ? part("curve") : names[0];
  const curves =
    chosen === undefined
      ? null
      : together(of.flatMap(([side, all]) => (Object.keys(all).includes(chosen) ? [[side, all[chosen]!.of()] as const] : [])));
  return { known, chosen, curves };
});

function Events({ side }: { side: Side }) {
  const name = nameOf(side);
  return (
    <ol class="events" aria-label={name ? `Events of ${name}` : "Events"}>
      {name ? <li class="soft">{name}:</li> : null}
      {eventsOf(side.scene).map((event) => (
        <li key={`${event.step}${event.text}`} class={event.kind}>
          <button onClick={() => goTo(event.step)} aria-current={event.replan === side.at}>
            <span class="soft">{event.step}</span> {event.text}
          </button>
        </li>
      ))}
    </ol>
  );
}

/** Which call of an episode is shown, and whether it has ended before. */
function callOf({ scene, at }: Side): string {
  const { starts, end: own } = scene.about.value.value!;
  return `call ${at} (0 to ${starts.length - 1})${moment.value >= own ? ", ended" : ""}`;
}

export function Timeline() {
  if (!about.value.value || !layout.value) return null;
  const { known, chosen, curves } = drawn.value;
  const [all, both] = [moments.value, sides.value.length > 1];
  const place = all.indexOf(moment.value);
  return (
    <section class="timeline" aria-label="Timeline">
      <div class="scrub">
        <button
          aria-label={playing.value ? "Pause" : "Play"}
          onClick={() => {
            if (!playing.value && place === all.length - 1) goTo(0);
            playing.value = !playing.value;
          }}
        >
          {playing.value ? "❚❚" : "▶"}
        </button>
        <input
          type="range"
          aria-label="Policy call"
          min="0"
          max={all.length - 1}
          value={place}
          onInput={(event) => goTo(all[Number(event.currentTarget.value)] ?? 0)}
        />
        <output>
          step {moment} of {end}, {sides.value.map((side) => `${both ? `${nameOf(side)}: ` : ""}${callOf(side)}`).join("; ")}
        </output>
      </div>
      {sides.value.map((side) => (
        <Events key={nameOf(side)} side={side} />
      ))}
      <label class="soft curve">
        <select value={chosen} onChange={(event) => setPart({ curve: event.currentTarget.value })} aria-label="Curve">
          {Object.entries(known).map(([name, { title }]) => (
            <option value={name}>{title}</option>
          ))}
        </select>
      </label>
      {curves ? <Plot curves={curves} title={known[chosen!]!.title} key={`${chosen}${about.value.value.name}`} /> : null}
    </section>
  );
}
