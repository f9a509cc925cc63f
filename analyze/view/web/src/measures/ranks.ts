/** Keys of one row on scales that can be compared between rows: lift and rank. */

/** The mass of the valid keys / what uniform attention gives them. */
export function overUniform(row: Float64Array, valid: Uint8Array, uniform: Float64Array): number {
  let [mass, given] = [0, 0];
  row.forEach((value, key) => {
    if (!valid[key]) return;
    mass += value;
    given += uniform[key]!;
  });
  return mass / given;
}

/**
 * Lift of every key, as `vla-analyze overlay` shows it: its probability / what uniform attention gives it, over the same
 * of all valid keys. NaN for keys that are not valid or that no query sees. `uniform`: (key), see `key_counts.ts`.
 */
export function keyLifts(row: Float64Array, valid: Uint8Array, uniform: Float64Array): Float64Array {
  const ofValid = overUniform(row, valid, uniform);
  return row.map((value, key) => (valid[key] && uniform[key]! > 0 ? value / uniform[key]! / ofValid : NaN));
}

/**
 * Rank of every key among the valid keys, 0 (least) to 1 (most); equal values have their mean rank, so that a row of
 * equal values is 0.5 everywhere. NaN for keys that are not valid.
 */
export function keyRanks(row: Float64Array, valid: Uint8Array): Float64Array {
  const order = Array.from(row.keys()).filter((key) => valid[key]);
  order.sort((a, b) => row[a]! - row[b]!);
  const ranks = new Float64Array(row.length).fill(NaN);
  for (let first = 0; first < order.length; ) {
    let stop = first + 1;
    while (stop < order.length && row[order[stop]!] === row[order[first]!]) stop++;
    const rank = order.length > 1 ? (first + stop - 1) / 2 / (order.length - 1) : 0.5;
    for (let i = first; i < stop; i++) ranks[order[i]!] = rank;
    first = stop;
  }
  return ranks;
}
