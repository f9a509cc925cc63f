/** Ratio and masses of the grouping `default` at one replan, and what they can and cannot mean. */
import { button, element } from "./dom";
import { formatNumber, formatPercent } from "./number_text";
import type { Shown } from "./shown";

function figure(name: string, label: string): { host: HTMLElement; show(value: number, text: string): void } {
  const number = element("output", { "data-number": name });
  return {
    host: element("div", { class: "figure" }, number, element("span", { class: "soft" }, label)),
    show(value, text) {
      number.dataset.value = String(value);
      number.textContent = text;
    },
  };
}

export class Headline {
  readonly host = element("section", { class: "headline", "aria-label": "Ratio and masses of this replan" });
  readonly #ratio = figure("ratio", "visual / linguistic attention");
  readonly #uniform = figure("uniform-ratio", "uniform attention would give");
  readonly #lift = figure("ratio-lift", "lift: ratio / uniform");
  readonly #figures = element("div", { class: "figures" }, this.#ratio.host, this.#uniform.host, this.#lift.host);
  readonly #none = element("p", { class: "soft" });
  readonly #body = element("tbody");

  /** `explain` opens what the numbers mean. */
  constructor(private readonly explain: () => void) {
    const head = ["group", "keys", "mass", "fraction", "lift"].map((name) => element("th", { scope: "col" }, name));
    this.host.append(
      this.#figures,
      this.#none,
      element("table", { class: "masses numbers" }, element("thead", {}, element("tr", {}, ...head)), this.#body),
      element(
        "p",
        { class: "soft" },
        "A ratio depends on how many keys each side has: the lift does not. It says where attention went in these layers, " +
          "not what the policy used, and not why it acted. ",
        button("What a ratio can and cannot mean", () => this.explain(), { class: "link" }),
        ".",
      ),
    );
  }

  show({ numbers, replan, site }: Shown): void {
    const { ratio, groups } = numbers.replans[replan]!;
    this.#figures.hidden = !ratio;
    this.#none.hidden = ratio !== undefined;
    if (ratio) {
      this.#ratio.show(ratio.value, formatNumber(ratio.value));
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
