/**
 * Means of attention rows over what a selection names, chunk by chunk.
 *
 * `rows` is (replan, layer, denoise, head, query, key), and its chunks hold one layer and one denoise step with all
 * heads, queries and keys (docs/store.md). Sums are taken in float64.
 */
import type { ArrayName, ArrayReader } from "./array_reader";
import { StoreError } from "./errors";

/** Which heads and which query: positions on the axes. */
export interface HeadsAndQuery {
  heads: readonly number[];
  query: number | "mean";
}

async function replansOfChunk(reader: ArrayReader, name: ArrayName): Promise<number> {
  const { chunk } = await reader.open(name);
  const whole = chunk.every((extent, axis) => axis < 1 || (axis < 3 ? extent === 1 : extent === name.shape[axis]));
  if (!whole) throw new StoreError(`The chunks of ${name.path} hold something else than a layer and a denoise step.`);
  return chunk[0]!;
}

function queriesOf(query: number | "mean", stored: number): [number, number] {
  return query === "mean" ? [0, stored] : [query, query + 1];
}

/**
 * The sum over heads of the rows (mean over the queries) at one layer and denoise step, added to `into` (replan, key)
 * for the replans [first, first + count).
 */
export async function addHeads(
  reader: ArrayReader,
  name: ArrayName,
  layer: number,
  denoise: number,
  selected: HeadsAndQuery,
  first: number,
  count: number,
  into: Float64Array,
): Promise<void> {
  const [, , , heads, queries, keys] = name.shape as [number, number, number, number, number, number];
  const perChunk = await replansOfChunk(reader, name);
  const [low, high] = queriesOf(selected.query, queries);
  const scale = 1 / (high - low);
  for (let block = Math.floor(first / perChunk); block * perChunk < first + count; block++) {
    const values = await reader.chunk(name, [block, layer, denoise, 0, 0, 0]);
    const from = Math.max(first, block * perChunk);
    const to = Math.min(first + count, (block + 1) * perChunk);
    for (let replan = from; replan < to; replan++) {
      const there = (replan - first) * keys;
      for (const head of selected.heads) {
        for (let query = low; query < high; query++) {
          const here = (((replan - block * perChunk) * heads + head) * queries + query) * keys;
          for (let key = 0; key < keys; key++) into[there + key]! += values[here + key]! * scale;
        }
      }
    }
  }
}

/** The rows (head, key) of all heads, mean over the queries, of one replan, added to `into`. */
export async function addEachHead(
  reader: ArrayReader,
  name: ArrayName,
  layer: number,
  denoise: number,
  query: number | "mean",
  replan: number,
  into: Float64Array,
): Promise<void> {
  const [, , , heads, , keys] = name.shape as [number, number, number, number, number, number];
  for (let head = 0; head < heads; head++) {
    const own = into.subarray(head * keys, (head + 1) * keys);
    await addHeads(reader, name, layer, denoise, { heads: [head], query }, replan, 1, own);
  }
}

/** Means over the queries of an array (replan, layer, denoise, head, query, segment), or one query of it. */
export async function meanOverQueries(reader: ArrayReader, name: ArrayName, query: number | "mean"): Promise<Float32Array> {
  const [replans, layers, denoise, heads, queries, segments] = name.shape as [number, number, number, number, number, number];
  const [low, high] = queriesOf(query, queries);
  const cells = layers * denoise * heads;
  const result = new Float32Array(replans * cells * segments);
  const { chunk } = await reader.open(name);
  for (let first = 0; first < replans; first += chunk[0]!) {
    const count = Math.min(chunk[0]!, replans - first);
    const values = await reader.part(name, first, count);
    for (let cell = 0; cell < count * cells; cell++) {
      for (let segment = 0; segment < segments; segment++) {
        let sum = 0;
        for (let each = low; each < high; each++) sum += values[(cell * queries + each) * segments + segment]!;
        result[(first * cells + cell) * segments + segment] = sum / (high - low);
      }
    }
  }
  return result;
}
