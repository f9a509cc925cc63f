/** Sets of (key, cell) pairs, and the areas of cells, in float32 and in numpy's order of addition, as resolve.py. */
import type { Membership } from "./selectors";
import { GroupingError, thousands } from "./text";
import { type EpisodeTokens, patchKeys } from "./tokens";

const CLAIMED_BYTES = 64_000_000;
const EXPANSION = 100;

/** Two memberships joined cell by cell; axes of length 1 stand for every replan or cell. */
export function joined(left: Membership, right: Membership, join: (a: number, b: number) => number): Membership {
  const keys = left.keys;
  const replans = Math.max(left.replans, right.replans);
  const cells = Math.max(left.cells, right.cells);
  const bits = new Uint8Array(replans * keys * cells);
  let at = 0;
  for (let replan = 0; replan < replans; replan++) {
    const a = left.replans === 1 ? 0 : replan * keys * left.cells;
    const b = right.replans === 1 ? 0 : replan * keys * right.cells;
    for (let key = 0; key < keys; key++) {
      for (let cell = 0; cell < cells; cell++) {
        const one = left.bits[a + (left.cells === 1 ? key : key * cells + cell)]!;
        const other = right.bits[b + (right.cells === 1 ? key : key * cells + cell)]!;
        bits[at++] = join(one, other);
      }
    }
  }
  return { replans, keys, cells, bits };
}

export const union = (left: Membership, right: Membership): Membership => joined(left, right, (a, b) => a | b);
export const intersection = (left: Membership, right: Membership): Membership => joined(left, right, (a, b) => a & b);
export const difference = (left: Membership, right: Membership): Membership => joined(left, right, (a, b) => a & ~b & 1);

export function complement(member: Membership): Membership {
  return { ...member, bits: member.bits.map((bit) => 1 - bit) };
}

/** Whether two memberships share a cell, without making their intersection. */
export function touches(left: Membership, right: Membership): boolean {
  return intersection(left, right).bits.includes(1);
}

const areas = new WeakMap<EpisodeTokens, Float32Array>();

/**
 * Area of each key's cells, (replan, key, 1 + object) float32; they sum to 1. Cell 0 is what no object covers. Kept with
 * the tokens: every stroke of a brush asks for it.
 */
export function cellCoverage(tokens: EpisodeTokens): Float32Array {
  let area = areas.get(tokens);
  if (!area) areas.set(tokens, (area = areasOfCells(tokens)));
  return area;
}

function areasOfCells(tokens: EpisodeTokens): Float32Array {
  const { numReplans: replans, keys, objects } = tokens;
  const cells = 1 + objects.length;
  let covered = 0;
  for (const one of tokens.coverage.values()) covered += one.values.byteLength;
  const bytes = 4 * replans * keys * cells;
  if (bytes > Math.max(2 * CLAIMED_BYTES, EXPANSION * covered)) {
    throw new GroupingError(
      `The coverage of ${objects.length} objects on ${keys} keys at ${replans} replans takes ${thousands(bytes)} ` +
        `bytes, of which ${thousands(covered)} are stored: the store has more objects and keys than its pictures show.`,
    );
  }
  const area = new Float32Array(replans * keys * cells);
  for (const [camera, coverage] of tokens.coverage) {
    const own = patchKeys(tokens.layout, camera);
    for (let replan = 0; replan < replans; replan++) {
      for (let patch = 0; patch < coverage.patches; patch++) {
        const from = (replan * coverage.patches + patch) * coverage.objects;
        const to = (replan * keys + own[patch]!) * cells + 1;
        area.set(coverage.values.subarray(from, from + coverage.objects), to);
      }
    }
  }
  for (let at = 0; at < area.length; at += cells) {
    const left = Math.fround(1 - float32Sum(area, at + 1, objects.length));
    area[at] = Math.min(Math.max(left, 0), 1);
  }
  return area;
}

/** Weight of each key, (replan or 1, key) float32. */
export interface KeyWeights {
  readonly replans: number;
  readonly values: Float32Array;
}

const weightsOf = new WeakMap<Membership, KeyWeights>();

/** Weight of each key: whether it is a member, or the covered area of its chosen cells. Kept with the membership. */
export function weightsOfCells(member: Membership, area: Float32Array | null): KeyWeights {
  let weights = weightsOf.get(member);
  if (!weights) weightsOf.set(member, (weights = addedCells(member, area)));
  return weights;
}

function addedCells(member: Membership, area: Float32Array | null): KeyWeights {
  const { keys, cells } = member;
  if (cells === 1 || area === null) return { replans: member.replans, values: Float32Array.from(member.bits) };
  const replans = area.length / (keys * cells);
  const values = new Float32Array(replans * keys);
  const chosen = new Float32Array(cells);
  for (let at = 0; at < values.length; at++) {
    const of = (member.replans === 1 ? at % keys : at) * cells;
    for (let cell = 0; cell < cells; cell++) chosen[cell] = area[at * cells + cell]! * member.bits[of + cell]!;
    // A sum of area fractions may exceed 1 by rounding; a weight may not.
    values[at] = Math.min(float32Sum(chosen, 0, cells), 1);
  }
  return { replans, values };
}

const lanes = new Float32Array(8);

/** A sum of float32 values, rounded after every addition, in the order in which numpy adds neighbours pairwise. */
export function float32Sum(values: Float32Array, start: number, count: number): number {
  if (count < 8) {
    let sum = 0;
    for (let i = 0; i < count; i++) sum = Math.fround(sum + values[start + i]!);
    return sum;
  }
  if (count > 128) {
    const half = Math.floor(count / 2) - (Math.floor(count / 2) % 8);
    return Math.fround(float32Sum(values, start, half) + float32Sum(values, start + half, count - half));
  }
  for (let lane = 0; lane < 8; lane++) lanes[lane] = values[start + lane]!;
  let i = 8;
  for (; i < count - (count % 8); i += 8) for (let lane = 0; lane < 8; lane++) lanes[lane]! += values[start + i + lane]!;
  // Storing in a Float32Array rounds.
  for (let apart = 1; apart < 8; apart *= 2) for (let lane = 0; lane < 8; lane += 2 * apart) lanes[lane]! += lanes[lane + apart]!;
  let sum = lanes[0]!;
  for (; i < count; i++) sum = Math.fround(sum + values[start + i]!);
  return sum;
}
