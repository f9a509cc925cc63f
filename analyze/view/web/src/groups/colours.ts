/** The colours of groups, as analyze/show/plot_colours.py gives them; lighter where a dark page would swallow them. */

const FIXED: Readonly<Record<string, string>> = {
  visual: "#0072B2",
  linguistic: "#D55E00",
  action: "#009E73",
  state: "#CC79A7",
  padding: "#C8C8C8",
  null: "#BDB7A8",
  masked: "#8F8F8F",
  other: "#4D4D4D",
  rest: "#4D4D4D",
};
const FURTHER = ["#E69F00", "#56B4E9", "#F0E442", "#332288", "#117733", "#882255", "#44AA99", "#999933", "#AA4499"];
/** Patterns of lines, that tell groups apart when there are more of them than colours. */
const DASHES = ["", "6 3", "2 3", "8 3 2 3"];

export interface GroupStyle {
  readonly colour: string;
  readonly dash: string;
}

/** The style of each group, in their order. */
export function groupStyles(names: readonly string[]): GroupStyle[] {
  const taken = new Set(names.flatMap((name) => (Object.hasOwn(FIXED, name) ? [FIXED[name]] : [])));
  const palette = [...FURTHER, ...new Set(Object.values(FIXED).filter((colour) => !taken.has(colour)))];
  let position = 0;
  return names.map((name) => {
    if (Object.hasOwn(FIXED, name)) return { colour: FIXED[name]!, dash: "" };
    const style = {
      colour: palette[position % palette.length]!,
      dash: DASHES[Math.floor(position / palette.length) % DASHES.length]!,
    };
    position++;
    return style;
  });
}

/** The colour as a value of CSS: mixed with white on a dark page, with black on a light one, where it would be faint. */
export function onPage(colour: string): string {
  const [red, green, blue] = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16) / 255) as [number, number, number];
  const light = 0.2126 * red ** 2.2 + 0.7152 * green ** 2.2 + 0.0722 * blue ** 2.2;
  const mixed = (part: number, to: number): string =>
    `rgb(${[red, green, blue].map((one) => Math.round(255 * (one + part * (to - one)))).join(" ")})`;
  return `light-dark(${light > 0.5 ? mixed(0.3, 0) : colour}, ${light < 0.2 ? mixed(0.45, 1) : colour})`;
}
