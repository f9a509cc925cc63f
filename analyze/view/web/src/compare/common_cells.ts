/** Which layers, denoise steps and heads two episodes are compared in: those that both recorded. */
import type { CellNumbers } from "../page/shown";
import type { ViewState } from "../page/state";
import type { RootDocument } from "../store/documents";
import type { SiteInfo } from "../store/episode";
import { StoreError } from "../store/errors";

/** An episode's site, and the name of its store. */
export interface Recorded {
  readonly name: string;
  readonly root: RootDocument;
  readonly site: SiteInfo;
}

export interface CommonCells {
  /** What means are over; absent: what each recorded. */
  readonly meanOf: CellNumbers | undefined;
  /** What to know of it, in a sentence; empty: nothing. */
  readonly said: string;
}

const AXES = [
  ["layer", "layers", "layer"],
  ["denoise step", "denoise", "denoise"],
  ["head", "heads", "head"],
] as const;

/**
 * What both recorded of what a state shows.
 *
 * Throws `StoreError` where one of them lacks a layer, denoise step, head or query that the state names, and where a mean
 * would be over nothing: numbers of other cells are no comparison.
 */
export function commonCells(left: Recorded, right: Recorded, state: ViewState): CommonCells {
  const sides = [left, right];
  const meanOf: Record<keyof CellNumbers, readonly number[]> = { layers: [], denoise: [], heads: [] };
  const narrowed: string[] = [];
  const asDeep = (["num_layers", "num_heads", "num_denoise_steps"] as const).every(
    (field) => left.root.policy[field] === right.root.policy[field],
  );
  for (const [what, axis, field] of AXES) {
    const [own, other] = sides.map(({ site }) => [...new Set(site[axis])]) as [number[], number[]];
    const both = own.filter((number) => other.includes(number));
    const wanted = state[field];
    const without = sides.find(({ site }) => wanted !== "mean" && !site[axis].includes(wanted));
    if (without) throw new StoreError(`${without.name} has no ${what} ${wanted}. ${wayOut(what, both)}`);
    if (wanted !== "mean" || !asDeep) continue;
    if (!both.length) {
      const [a, b] = [own, other].map((numbers) => numbers.join(", "));
      throw new StoreError(`There is no ${what} that both recorded: ${left.name} has ${a}, ${right.name} ${b}.`);
    }
    meanOf[axis] = both;
    if (both.length < Math.max(own.length, other.length)) narrowed.push(`${both.length === 1 ? what : `${what}s`} ${both.join(", ")}`);
  }
  checkQueries(sides, state);
  if (!asDeep) {
    const said = "The policies differ in their numbers of layers, heads or denoise steps: each side is of its own, and equal numbers are not the same ones.";
    return { meanOf: undefined, said };
  }
  return { meanOf, said: narrowed.length ? `Means are over what both recorded: ${narrowed.join("; ")}.` : "" };
}

function wayOut(what: string, both: readonly number[]): string {
  const one = both.length ? `one that both recorded (${both.join(", ")}), or ` : "";
  return `Choose ${one}the mean over ${what}s.`;
}

function checkQueries(sides: readonly Recorded[], { query }: ViewState): void {
  if (query === "mean" || sides.every(({ site }) => site.numQueries === 1)) return;
  const without = sides.find(({ site }) => site.numQueries === 1 || query >= site.numQueries);
  if (!without) return;
  const { numQueries } = without.site;
  const has = numQueries === 1 ? "the mean of the action queries only" : `${numQueries} action queries`;
  throw new StoreError(`${without.name} has ${has}, not query ${query}. Choose the mean over action queries.`);
}
