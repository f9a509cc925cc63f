/**
 * What uniform attention gives to every key: schemas/groupings/key_counts.py, which derives it.
 *
 * A store holds it, by replan, layer, denoise step, head, query and key; an axis along which nothing changes has
 * length 1.
 */
import type { Selection } from "../store/episode_values";

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
