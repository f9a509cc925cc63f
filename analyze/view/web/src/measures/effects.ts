/**
 * How far actions change without an item, as analyze/core/recorded_effects.py has it: root mean square change of the
 * executed actions, each dimension in units of its spread, by who no longer reads the item.
 */
import type { EpisodeDocument, RootDocument } from "../store/documents";
import type { ConditionDocument, EffectsDocument } from "../store/effects_document";
import { visible } from "../store/errors";
import { type Atom, atomsOf, parseSelector } from "../grouping/selector_parser";

/** Who no longer reads an item. `total`: nobody does. `direct`: the action queries alone do not. */
export const READERS = ["total", "direct", "pictures", "text"] as const;
export type Reader = (typeof READERS)[number];

/** Effects of one item by reader, (replan); NaN at replans at which it was not measured. */
export interface Item {
  readonly name: string;
  /** The one part of its selector; null for a composed one. */
  readonly atom: Atom | null;
  readonly by: Partial<Record<Reader, Float64Array>>;
  /** How its squared effect is shared by the dimensions of the action, over the episode: (dimension). */
  readonly shares: Partial<Record<Reader, Float64Array>>;
}

export interface EpisodeEffects {
  readonly items: readonly Item[];
  /** Random keys in place of an item's. */
  readonly random: readonly Item[];
  /** Another noise seed: the floor; null where it was not tried. */
  readonly noise: Float64Array | null;
  /** The unchanged call, made again among the changed ones. */
  readonly unchanged: Float64Array | null;
  /** The unit of each dimension; null for what is not compared. */
  readonly spread: readonly (number | null)[];
}

/** Effects over some replans: their mean, the smallest and the largest, and how many there are. */
export interface Sizes {
  readonly mean: number;
  readonly low: number;
  readonly high: number;
  readonly count: number;
}

/** Of one replan, or, with null, of all; NaN where nothing was measured. */
export function sizesOf(values: Float64Array | null | undefined, replan: number | null): Sizes {
  const own = (values && replan !== null ? values.subarray(replan, replan + 1) : (values ?? new Float64Array())).filter(Number.isFinite);
  if (!own.length) return { mean: NaN, low: NaN, high: NaN, count: 0 };
  const over = (join: (a: number, b: number) => number): number => own.reduce((a, b) => join(a, b));
  return { mean: over((a, b) => a + b) / own.length, low: over(Math.min), high: over(Math.max), count: own.length };
}

/** The total effect; where it was not measured, the direct one. */
export function strongest(item: Item, replan: number | null): Sizes {
  return sizesOf(item.by.total ?? item.by.direct, replan);
}

/** Numbers of steps of each chunk that were executed: `BaseEpisode` of analyze/core/action_changes.py. */
export function executedSteps({ protocol }: RootDocument, document: EpisodeDocument, horizon: number): number[] {
  const { env_step: steps, num_steps, num_replans } = document;
  if (protocol.name === "dataset" || protocol.replan_steps === 0) return Array.from({ length: num_replans }, () => horizon);
  const lasts = steps.slice(1).map((step, i) => step - steps[i]!);
  const beginning = protocol.name === "recorded" ? (steps[0] ?? 0) : protocol.wait_steps;
  let last = beginning + num_steps - (steps.at(-1) ?? 0);
  if (last <= 0 && protocol.name === "recorded") {
    // Nobody knows when the episode ended: its last replan lasts as long as the median one.
    const sorted = [...lasts].sort((a, b) => a - b);
    const half = sorted.length / 2;
    const middle = sorted.length % 2 ? sorted[Math.floor(half)]! : (sorted[half - 1]! + sorted[half]!) / 2;
    last = sorted.length ? Math.trunc(middle) : protocol.replan_steps;
  }
  return [...lasts, last].map((count) => Math.min(horizon, count, protocol.replan_steps));
}

/** Squares of each entry's change (entry, dimension), of the executed steps; NaN for an entry that was not measured. */
function changeSquares(
  change: { values: ArrayLike<number>; shape: readonly number[] },
  { units, replan }: EffectsDocument,
  spread: readonly (number | null)[],
  executed: readonly number[],
): Float64Array {
  const [entries, horizon, size] = change.shape as [number, number, number];
  const used = spread.flatMap((one, i) => (one === null ? [] : [{ i, factor: units[i]! / one }]));
  const squares = new Float64Array(entries * size);
  for (let entry = 0; entry < entries; entry++) {
    const first = entry * horizon * size;
    const steps = executed[replan[entry]!] ?? 0;
    // As in Python, a chunk with a value that is no number was not measured.
    let measured = steps > 0;
    for (let at = first; at < first + horizon * size; at++) measured &&= Number.isFinite(change.values[at]!);
    if (!measured) squares.fill(NaN, entry * size, (entry + 1) * size);
    for (let step = 0; measured && step < steps; step++) {
      for (const { i, factor } of used) squares[entry * size + i]! += (change.values[first + step * size + i]! * factor) ** 2;
    }
  }
  return squares;
}

/** Size of each entry's change (entry): `root_mean_square_change` of analyze/core/action_changes.py. */
function changeSizes(squares: Float64Array, size: number, { replan }: EffectsDocument, spread: readonly (number | null)[], executed: readonly number[]): Float64Array {
  const used = spread.filter((one) => one !== null).length;
  return Float64Array.from(replan, (at, entry) => {
    const sum = squares.subarray(entry * size, (entry + 1) * size).reduce((a, b) => a + b, 0);
    return used ? Math.sqrt(sum / used / executed[at]!) : NaN;
  });
}

function readerOf({ keys }: ConditionDocument): Reader | null {
  if (keys.length !== 1) return null;
  const [{ queries, query_selector: of }] = keys as [ConditionDocument["keys"][0]];
  if (queries !== "prefix") return queries === "all" ? "total" : "direct";
  return of === "role:image" ? "pictures" : of ? "text" : null;
}

function onlyAtom(selector: string): Atom | null {
  try {
    const atoms = atomsOf(parseSelector(selector));
    return atoms.length === 1 ? atoms[0]! : null;
  } catch {
    return null; // a selector that this page cannot read has a name all the same
  }
}

/** `'red'` for a word, `agentview` for a camera; other groups by the name that they were recorded under. */
function itemName({ name }: ConditionDocument, atom: Atom | null): string {
  const group = name.replace(/^(without|random)_/, "").replace(/_queries_(all|prefix)(_of_.*)?$/s, "");
  const bare = atom && group.startsWith(`${atom.kind}_`) ? group.slice(atom.kind.length + 1) : group;
  return visible(atom?.kind === "word" ? `'${bare}'` : bare);
}

/** What an episode recorded, by item and reader. `change`: (entry, step, dimension); `spread`: null for what is not compared. */
export function episodeEffects(
  change: { values: ArrayLike<number>; shape: readonly number[] },
  effects: EffectsDocument,
  spread: readonly (number | null)[],
  executed: readonly number[],
): EpisodeEffects {
  const size = change.shape[2]!;
  const squares = changeSquares(change, effects, spread, executed);
  const sizes = changeSizes(squares, size, effects, spread, executed);
  const shares = effects.conditions.map(() => new Float64Array(size));
  effects.condition.forEach((which, entry) => {
    for (let i = 0; i < size; i++) shares[which]![i]! += squares[entry * size + i] || 0;
  });
  for (const each of shares) {
    const total = each.reduce((a, b) => a + b, 0);
    each.forEach((part, i) => (each[i] = total > 0 ? part / total : 0));
  }
  const values = effects.conditions.map(() => new Float64Array(executed.length).fill(NaN));
  effects.condition.forEach((which, entry) => (values[which]![effects.replan[entry]!] = sizes[entry]!));
  const found = { items: new Map<string, Item>(), random: new Map<string, Item>() };
  let [noise, unchanged]: (Float64Array | null)[] = [null, null];
  effects.conditions.forEach((condition, i) => {
    if (condition.more || !values[i]!.some(Number.isFinite)) return;
    const [knockout] = condition.keys;
    if (!knockout) {
      if (condition.noise) noise ??= values[i]!;
      else unchanged ??= values[i]!;
      return;
    }
    const reader = readerOf(condition);
    if (condition.noise || reader === null || knockout.keep) return;
    const of = knockout.random_seed === null ? found.items : found.random;
    const atom = onlyAtom(knockout.selector);
    const name = itemName(condition, atom);
    if (!of.has(name)) of.set(name, { name, atom, by: {}, shares: {} });
    of.get(name)!.by[reader] = values[i]!;
    of.get(name)!.shares[reader] = shares[i]!;
  });
  const known = ({ by }: Item): boolean => by.total !== undefined || by.direct !== undefined;
  return { items: [...found.items.values()].filter(known), random: [...found.random.values()], noise, unchanged, spread };
}
