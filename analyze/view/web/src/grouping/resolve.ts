/** From a grouping and an episode's tokens to a weight per key and group, with all checks: schemas/groupings/resolve.py. */
import { ROLES } from "../store/documents";
import {
  cellCoverage,
  complement,
  difference,
  intersection,
  touches,
  union,
  weightsOfCells,
} from "./cells";
import { type Grouping, isRest } from "./grouping";
import { type Atom, atomKey, atomsOf, EVERYTHING, folded, parseSelector, type Selector } from "./selector_parser";
import { everyKey, keysOf, type Membership, noKeys, problemOf } from "./selectors";
import { GroupingError, quoted, SelectorError, shortened } from "./text";
import { type EpisodeTokens, type KeyRole, pieceAt, type Vocabulary } from "./tokens";

/** A grouping on one episode's keys. What is the same at all replans has one entry. */
export interface ResolvedGrouping {
  readonly names: readonly string[];
  readonly keys: number;
  /** Of each replan, or once: (group, key), 0..1. */
  readonly weights: readonly Float32Array[];
  /** Numbers of keys that exist, of each replan, or once: (group); fractional where objects cover parts of patches. */
  readonly numKeys: readonly Float64Array[];
  /** Number of keys that can hold information, of each replan, or once. */
  readonly numValid: readonly number[];
}

/** The entry of a replan in a list that may have one entry for all. */
export function ofReplan<T>(list: readonly T[], replan: number): T {
  return list.length === 1 ? list[0]! : list[replan]!;
}

/** Throw for the first selector with a name that no selected episode has. */
export function checkNames(grouping: Grouping, vocabulary: Vocabulary): void {
  for (const [group, selectors] of grouping.groups) {
    for (const text of selectors) {
      const seen = new Set<string>();
      for (const atom of atomsOf(parseSelector(text))) {
        if (seen.has(atomKey(atom))) continue;
        seen.add(atomKey(atom));
        const problem = problemOf(atom, vocabulary);
        if (problem) throw new SelectorError(`Group '${group}', selector '${shortened(text)}': ${problem}`);
      }
    }
  }
}

/** Resolve a grouping on one episode, with the checks of names and of empty groups, as `vla-analyze` does. */
export function resolveChecked(grouping: Grouping, tokens: EpisodeTokens, vocabulary: Vocabulary): ResolvedGrouping {
  checkNames(grouping, vocabulary);
  const resolved = resolve(grouping, tokens);
  resolved.names.forEach((name, i) => {
    if (grouping.allowEmpty.includes(name) || resolved.numKeys.some((numbers) => numbers[i]! > 0)) return;
    throw new GroupingError(
      `Group '${name}' (${grouping.groups.get(name)!.join(" | ")}) has no key in any of the 1 selected episodes; ` +
        `change its selector, or add allow_empty = ["${name}"] to the grouping.`,
    );
  });
  return resolved;
}

/** Turn a grouping into weights; a word or an object that the episode lacks gives a group without keys. */
export function resolve(grouping: Grouping, tokens: EpisodeTokens): ResolvedGrouping {
  const members = [...memberships(grouping, tokens).values()];
  const area = members.some((member) => member.cells > 1) ? cellCoverage(tokens) : null;
  const parts = members.map((member) => weightsOfCells(member, area));
  const { keys } = tokens;
  const replans = Math.max(...parts.map((part) => part.replans));
  const weights = Array.from({ length: replans }, (_, replan) => {
    const stacked = new Float32Array(parts.length * keys);
    parts.forEach((part, group) => {
      const first = part.replans === 1 ? 0 : replan * keys;
      stacked.set(part.values.subarray(first, first + keys), group * keys);
    });
    return stacked;
  });
  return {
    names: [...grouping.groups.keys()],
    keys,
    weights,
    numKeys: countedKeys(weights, tokens.keyRole),
    numValid: countedValid(tokens),
  };
}

/** Weight of each key in the group of one selector, (key) of each replan or once. */
export function selectorWeights(text: string, tokens: EpisodeTokens): Float32Array[] {
  const member = evaluated(text, tokens);
  const { replans, values } = weightsOfCells(member, member.cells > 1 ? cellCoverage(tokens) : null);
  return Array.from({ length: replans }, (_, replan) => values.slice(replan * tokens.keys, (replan + 1) * tokens.keys));
}

function countedKeys(weights: readonly Float32Array[], { replans, keys, codes }: KeyRole): Float64Array[] {
  const length = codes.includes(ROLES.absent) ? Math.max(weights.length, replans) : weights.length;
  return Array.from({ length }, (_, replan) => {
    const own = ofReplan(weights, replan);
    const first = replans === 1 ? 0 : replan * keys;
    const sums = new Float64Array(own.length / keys);
    for (let group = 0; group < sums.length; group++) {
      let sum = 0;
      for (let key = 0; key < keys; key++) if (codes[first + key] !== ROLES.absent) sum += own[group * keys + key]!;
      sums[group] = sum;
    }
    return sums;
  });
}

function countedValid({ keyRole: { replans, keys }, valid }: EpisodeTokens): number[] {
  return Array.from({ length: replans }, (_, replan) =>
    valid.subarray(replan * keys, (replan + 1) * keys).reduce((sum, known) => sum + known, 0),
  );
}

/** Which (key, cell) pairs each group takes; whether groups are disjoint is checked here. */
function memberships(grouping: Grouping, tokens: EpisodeTokens): Map<string, Membership> {
  const members = new Map<string, Membership>();
  let taken = noKeys(tokens);
  let rest: string | null = null;
  for (const [group, selectors] of grouping.groups) {
    if (isRest(selectors)) {
      rest = group;
      members.set(group, taken); // keeps the order; replaced below
      continue;
    }
    let member: Membership | null = null;
    for (const selector of selectors) {
      try {
        const own = evaluated(selector, tokens);
        member = member ? union(member, own) : own;
      } catch (error) {
        if (error instanceof SelectorError) throw new SelectorError(`Group '${group}': ${error.message}`);
        throw error;
      }
    }
    member ??= noKeys(tokens);
    if (!grouping.overlap && touches(taken, member)) throw overlapping(group, member, members, tokens);
    members.set(group, member);
    taken = union(taken, member);
  }
  if (rest !== null) members.set(rest, complement(taken));
  return members;
}

function overlapping(
  group: string,
  member: Membership,
  others: ReadonlyMap<string, Membership>,
  tokens: EpisodeTokens,
): GroupingError {
  for (const [other, theirs] of others) {
    const shared = intersection(member, theirs);
    const keys = new Set<number>();
    shared.bits.forEach((bit, at) => {
      if (bit) keys.add(Math.floor(at / shared.cells) % shared.keys);
    });
    if (!keys.size) continue;
    const key = Math.min(...keys);
    return new GroupingError(
      `Groups '${other}' and '${group}' share ${keys.size} keys (the first is ${describedKey(key, tokens)}); ` +
        "take them out of one group with ' - ', or set overlap = true.",
    );
  }
  throw new Error("groups overlap with none of the others");
}

function describedKey(key: number, tokens: EpisodeTokens): string {
  const span = tokens.layout.spans.find((one) => one.start <= key && key < one.stop)!;
  const text = pieceAt(tokens, key);
  return `key ${key} of span '${span.name}'${text === undefined ? "" : `, ${quoted(text)}`}`;
}

/** Selectors whose keys are kept with an episode's tokens. */
const MOST_KEPT = 100;
const evaluatedOf = new WeakMap<EpisodeTokens, Map<string, Membership>>();

/** The keys of a selector. Kept: where one group is painted, the others are the same. */
function evaluated(text: string, tokens: EpisodeTokens): Membership {
  let kept = evaluatedOf.get(tokens);
  if (!kept || kept.size >= MOST_KEPT) evaluatedOf.set(tokens, (kept = new Map()));
  let member = kept.get(text);
  if (!member) kept.set(text, (member = keysOfSelector(parseSelector(text), tokens)));
  return member;
}

function keysOfSelector(selector: Selector, tokens: EpisodeTokens): Membership {
  const found = new Map<string, Membership>(); // long unions say the same more than once
  const leaf = (part: Atom | typeof EVERYTHING): Membership => {
    if (part === EVERYTHING) return everyKey(tokens);
    const known = found.get(atomKey(part)) ?? keysOf(part, tokens);
    found.set(atomKey(part), known);
    return known;
  };
  return folded(selector, leaf, (operator, left, right) => {
    if (operator === "&") return intersection(left, right);
    return operator === "|" ? union(left, right) : difference(left, right);
  });
}
