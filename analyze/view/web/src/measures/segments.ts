/**
 * Weights on segments (all keys of one span that have one role), whose masses are stored as `atoms`: schemas/segments.py.
 * A grouping that cuts no segment needs no row, and its masses are those of the rows before storage rounded them.
 */
import { ofReplan, type ResolvedGrouping } from "../grouping/resolve";
import { type EpisodeTokens, spanNamed } from "../grouping/tokens";
import { ROLES, type SegmentDocument } from "../store/documents";

/** The resolved weights (group, key), and those of the valid keys as one more group, of each replan or once. */
export function withValid(resolved: ResolvedGrouping, tokens: EpisodeTokens): Float32Array[] {
  const { keys } = tokens;
  const replans = Math.max(resolved.weights.length, tokens.keyRole.replans);
  return Array.from({ length: replans }, (_, replan) => {
    const own = ofReplan(resolved.weights, replan);
    const first = tokens.keyRole.replans === 1 ? 0 : replan * keys;
    const stacked = new Float32Array(own.length + keys);
    stacked.set(own);
    stacked.set(tokens.valid.subarray(first, first + keys), own.length);
    return stacked;
  });
}

/**
 * Weights (group, key) as weights (group, segment), of each replan or once; null where some group does not treat all
 * keys of a segment alike. A segment without keys at a replan has weight 0.
 */
export function weightsOnSegments(
  weights: readonly Float32Array[],
  tokens: EpisodeTokens,
  segments: readonly SegmentDocument[],
): Float32Array[] | null {
  const { keys, keyRole, layout } = tokens;
  const places = segments.map(({ span, role }) => ({ ...spanNamed(layout, span), code: ROLES[role] }));
  const found: Float32Array[] = [];
  for (let replan = 0; replan < Math.max(weights.length, keyRole.replans); replan++) {
    const own = ofReplan(weights, replan);
    const roles = keyRole.codes.subarray(keyRole.replans === 1 ? 0 : replan * keys);
    const groups = own.length / keys;
    const result = new Float32Array(groups * segments.length);
    for (const [segment, { start, stop, code }] of places.entries()) {
      for (let group = 0; group < groups; group++) {
        let value = -1;
        for (let key = start; key < stop; key++) {
          if (roles[key] !== code) continue;
          const weight = own[group * keys + key]!;
          if (value >= 0 && weight !== value) return null;
          value = weight;
        }
        result[group * segments.length + segment] = Math.max(value, 0);
      }
    }
    found.push(result);
  }
  return found;
}
