/** Ratio and masses of two episodes at one moment, one below the other, and their differences. */
import { element } from "../page/dom";
import { formatNumber } from "../page/number_text";
import type { Shown } from "../page/shown";

interface Line {
  name: string;
  label: string;
  left: number;
  right: number;
  /** Ratios and lifts are compared as factors, masses as differences. */
  factor: boolean;
}

function massOf({ numbers, replan }: Shown, name: string): number {
  const at = [...numbers.grouping.groups.keys()].indexOf(name);
  return at < 0 || !numbers.present.includes(name) ? NaN : numbers.replans[replan]!.groups.mass[at]!;
}

function linesOf(left: Shown, right: Shown): Line[] {
  const [a, b] = [left, right].map((shown) => shown.numbers.replans[shown.replan]!.ratio);
  const lines: Line[] = [];
  if (a && b) {
    lines.push({ name: "ratio", label: "visual / linguistic", left: a.value, right: b.value, factor: true });
    lines.push({ name: "ratio-lift", label: "its lift", left: a.lift, right: b.lift, factor: true });
  }
  const names = [...new Set([...left.numbers.present, ...right.numbers.present])];
  for (const name of names) {
    const [one, other] = [massOf(left, name), massOf(right, name)];
    if (one || other) lines.push({ name: `mass-${name}`, label: `mass of ${name}`, left: one, right: other, factor: false });
  }
  return lines;
}

/** The rows of the table; each number has `data-compare` and its full value. */
export function differenceRows(left: Shown, right: Shown): HTMLTableRowElement[] {
  return linesOf(left, right).map(({ name, label, left: a, right: b, factor }) => {
    const change = factor ? b / a : b - a;
    const sign = !factor && change > 0 ? "+" : "";
    const text = Number.isNaN(change) ? "-" : `${factor ? "×" : sign}${formatNumber(change)}`;
    const cell = (which: string, value: number, shown: string): HTMLElement =>
      element("td", { "data-compare": `${which}-${name}`, "data-value": String(value) }, shown);
    return element(
      "tr",
      {},
      element("th", { scope: "row" }, label),
      cell("left", a, formatNumber(a)),
      cell("right", b, formatNumber(b)),
      cell("change", change, text),
    );
  });
}
