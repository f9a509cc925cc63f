/**
 * What uniform attention gives to every key: schemas/groupings/key_counts.py, which derives it. Both are held together
 * by the cases of tests/schemas/groupings/uniform_cases.json.
 *
 * From version 2 on a store holds it, by replan, layer, denoise step, head, query and key; an axis along which nothing
 * changes has length 1. Version 1 has roles alone.
 */
import { ROLES } from "../store/documents";
import type { SiteDocument, SpanDocument } from "../store/documents";
import type { Selection } from "../store/episode_values";
import type { KeyRole } from "./tokens";

/** What uniform attention gives every key, (key), of each replan or once. */
export type UniformKeys = readonly Float64Array[];

/** The places of the stored values (replan, layer, denoise, head, query, key) whose mean is that of a selection. */
export function storedPlaces(shape: readonly number[], { layers, denoise, heads, query }: Selection): Selection {
  const [, ofLayers, ofDenoise, ofHeads, ofQueries] = shape;
  return {
    layers: ofLayers === 1 ? [0] : layers,
    denoise: ofDenoise === 1 ? [0] : denoise,
    heads: ofHeads === 1 ? [0] : heads,
    query: ofQueries === 1 ? "mean" : query,
  };
}

/**
 * What it gives in a store of version 1: 1 / N over the valid keys, and as much for every key that exists. Keys of a
 * growing span get a part of that, because only the later queries see them.
 *
 * `valid`: (replan or 1, key). `numQueries`: action queries of a replan that generates all tokens of the growing span.
 */
export function uniformOfVersion1(
  layout: SiteDocument,
  { replans, keys, codes }: KeyRole,
  valid: Uint8Array,
  numQueries: number,
): Float64Array[] {
  const growing = layout.spans.find((span) => span.growing);
  const own = (values: Uint8Array, replan: number): Uint8Array =>
    values.length === keys ? values : values.subarray(replan * keys, (replan + 1) * keys);
  return Array.from({ length: Math.max(replans, valid.length / keys) }, (_, replan) => {
    const exists = Float64Array.from(own(codes, replan), (code) => (code === ROLES.absent ? 0 : 1));
    const known = own(valid, replan);
    const counts = growing ? countsOfReplan(growing, exists, known, numQueries) : exists;
    const number = counts.reduce((sum, count, key) => sum + (known[key] ? count : 0), 0);
    return counts.map((count) => (number > 0 ? count / number : 0));
  });
}

/** For how much of a key that all queries see each key counts at one replan. */
function countsOfReplan(growing: SpanDocument, exists: Float64Array, valid: Uint8Array, numQueries: number): Float64Array {
  const { start, stop, growing_offset: offset } = growing;
  let [gone, outside] = [0, 0];
  for (let key = 0; key < valid.length; key++) {
    if (key >= start && key < stop) gone += 1 - exists[key]!;
    else outside += valid[key]!;
  }
  const queries = Math.max(1, numQueries - gone);
  const sees = (query: number, key: number): boolean => key - start < query + offset && exists[key] === 1;
  const counts = exists.slice();
  const shares = new Float64Array(stop - start);
  let all = 0;
  for (let query = 0; query < queries; query++) {
    let seen = outside;
    for (let key = start; key < stop; key++) if (sees(query, key)) seen += valid[key]!;
    if (!seen) continue;
    all += 1 / seen;
    for (let key = start; key < stop; key++) if (sees(query, key)) shares[key - start]! += 1 / seen;
  }
  if (all > 0) for (let key = start; key < stop; key++) counts[key] = shares[key - start]! / all;
  return counts;
}
