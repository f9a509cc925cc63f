/**
 * For how many keys each key counts: schemas/groupings/key_counts.py, which derives it. A key that every query sees
 * counts for 1, an absent one for 0, one of a growing span for a part of 1, because only the later queries see it.
 */
import { ROLES } from "../store/documents";
import type { SiteDocument, SpanDocument } from "../store/documents";
import type { KeyRole } from "./tokens";

/** Of each replan, or once: (key). Null where every key counts for one. `valid`: (replan or 1, key). */
export function keyCounts(
  layout: SiteDocument,
  roles: KeyRole,
  valid: Uint8Array,
  numQueries: number,
): Float64Array[] | null {
  const { keys, codes } = roles;
  const growing = layout.spans.find((span) => span.growing);
  const replans = Math.max(roles.replans, valid.length / keys);
  if (!growing) {
    if (!codes.includes(ROLES.absent)) return null;
    return Array.from({ length: roles.replans }, (_, replan) =>
      Float64Array.from(codes.subarray(replan * keys, (replan + 1) * keys), (code) => (code === ROLES.absent ? 0 : 1)),
    );
  }
  return Array.from({ length: replans }, (_, replan) => {
    const own = (values: Uint8Array): Uint8Array => values.subarray(replan * keys).subarray(0, keys);
    const absent = (roles.replans === 1 ? codes : own(codes)).slice(0, keys).map((code) => +(code === ROLES.absent));
    return countsOfReplan(growing, absent, valid.length === keys ? valid : own(valid), numQueries);
  });
}

/** The number of valid keys of each replan, or once. */
export function numValidKeys(valid: Uint8Array, keys: number, counts: Float64Array[] | null): number[] {
  const parts = counts?.some((one) => one.some((count) => count > 0 && count < 1)) ? counts : null;
  return Array.from({ length: Math.max(valid.length / keys, parts?.length ?? 1) }, (_, replan) => {
    let sum = 0;
    const first = valid.length === keys ? 0 : replan * keys;
    const count = parts && parts[parts.length === 1 ? 0 : replan];
    for (let key = 0; key < keys; key++) if (valid[first + key]) sum += count ? count[key] : 1;
    return sum;
  });
}

function countsOfReplan(growing: SpanDocument, absent: Uint8Array, valid: Uint8Array, numQueries: number): Float64Array {
  const { start, stop, growing_offset: offset } = growing;
  let [gone, outside] = [0, 0];
  for (let key = 0; key < valid.length; key++) {
    if (key >= start && key < stop) gone += absent[key];
    else outside += valid[key];
  }
  const queries = Math.max(1, numQueries - gone);
  const sees = (query: number, key: number): boolean => key - start < query + offset && !absent[key];
  const counts = Float64Array.from(absent, (missing) => (missing ? 0 : 1));
  const shares = new Float64Array(stop - start);
  let all = 0;
  for (let query = 0; query < queries; query++) {
    let seen = outside;
    for (let key = start; key < stop; key++) if (sees(query, key)) seen += valid[key];
    if (!seen) continue;
    all += 1 / seen;
    for (let key = start; key < stop; key++) if (sees(query, key)) shares[key - start] += 1 / seen;
  }
  if (all > 0) for (let key = start; key < stop; key++) counts[key] = shares[key - start] / all;
  return counts;
}
