/** Lines of groups over an episode's replans: axes with labels, names at the lines' ends, a cursor that can be moved. */
import { element, svg } from "../page/dom";
import { formatNumber, plural } from "../page/number_text";
import { type GroupStyle, onPage } from "./colours";

export interface ChartLine {
  readonly name: string;
  readonly style: GroupStyle;
  /** One value a replan; what is not finite is a gap. */
  readonly values: readonly number[];
}

export interface ChartContent {
  readonly title: string;
  /** What uniform attention gives, as a dotted line; null where there is no one value. */
  readonly uniform: number | null;
  readonly lines: readonly ChartLine[];
}

const HEIGHT = 220;
const LEFT = 52;
const TOP = 10;
const BOTTOM = 36;
const NAME_HEIGHT = 13;

export class GroupChart {
  readonly host = element("div", { class: "group-chart" });
  readonly #drawing = svg("svg", { class: "chart", role: "img" });
  #content: ChartContent = { title: "", uniform: null, lines: [] };
  #replan = 0;
  #right = 100;
  /** Of the part with the lines, in pixels. */
  #width = 1;
  #cursor: SVGLineElement | null = null;
  #drag = false;

  /** `choose` is called with the replan that somebody points at. */
  constructor(private readonly choose: (replan: number) => void) {
    this.host.append(this.#drawing);
    new ResizeObserver(() => this.#draw()).observe(this.host);
    this.#drawing.addEventListener("pointerdown", (event) => {
      this.#drag = true;
      this.#drawing.setPointerCapture(event.pointerId);
      this.#point(event);
    });
    this.#drawing.addEventListener("pointermove", (event) => {
      if (this.#drag) this.#point(event);
    });
    const stop = (): void => {
      this.#drag = false;
    };
    this.#drawing.addEventListener("pointerup", stop);
    this.#drawing.addEventListener("pointercancel", stop);
  }

  show(content: ChartContent): void {
    this.#content = content;
    this.#draw();
  }

  setReplan(replan: number): void {
    this.#replan = replan;
    const x = String(this.#across(replan));
    this.#cursor?.setAttribute("x1", x);
    this.#cursor?.setAttribute("x2", x);
  }

  get #count(): number {
    return this.#content.lines[0]?.values.length ?? 0;
  }

  #across(replan: number): number {
    return LEFT + (this.#count > 1 ? (replan / (this.#count - 1)) * this.#width : this.#width / 2);
  }

  #point(event: PointerEvent): void {
    const part = (event.clientX - this.#drawing.getBoundingClientRect().left - LEFT) / this.#width;
    this.choose(Math.round(Math.min(Math.max(part, 0), 1) * Math.max(this.#count - 1, 0)));
  }

  #draw(): void {
    const { lines, title, uniform } = this.#content;
    const width = this.#drawing.clientWidth;
    this.#drawing.replaceChildren();
    this.#drawing.style.height = `${HEIGHT}px`;
    if (!width || !lines.length) return;
    const longest = Math.max(...lines.map((line) => Array.from(line.name).length));
    this.#right = Math.min(16 + 7 * longest, width * 0.3);
    this.#width = Math.max(1, width - LEFT - this.#right);
    this.#drawing.setAttribute("viewBox", `0 0 ${width} ${HEIGHT}`);
    const finite = [...lines.flatMap((line) => line.values), ...(uniform === null ? [] : [uniform])].filter(Number.isFinite);
    const ticks = roundTicks(Math.max(0, ...finite));
    const high = ticks[ticks.length - 1]!;
    const down = (value: number): number => HEIGHT - BOTTOM - (value / high) * (HEIGHT - BOTTOM - TOP);
    this.#axes(ticks, down, title);
    if (uniform !== null && uniform <= high) {
      const [x1, y] = [LEFT, down(uniform)];
      this.#drawing.append(svg("line", { x1, x2: LEFT + this.#width, y1: y, y2: y, class: "uniform" }));
    }
    for (const line of lines) this.#line(line, down);
    this.#names(lines, down);
    this.#cursor = svg("line", { y1: TOP, y2: HEIGHT - BOTTOM, class: "cursor" });
    this.#drawing.append(this.#cursor);
    this.setReplan(this.#replan);
    this.#drawing.setAttribute("aria-label", this.#spoken());
  }

  #axes(ticks: readonly number[], down: (value: number) => number, title: string): void {
    const right = LEFT + this.#width;
    for (const tick of ticks) {
      this.#drawing.append(
        svg("line", { x1: LEFT, x2: right, y1: down(tick), y2: down(tick), class: "grid" }),
        svg("text", { x: LEFT - 4, y: down(tick) + 4, "text-anchor": "end", class: "tick" }, formatNumber(tick)),
      );
    }
    const middle = (TOP + HEIGHT - BOTTOM) / 2;
    const last = this.#count - 1;
    for (const replan of new Set([0, Math.round(last / 2), last])) {
      const x = this.#across(replan);
      this.#drawing.append(
        svg("text", { x, y: HEIGHT - BOTTOM + 14, "text-anchor": "middle", class: "tick" }, String(replan)),
      );
    }
    this.#drawing.append(
      svg("text", { x: 12, y: middle, transform: `rotate(-90 12 ${middle})`, "text-anchor": "middle", class: "axis" }, title),
      svg(
        "text",
        { x: (LEFT + right) / 2, y: HEIGHT - 6, "text-anchor": "middle", class: "axis" },
        `replan (n = ${this.#count})`,
      ),
    );
  }

  #line({ style, values }: ChartLine, down: (value: number) => number): void {
    const colour = onPage(style.colour);
    let path = "";
    let drawing = false;
    values.forEach((value, replan) => {
      const there = Number.isFinite(value);
      if (there) path += `${drawing ? "L" : "M"}${this.#across(replan).toFixed(1)} ${down(value).toFixed(1)}`;
      drawing = there;
    });
    const line = svg("path", { d: path, class: "line", "stroke-dasharray": style.dash || null });
    line.style.stroke = colour;
    this.#drawing.append(line);
    if (values.length > 40) return;
    values.forEach((value, replan) => {
      if (!Number.isFinite(value)) return;
      const mark = svg("circle", { cx: this.#across(replan), cy: down(value), r: 2 });
      mark.style.fill = colour;
      this.#drawing.append(mark);
    });
  }

  /** Names at the ends of the lines, moved apart where they would touch. */
  #names(lines: readonly ChartLine[], down: (value: number) => number): void {
    const ends = lines.flatMap((line) => {
      const last = [...line.values].reverse().find(Number.isFinite);
      return last === undefined ? [] : [{ line, y: down(last) }];
    });
    ends.sort((a, b) => a.y - b.y);
    let free = TOP + 4;
    const places = ends.map(({ y }) => {
      const own = Math.max(y, free);
      free = own + NAME_HEIGHT;
      return own;
    });
    const below = Math.max(0, free - NAME_HEIGHT - (HEIGHT - BOTTOM));
    ends.forEach(({ line }, i) => {
      const least = TOP + 4 + i * NAME_HEIGHT;
      const y = Math.max(places[i]! - below, Math.min(least, places[i]!));
      const text = svg("text", { x: LEFT + this.#width + 6, y: y + 4, class: "name" }, line.name);
      text.style.fill = onPage(line.style.colour);
      this.#drawing.append(text);
    });
  }

  #spoken(): string {
    const { title, lines } = this.#content;
    const said = lines.map(({ name, values }) => {
      const finite = values.filter(Number.isFinite);
      if (!finite.length) return `${name}: no values`;
      return `${name}: ${formatNumber(Math.min(...finite))} to ${formatNumber(Math.max(...finite))}`;
    });
    return `${title} over ${plural(this.#count, "replan")}. ${said.join("; ")}. The table has the numbers.`;
  }
}

/** Round numbers from 0 to one that is not below the highest value. */
function roundTicks(highest: number): number[] {
  if (!(highest > 0)) return [0, 1];
  const rough = highest / 4;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 2.5, 5, 10].find((factor) => factor * power >= rough)!;
  return Array.from({ length: Math.ceil(highest / step - 1e-9) + 1 }, (_, i) => Number((i * step).toPrecision(12)));
}
