/** Layers x heads: the lift of a group in every head of every layer at one replan, to choose a head from. */
import { button, choice, element } from "./dom";
import { formatNumber, formatPercent } from "./number_text";
import type { Shown } from "./shown";
import type { View } from "./state";

/** A grid of more cells than this is none that a page can show. */
const MOST_CELLS = 6000;
/** The colours end at this factor on either side of 1, or at the largest. */
const LEAST_FACTOR = Math.SQRT2;

/** With more heads in a row, numbers could not be read. */
const MOST_NUMBERED = 8;

const LESS: readonly number[] = [166, 60, 0];
const EVEN: readonly number[] = [247, 247, 247];
const MORE: readonly number[] = [0, 80, 125];
const NOTHING = "#d9d9d9";

/** The colour of a factor: from less (orange) through uniform (white) to more (blue), on a logarithmic scale. */
export function factorColour(factor: number, most: number): { ground: string; ink: string } {
  if (Number.isNaN(factor)) return { ground: NOTHING, ink: "#222" };
  const place = Math.min(Math.max(Math.log(factor) / Math.log(most), -1), 1);
  const end = place < 0 ? LESS : MORE;
  const mixed = EVEN.map((value, i) => Math.round(value + Math.abs(place) * (end[i]! - value)));
  return { ground: `rgb(${mixed.join(" ")})`, ink: Math.abs(place) > 0.55 ? "#fff" : "#222" };
}

function shortNumber(value: number): string {
  return value >= 0.1 && value < 99.5 ? value.toPrecision(2) : formatNumber(value);
}

export class HeadGrid {
  readonly host = element("div", { class: "grid" });
  readonly #group = choice("Group", "grid-group", (gridGroup) => this.view.update({ gridGroup }));
  readonly #table = element("table", { class: "heads" });
  readonly #note = element("p", { class: "soft" });
  readonly #cells = new Map<string, HTMLButtonElement>();
  #built = "";

  constructor(private readonly view: View) {
    const caption = element("p", { class: "soft" }, "Choose a head, a layer (its number) or a head in all layers.");
    this.host.append(this.#group.host, caption, element("div", { class: "scrolled" }, this.#table), this.#note);
    this.#table.addEventListener("keydown", (event) => this.#move(event));
  }

  show(shown: Shown): void {
    const { site, numbers, state, replan, selection } = shown;
    const names = numbers.present.filter((name) => name !== "padding" && name !== "masked");
    const chosen = names.includes(state.gridGroup) ? state.gridGroup : (names[0] ?? "");
    this.#group.show(names.map((name) => [name, name]), chosen);
    if (site.layers.length * site.heads.length > MOST_CELLS) {
      this.#note.textContent = `${site.layers.length} layers x ${site.heads.length} heads are more than this grid shows.`;
      this.#table.replaceChildren();
      return;
    }
    const built = `${site.layout.name}|${site.layers}|${site.heads}`;
    if (built !== this.#built) {
      this.#built = built;
      this.#build(site.layers, site.heads);
    }
    const group = [...numbers.grouping.groups.keys()].indexOf(chosen);
    const found = site.layers.map((_, layer) => site.heads.map((_, head) => numbers.cell(replan, layer, head)));
    const lifts = found.flat().map((cell) => cell.lift[group]!);
    const factors = lifts.filter((lift) => Number.isFinite(lift) && lift > 0).map((lift) => Math.max(lift, 1 / lift));
    const most = Math.max(LEAST_FACTOR, ...factors);
    site.layers.forEach((layer, i) =>
      site.heads.forEach((head, j) => {
        const lift = found[i]![j]!.lift[group]!;
        const fraction = found[i]![j]!.fraction[group]!;
        const cell = this.#cells.get(`${i}:${j}`)!;
        const { ground, ink } = factorColour(lift, most);
        cell.style.background = ground;
        cell.style.color = ink;
        cell.textContent = site.heads.length <= MOST_NUMBERED ? shortNumber(lift) : "";
        const text = `lift ${shortNumber(lift)} of ${chosen} in layer ${layer}, head ${head} (${formatPercent(fraction)} of its attention)`;
        cell.title = text;
        cell.setAttribute("aria-label", text);
        cell.dataset.value = String(lift);
        cell.dataset.fraction = String(fraction);
        const on = selection.layers.length === 1 && selection.layers[0] === i && selection.heads.length === 1 && selection.heads[0] === j;
        cell.setAttribute("aria-pressed", String(on));
      }),
    );
    this.#note.textContent =
      `Lift of ${chosen} at replan ${replan}: attention over what uniform attention gives it. White is uniform (×1), ` +
      `blue more, orange less; the colours end at ×${formatNumber(most)} and ×${formatNumber(1 / most)}.`;
  }

  #build(layers: readonly number[], heads: readonly number[]): void {
    this.#cells.clear();
    this.#table.style.minWidth = `${30 + 24 * heads.length}px`;
    const axis = (name: string, act: () => void, label: string): HTMLElement => {
      const made = button(name, act, { class: "axis", "aria-label": label });
      return made;
    };
    const first = element("td", {}, axis("all", () => this.view.update({ layer: "mean", head: "mean" }), "mean over all layers and heads"));
    const top = heads.map((head) =>
      element("th", { scope: "col" }, axis(String(head), () => this.view.update({ head, layer: "mean" }), `head ${head} in all layers`)),
    );
    const rows = layers.map((layer, i) => {
      const name = element("th", { scope: "row" }, axis(String(layer), () => this.view.update({ layer, head: "mean" }), `layer ${layer}, all heads`));
      const cells = heads.map((head, j) => {
        const made = button("", () => this.view.update({ layer, head }), { "data-cell": `${layer}:${head}`, "data-at": `${i}:${j}` });
        made.tabIndex = i || j ? -1 : 0;
        this.#cells.set(`${i}:${j}`, made);
        return element("td", {}, made);
      });
      return element("tr", {}, name, ...cells);
    });
    this.#table.replaceChildren(
      element("caption", {}, "layers (down) and heads (across)"),
      element("thead", {}, element("tr", {}, first, ...top)),
      element("tbody", {}, ...rows),
    );
  }

  /** Arrow keys go from cell to cell. */
  #move(event: KeyboardEvent): void {
    const at = (event.target as HTMLElement).dataset.at?.split(":").map(Number);
    const steps: Record<string, [number, number]> = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
    const step = steps[event.key];
    if (!at || !step) return;
    event.preventDefault();
    event.stopPropagation();
    const next = this.#cells.get(`${at[0]! + step[0]}:${at[1]! + step[1]}`);
    if (!next) return;
    (event.target as HTMLElement).tabIndex = -1;
    next.tabIndex = 0;
    next.focus();
  }
}
