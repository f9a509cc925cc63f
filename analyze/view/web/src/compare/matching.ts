/** Which replan of another episode belongs to a replan: the one at the nearest environment step. */

/**
 * Position in `others` that belongs to `replan` of `steps`; `count` replans there are in the other episode.
 *
 * Both are environment steps of replans, ascending. Where one of them is not known (empty), replans of equal number belong
 * together, and after the other's last one its last. Of two that are equally near, the earlier one.
 */
export function matchingReplan(steps: readonly number[], replan: number, others: readonly number[], count: number): number {
  const step = steps[replan];
  if (step === undefined || others.length !== count) return Math.min(replan, count - 1);
  let nearest = 0;
  for (let i = 1; i < count; i++) if (Math.abs(others[i]! - step) < Math.abs(others[nearest]! - step)) nearest = i;
  return nearest;
}

/** Values of another episode at the replans of one. */
export function alignedValues<T>(
  steps: readonly number[],
  replans: number,
  others: readonly number[],
  values: readonly T[],
): T[] {
  return Array.from({ length: replans }, (_, i) => values[matchingReplan(steps, i, others, values.length)]!);
}
