/** Ratio and masses of the grouping `default` at one replan, and what they can and cannot mean. */
import { button, element } from "./dom";
import { formatNumber, formatPercent } from "./number_text";
import type { Shown } from "./shown";

function figure(name: string, label: string): { host: HTMLElement; show(value: number, text: string, more?: string): void } {
  const number = element("output", { "data-number": name });
  const about = element("span", { class: "soft" }, label);
  return {
    host: element("div", { class: "figure" }, number, about),
    show(value, text, more = "") {
      about.textContent = `${label}${more}`;
      number.dataset.value = String(value);
      number.textContent = text;
    },
  };
}

export class Headline {
  /** The ratio, what uniform attention would give, and the lift. */
  readonly figures = element("section", { class: "figures", "aria-label": "Ratio of this replan" });
  /** The masses of all groups. */
  readonly masses = element("section", { class: "masses", "aria-label": "Masses of this replan" });
  readonly #ratio = figure("ratio", "visual / linguistic");
  readonly #uniform = figure("uniform-ratio", "uniform ratio");
  readonly #lift = figure("ratio-lift", "lift");
  readonly #meaning: HTMLElement;
  readonly #none = element("p", { class: "soft" });
  readonly #body = element("tbody");

  /** `explain` opens what the numbers mean. */
  constructor(explain: () => void) {
    const head = ["group", "keys", "mass", "fraction", "lift"].map((name) => element("th", { scope: "col" }, name));
    this.#meaning = element(
      "p",
      { class: "soft" },
      "Where attention went in these layers: not what the policy used, and not why it acted. ",
      button("What a ratio can and cannot mean", explain, { class: "link" }),
    );
    this.figures.append(this.#ratio.host, this.#uniform.host, this.#lift.host, this.#none, this.#meaning);
    this.masses.append(element("table", { class: "numbers" }, element("thead", {}, element("tr", {}, ...head)), this.#body));
  }

  show({ numbers, replan, site, selection }: Shown): void {
    const { ratio, groups } = numbers.replans[replan]!;
    for (const part of [this.#ratio.host, this.#uniform.host, this.#lift.host, this.#meaning]) part.hidden = !ratio;
    this.#none.hidden = ratio !== undefined;
    if (ratio) {
      // Of several layers both are geometric means, so that the lift is the ratio over the uniform one.
      const several = selection.layers.length > 1;
      const mean = several ? " (geometric mean of layers)" : "";
      this.#ratio.show(ratio.value, formatNumber(ratio.value), mean);
      this.#uniform.show(ratio.uniform, formatNumber(ratio.uniform));
      this.#lift.show(ratio.lift, `×${formatNumber(ratio.lift)}`);
    } else {
      this.#none.textContent = `Site ${site.layout.name} has no ratio: its keys are not both pictures and words.`;
    }
    const names = [...numbers.grouping.groups.keys()];
    this.#body.replaceChildren(
      ...numbers.present.map((name) => {
        const i = names.indexOf(name);
        const cell = (column: string, value: number, text: string): HTMLElement =>
          element("td", { "data-number": `${column}-${name}`, "data-value": String(value) }, text);
        return element(
          "tr",
          { "data-group": name },
          element("th", { scope: "row" }, name),
          cell("keys", groups.keys[i]!, formatNumber(groups.keys[i]!)),
          cell("mass", groups.mass[i]!, formatNumber(groups.mass[i]!)),
          cell("fraction", groups.fraction[i]!, formatPercent(groups.fraction[i]!)),
          cell("lift", groups.lift[i]!, formatNumber(groups.lift[i]!)),
        );
      }),
    );
  }
}
