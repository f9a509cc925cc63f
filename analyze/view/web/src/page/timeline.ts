/** Ratio, masses and events over the episode's replans, with a cursor that can be dragged. */
import { element, svg } from "./dom";
import type { EpisodeEvent } from "./events";
import { formatNumber } from "./number_text";
import type { TimelineRow } from "./series";

export interface TimelineSeries {
  name: string;
  colour: string;
  values: readonly (number | null)[];
  unit: string;
  /** What uniform attention gives, as a broken line. */
  uniform?: readonly (number | null)[];
}

const HEIGHT = 64;
const LEFT = 46;
const RIGHT = 8;
const TOP = 16;
const EVENTS = 22;
/** Points of a line that are marked, so that two replans can be seen too. */
const MOST_MARKS = 60;

const finite = (value: number | null | undefined): value is number => typeof value === "number" && Number.isFinite(value);

export class Timeline {
  readonly host = element("div", { class: "timeline" });
  readonly #drawing = svg("svg", { class: "chart", role: "img" });
  readonly #table = element("details", { class: "as-table" }, element("summary", {}, "The same as a table"));
  readonly #extra = new Map<string, TimelineSeries>();
  readonly #own = new Map<string, TimelineRow>();
  #events: readonly EpisodeEvent[] = [];
  #steps: readonly number[] = [];
  #replan = 0;
  #cursor: SVGLineElement | null = null;
  #drag = false;

  /** `choose` is called with the replan that somebody points at. */
  constructor(private readonly choose: (replan: number) => void) {
    this.host.append(this.#drawing, this.#table);
    new ResizeObserver(() => this.#draw()).observe(this.host);
    this.#table.addEventListener("toggle", () => this.#fillTable());
    const at = (event: PointerEvent): void => {
      const box = this.#drawing.getBoundingClientRect();
      const part = (event.clientX - box.left - LEFT) / Math.max(1, box.width - LEFT - RIGHT);
      this.choose(this.#replanAt(Math.min(Math.max(part, 0), 1)));
    };
    this.#drawing.addEventListener("pointerdown", (event) => {
      this.#drag = true;
      this.#drawing.setPointerCapture(event.pointerId);
      at(event);
    });
    this.#drawing.addEventListener("pointermove", (event) => this.#drag && at(event));
    for (const end of ["pointerup", "pointercancel"] as const) this.#drawing.addEventListener(end, () => (this.#drag = false));
  }

  /** Add, replace or (null) remove a line of a panel; each has a chart of its own. */
  setSeries(id: string, series: TimelineSeries | null): void {
    if (series) this.#extra.set(id, series);
    else if (!this.#extra.delete(id)) return;
    this.#draw();
  }

  /** The page's own lines of an episode. */
  setEpisode(steps: readonly number[], events: readonly EpisodeEvent[], rows: ReadonlyMap<string, TimelineRow>): void {
    this.#steps = steps;
    this.#events = events;
    this.#own.clear();
    for (const [id, row] of rows) this.#own.set(id, row);
    this.#draw();
  }

  /** Move the cursor. */
  setReplan(replan: number): void {
    this.#replan = replan;
    this.#moveCursor();
  }

  #place(replan: number): number {
    const [first, last] = [this.#steps[0] ?? 0, this.#steps[this.#steps.length - 1] ?? 1];
    return last > first ? ((this.#steps[replan] ?? first) - first) / (last - first) : 0.5;
  }

  #replanAt(part: number): number {
    let best = 0;
    this.#steps.forEach((_, i) => {
      if (Math.abs(this.#place(i) - part) < Math.abs(this.#place(best) - part)) best = i;
    });
    return best;
  }

  #rows(): TimelineRow[] {
    const extra = [...this.#extra.values()].map((series) => ({ title: series.name, series: [series], logarithmic: false, named: false }));
    return [...this.#own.values(), ...extra];
  }

  #draw(): void {
    const width = this.#drawing.clientWidth;
    if (!width || !this.#steps.length) return;
    const rows = this.#rows();
    const height = rows.length * (HEIGHT + TOP) + EVENTS;
    this.#drawing.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.#drawing.style.height = `${height}px`;
    this.#drawing.replaceChildren();
    const across = (replan: number): number => LEFT + this.#place(replan) * (width - LEFT - RIGHT);
    rows.forEach((row, i) => this.#drawRow(row, i * (HEIGHT + TOP) + TOP, width, across));
    for (const event of this.#events) {
      const x = across(event.replan);
      this.#drawing.append(svg("line", { x1: x, x2: x, y1: TOP, y2: height - EVENTS + 4, class: "event" }));
      const anchor = x > width / 2 ? "end" : "start";
      this.#drawing.append(svg("text", { x, y: height - 6, "text-anchor": anchor, class: "event-text" }, event.text));
    }
    this.#cursor = svg("line", { y1: 0, y2: height - EVENTS + 4, class: "cursor" });
    this.#drawing.append(this.#cursor);
    this.#drawing.setAttribute("aria-label", this.#spoken(rows));
    this.#moveCursor();
    if (this.#table.open) this.#fillTable();
  }

  #drawRow({ title, series, logarithmic, named }: TimelineRow, top: number, width: number, across: (replan: number) => number): void {
    const scale = (value: number): number => (logarithmic ? Math.log2(value) : value);
    const all = series.flatMap((one) => [...one.values, ...(one.uniform ?? [])]).filter(finite);
    const given = all.filter((value) => !logarithmic || value > 0).map(scale);
    let [low, high] = given.length ? [Math.min(...given), Math.max(...given)] : [0, 1];
    if (!logarithmic) low = Math.min(low, 0);
    const least = logarithmic ? 1 : 1e-6;
    if (high - low < least) {
      const middle = (high + low) / 2;
      [low, high] = logarithmic ? [middle - least / 2, middle + least / 2] : [low, low + least];
    }
    const down = (value: number): number => top + HEIGHT - 4 - ((scale(value) - low) / (high - low)) * (HEIGHT - 8);
    const back = (value: number): number => (logarithmic ? 2 ** value : value);
    this.#drawing.append(svg("rect", { x: LEFT, y: top, width: Math.max(0, width - LEFT - RIGHT), height: HEIGHT, class: "plot" }));
    this.#drawing.append(svg("text", { x: LEFT + 4, y: top - 4, class: "row-title" }, title));
    for (const [value, y] of [[back(high), top + 10], [back(low), top + HEIGHT - 2]] as const) {
      this.#drawing.append(svg("text", { x: LEFT - 4, y, "text-anchor": "end", class: "tick" }, formatNumber(value)));
    }
    let key = LEFT + 14 + 6.2 * title.length;
    for (const one of series) {
      const path = (values: readonly (number | null)[]): string => {
        let text = "";
        let drawing = false;
        values.forEach((value, i) => {
          const shown = finite(value) && (!logarithmic || value > 0);
          if (shown) text += `${drawing ? "L" : "M"}${across(i).toFixed(1)} ${down(value).toFixed(1)}`;
          drawing = shown;
        });
        return text;
      };
      if (one.uniform) this.#drawing.append(svg("path", { d: path(one.uniform), class: "uniform", stroke: one.colour }));
      this.#drawing.append(svg("path", { d: path(one.values), class: "line", stroke: one.colour }));
      if (one.values.length <= MOST_MARKS) {
        one.values.forEach((value, i) => {
          if (!finite(value) || (logarithmic && value <= 0)) return;
          this.#drawing.append(svg("circle", { cx: across(i), cy: down(value), r: 2, fill: one.colour }));
        });
      }
      if (named) {
        const name = svg("text", { x: key, y: top - 4, class: "series-name" }, one.name);
        name.style.fill = one.colour;
        this.#drawing.append(name);
        key += 8 + 6.2 * one.name.length;
      }
    }
  }

  #moveCursor(): void {
    if (!this.#cursor) return;
    const width = this.#drawing.clientWidth;
    const x = LEFT + this.#place(this.#replan) * (width - LEFT - RIGHT);
    this.#cursor.setAttribute("x1", String(x));
    this.#cursor.setAttribute("x2", String(x));
  }

  #spoken(rows: readonly TimelineRow[]): string {
    const series = rows.flatMap((row) => row.series).map((one) => {
      const values = one.values.filter(finite);
      if (!values.length) return `${one.name}: no values`;
      return `${one.name}: ${formatNumber(Math.min(...values))} to ${formatNumber(Math.max(...values))}${one.unit}`;
    });
    const events = this.#events.map((event) => `${event.text} at replan ${event.replan}`);
    return `Over ${this.#steps.length} replans. ${[...series, ...events].join("; ")}. The table below has the numbers.`;
  }

  #fillTable(): void {
    this.#table.querySelector("table")?.remove();
    if (!this.#table.open) return;
    const series = this.#rows().flatMap((row) => row.series);
    const head = element("tr", {}, ...["replan", "step", ...series.map((one) => one.name)].map((name) => element("th", { scope: "col" }, name)));
    const body = this.#steps.map((step, i) =>
      element(
        "tr",
        {},
        element("th", { scope: "row" }, String(i)),
        element("td", {}, String(step)),
        ...series.map((one) => element("td", {}, formatNumber(one.values[i]))),
      ),
    );
    this.#table.append(element("table", { class: "numbers" }, element("thead", {}, head), element("tbody", {}, ...body)));
  }
}
