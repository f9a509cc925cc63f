/** The effects of all words, parts and cameras as a table, and what they have to exceed. */
import { type Item, READERS, sizesOf, type Sizes, strongest } from "../measures/effects";
import { element } from "./dom";
import { formatNumber } from "./number_text";
import type { Shown } from "./shown";

const HEADS = { total: "hidden from everybody", direct: "action queries", pictures: "pictures", text: "text" } as const;

export class EffectTable {
  readonly host = element("details", { class: "effects", hidden: true }, element("summary", {}, "Effects of words, parts and cameras"));
  readonly #about = element("p", { class: "soft" });
  readonly #head = element("tr");
  readonly #body = element("tbody");

  constructor() {
    const table = element("table", { class: "numbers" }, element("thead", {}, this.#head), this.#body);
    this.host.append(element("div", { class: "scrolled", tabindex: 0, role: "region", "aria-label": "Table of effects" }, table), this.#about);
  }

  show({ effects, state, replan }: Shown): void {
    const known = effects?.known ?? null;
    this.host.hidden = !known;
    if (!known) return;
    const at = state.words === "replan" ? replan : null;
    const readers = READERS.filter((reader) => known.items.some(({ by }) => by[reader]));
    const heads = ["", ...readers.map((reader) => HEADS[reader]), ...(at === null ? [`lowest to highest (${HEADS[readers[0]!]})`, "replans"] : [])];
    this.#head.replaceChildren(...heads.map((name) => element("th", { scope: "col" }, name)));
    const row = (name: string, by: Item["by"], size: Sizes, floor: boolean): HTMLElement => {
      const cells = readers.map((reader) => {
        const { mean } = sizesOf(by[reader], at);
        return element("td", { "data-effect": `${reader}-${name}`, "data-value": String(mean) }, formatNumber(mean));
      });
      const spread = [size.count > 1 ? `${formatNumber(size.low)} to ${formatNumber(size.high)}` : "-", String(size.count)];
      return element(
        "tr",
        { class: floor ? "floor" : null },
        element("th", { scope: "row" }, name),
        ...cells,
        ...(at === null ? spread.map((text) => element("td", {}, text)) : []),
      );
    };
    const ofCall = (name: string, values: Float64Array | null): HTMLElement[] =>
      values ? [row(name, { [readers[0]!]: values }, sizesOf(values, at), true)] : [];
    const sorted = [...known.items].sort((a, b) => (strongest(b, at).mean || 0) - (strongest(a, at).mean || 0));
    this.#body.replaceChildren(
      ...sorted.map((item) => row(item.name, item.by, strongest(item, at), false)),
      ...ofCall("another noise seed", known.noise),
      ...known.random.map((item) => row(`random keys, as many as ${item.name}`, item.by, strongest(item, at), true)),
      ...ofCall("the unchanged call again", known.unchanged),
    );
    const where = at === null ? "Means over the replans at which the item was measured" : `At replan ${at}`;
    this.#about.textContent =
      `${where}: root mean square change of the executed actions, each dimension in units of its spread in the store, when no query ` +
      "reads the item, or these alone do not: the action queries, the pictures, the text. Effects do not add up. " +
      "vla-analyze effects has intervals over episodes, and exchanged words and pictures.";
  }
}
