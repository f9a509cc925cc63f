/** The numbers of the groups: a chart over the episode, the ratio, and a table of this replan and of the episode. */
import type { Grouping } from "../grouping/grouping";
import type { GroupMeasures } from "../measures/masses";
import { episodeValues, type ReplanValues } from "../measures/replans";
import { element } from "../page/dom";
import { formatNumber, formatPercent } from "../page/number_text";
import { GroupChart } from "./chart";
import { groupStyles, onPage } from "./colours";

type Measure = "mass" | "fraction" | "lift" | "ratio";
const TITLES: Readonly<Record<Measure, string>> = {
  mass: "mass",
  fraction: "fraction of the groups' mass",
  lift: "lift (1: uniform attention)",
  ratio: "ratio",
};
const COLUMNS = ["mass", "fraction", "lift"] as const;

export interface Measured {
  readonly grouping: Grouping;
  readonly replans: readonly ReplanValues[];
  /** What the numbers are of, in words. */
  readonly about: string;
  /** How many layers they are means over. */
  readonly layers: number;
}

export class Results {
  readonly host = element("div", { class: "group-results", hidden: true });
  readonly #measure = element("select", { name: "group-measure", "aria-label": "What the chart shows" });
  readonly #about = element("span", { class: "soft" });
  readonly #chart: GroupChart;
  readonly #ratio = element("p", { class: "group-ratio" });
  readonly #body = element("tbody");
  #measured: Measured | null = null;
  #replan = 0;

  constructor(choose: (replan: number) => void) {
    this.#chart = new GroupChart(choose);
    this.#measure.addEventListener("change", () => this.#draw());
    const wide = (text: string): HTMLElement => element("th", { scope: "colgroup", colspan: 3 }, text);
    const columns = [...COLUMNS, ...COLUMNS].map((name) => element("th", { scope: "col" }, name));
    const head = element(
      "thead",
      {},
      element("tr", {}, element("th", { rowspan: 2, scope: "col" }, "group"), element("th", { rowspan: 2, scope: "col" }, "keys"), wide("this replan"), wide("mean of the episode")),
      element("tr", {}, ...columns),
    );
    const table = element("table", { class: "numbers" }, head, this.#body);
    this.host.append(
      element("div", { class: "group-bar" }, this.#measure, this.#about),
      this.#chart.host,
      this.#ratio,
      element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Numbers of the groups" }, table),
    );
  }

  /** Draw the numbers of a grouping. */
  show(measured: Measured, replan: number): void {
    this.#measured = measured;
    this.#replan = replan;
    const measures: Measure[] = [...COLUMNS, ...(measured.grouping.ratio ? (["ratio"] as const) : [])];
    const before = this.#measure.value;
    this.#measure.replaceChildren(...measures.map((name) => element("option", { value: name }, name)));
    this.#measure.value = (measures as string[]).includes(before) ? before : "lift";
    this.host.hidden = false;
    this.#draw();
  }

  /** Say that the numbers are of an earlier grouping, because the present one cannot be read. */
  markOld(old: boolean): void {
    this.host.classList.toggle("old", old);
  }

  clear(): void {
    this.#measured = null;
    this.host.hidden = true;
  }

  setReplan(replan: number): void {
    if (this.#replan === replan || !this.#measured) return;
    this.#replan = replan;
    this.#chart.setReplan(replan);
    this.#numbers();
  }

  #draw(): void {
    if (!this.#measured) return;
    const { grouping, replans, about } = this.#measured;
    const measure = this.#measure.value as Measure;
    const names = [...grouping.groups.keys()];
    const styles = groupStyles(names);
    this.#about.textContent = about;
    const present = presentGroups(this.#measured);
    const lines =
      measure === "ratio"
        ? [{ name: "ratio", style: { colour: "#0072B2", dash: "" }, values: replans.map((one) => one.ratio!.value) }]
        : present.map((group) => ({
            name: names[group]!,
            style: styles[group]!,
            values: replans.map((one) => one.groups[measure][group]!),
          }));
    const uniform = measure === "lift" ? 1 : measure === "ratio" ? sameUniform(replans) : null;
    const side = (part: readonly string[]): string => part.join(" + ");
    const title = measure === "ratio" ? `${side(grouping.ratio!.numerator)} / ${side(grouping.ratio!.denominator)}` : TITLES[measure];
    this.#chart.show({ title, uniform, lines });
    this.#chart.setReplan(this.#replan);
    this.#numbers();
  }

  #numbers(): void {
    const { grouping, replans } = this.#measured!;
    const names = [...grouping.groups.keys()];
    const styles = groupStyles(names);
    const now = replans[Math.min(this.#replan, replans.length - 1)]!;
    const whole = episodeValues(replans);
    const cell = (group: string, measure: keyof GroupMeasures, of: string, value: number): HTMLElement =>
      element(
        "td",
        { "data-group": group, "data-measure": measure, "data-of": of, "data-value": String(value) },
        measure === "fraction" ? formatPercent(value) : formatNumber(value),
      );
    this.#body.replaceChildren(
      ...presentGroups(this.#measured!).map((group) => {
        const name = names[group]!;
        const swatch = element("span", { class: "swatch", "aria-hidden": "true" });
        swatch.style.background = onPage(styles[group]!.colour);
        return element(
          "tr",
          {},
          element("th", { scope: "row" }, swatch, name),
          cell(name, "keys", "replan", now.groups.keys[group]!),
          ...COLUMNS.map((measure) => cell(name, measure, "replan", now.groups[measure][group]!)),
          ...COLUMNS.map((measure) => cell(name, measure, "episode", whole.groups[group]![measure])),
        );
      }),
    );
    this.#ratio.hidden = !now.ratio;
    if (!now.ratio) return;
    const number = (name: string, value: number, before = ""): HTMLElement =>
      element("output", { "data-number": `group-${name}`, "data-value": String(value) }, `${before}${formatNumber(value)}`);
    const left = whole.numNonfinite ? ` (${whole.numNonfinite} of ${replans.length} replans have no finite ratio)` : "";
    // Of several layers both are geometric means, so that the lift is the ratio over the uniform one.
    const several = this.#measured!.layers > 1;
    this.#ratio.replaceChildren(
      several ? "Ratio (geometric mean of layers) " : "Ratio ",
      number("ratio", now.ratio.value),
      ", uniform attention would give ",
      number("uniform-ratio", now.ratio.uniform),
      ", lift ",
      number("ratio-lift", now.ratio.lift, "×"),
      ". Episode, geometric mean: ",
      number("ratio-mean", whole.geometricMean),
      ", lift ",
      number("ratio-lift-mean", whole.ratioLift, "×"),
      `${left}. `,
      element("span", { class: "soft" }, "It says where attention went, not what the policy used."),
    );
  }
}

/** The uniform ratio of all replans; null where they have not one. */
function sameUniform(replans: readonly ReplanValues[]): number | null {
  const uniforms = replans.map((one) => one.ratio!.uniform);
  const [first = NaN] = uniforms;
  // Sums of what the keys get differ by rounding.
  return uniforms.every((one) => Math.abs(one / first - 1) < 1e-6) ? first : null;
}

/** Groups that have a key at some replan. */
function presentGroups({ grouping, replans }: Measured): number[] {
  return [...grouping.groups.keys()].flatMap((_, group) => (replans.some((one) => one.groups.keys[group]! > 0) ? [group] : []));
}
