/** Keys of one row on scales that can be compared between rows: lift and rank. */

/**
 * Lift of every key: its probability / the mean probability of a valid key, as `vla-analyze overlay` shows it. NaN for
 * keys that are not valid. `counts`: for how many keys each key counts (see `keyCounts`).
 */
export function keyLifts(row: Float64Array, valid: Uint8Array, counts: Float64Array | null): Float64Array {
  let [mass, number] = [0, 0];
  row.forEach((value, key) => {
    if (!valid[key]) return;
    mass += value;
    number += counts ? counts[key]! : 1;
  });
  return row.map((value, key) => (valid[key] ? value / (counts ? counts[key]! : 1) / (mass / number) : NaN));
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
