/** Words for what a grouping's numbers are of: in the panel, and as options of `vla-analyze`. */
import type { Place } from "../page/baselines";

/** A name for a new group that no other has, from a word or an object's name. */
export function freeName(wanted: string, taken: readonly string[]): string {
  const plain = wanted.replace(/[^\p{L}\p{N}_.@-]/gu, "_").replace(/^[^A-Za-z0-9_]+/, "") || "group";
  const base = ["numerator", "denominator", "ratio"].includes(plain) ? `${plain}_` : plain;
  for (let number = 1; ; number++) {
    const name = number === 1 ? base : `${base}_${number}`;
    if (!taken.includes(name)) return name;
  }
}

const axes = ({ site, selection }: Place): [string, number[], readonly number[]][] => [
  ["layer", site.layers, selection.layers],
  ["denoise step", site.denoise, selection.denoise],
  ["head", site.heads, selection.heads],
];

/** Which layers, denoise steps and heads the numbers are means over. */
export function aboutText(place: Place): string {
  const parts = axes(place).map(([noun, recorded, chosen]) => {
    if (chosen.length === 1) return `${noun} ${recorded[chosen[0]!]}`;
    return `mean of ${chosen.length} ${noun}s`;
  });
  return `${parts.join(", ")}; n = ${place.episode.numReplans} replans`;
}

/** The options of `vla-analyze` that choose the same site, task, layers, denoise steps and heads. */
export function selectionArguments(place: Place): string[] {
  const { episode, site } = place;
  const options: Record<string, string> = { layer: "--layers", "denoise step": "--denoise", head: "--heads" };
  const first = episode.root.sites[0]!.name;
  return [
    ...(site.layout.name === first ? [] : ["--site", site.layout.name]),
    "--tasks",
    String(episode.document.task_id),
    ...axes(place).flatMap(([noun, recorded, chosen]) =>
      chosen.length === recorded.length ? [] : [options[noun]!, ...chosen.map((i) => String(recorded[i]))],
    ),
  ];
}
