/**
 * What the masses of an episode's replans give: the rows of `replans` and `replans_groups` that `vla-analyze` writes
 * (analyze/measures/episodes.py, `replan_values`), for one layer or for the mean over several.
 */
import type { Grouping } from "../grouping/grouping";
import { ofReplan, type ResolvedGrouping } from "../grouping/resolve";
import { finiteGeometricMean, finiteMean, type GroupMeasures, groupMeasures, masses, sides } from "./masses";

/** Masses of one layer, means over the chosen denoise steps, heads and queries. */
export interface LayerMasses {
  /** (replan, group + 1); the last is the mass of all valid keys. */
  readonly values: Float64Array;
  readonly groups: number;
}

export interface ReplanValues {
  readonly groups: GroupMeasures;
  readonly validMass: number;
  readonly numValid: number;
  /** Absent where the grouping has no ratio. */
  readonly ratio?: {
    readonly numerator: number;
    readonly denominator: number;
    /** The ratio of this replan; of a mean over layers the geometric mean of the layers' ratios. */
    readonly value: number;
    /** The same, but of a mean over layers the mean of the layers' finite ratios, as the published scripts have it. */
    readonly mean: number;
    /** What uniform attention gives; of a mean over layers the geometric mean of those layers whose ratio counts. */
    readonly uniform: number;
    /** value / uniform */
    readonly lift: number;
  };
}

/**
 * Masses of a layer from mean rows (replan, key), or mean segment masses (replan, segment), and weights with the valid
 * keys as the last group (group + 1, key or segment), of each replan or once.
 */
export function layerMasses(rows: Float32Array | Float64Array, weights: readonly Float32Array[], keys: number): LayerMasses {
  const parts = weights[0]!.length / keys;
  const replans = rows.length / keys;
  const values = new Float64Array(replans * parts);
  for (let replan = 0; replan < replans; replan++) {
    values.set(masses(rows.subarray(replan * keys, (replan + 1) * keys), keys, ofReplan(weights, replan)), replan * parts);
  }
  return { values, groups: parts - 1 };
}

/**
 * The values of every replan. `layers`: one layer's masses, or those of all layers that the mean is over. `uniform`: what
 * uniform attention gives in each of these layers, (group + 1) of each replan or once, the last to all valid keys.
 */
export function replanValues(
  layers: readonly LayerMasses[],
  uniform: readonly (readonly Float64Array[])[],
  grouping: Grouping,
  resolved: ResolvedGrouping,
): ReplanValues[] {
  const { groups } = layers[0]!;
  const replans = layers[0]!.values.length / (groups + 1);
  return Array.from({ length: replans }, (_, replan) => {
    const of = (layer: LayerMasses): Float64Array =>
      layer.values.subarray(replan * (groups + 1), (replan + 1) * (groups + 1));
    const mean = new Float64Array(groups + 1);
    for (const layer of layers) of(layer).forEach((value, i) => (mean[i]! += value / layers.length));
    const mass = mean.slice(0, groups);
    const given = uniform.map((layer) => ofReplan(layer, replan));
    const meanGiven = new Float64Array(groups + 1);
    for (const layer of given) layer.forEach((value, i) => (meanGiven[i]! += value / given.length));
    const measures = groupMeasures(mass, mean[groups]!, ofReplan(resolved.numKeys, replan), meanGiven);
    const values = { groups: measures, validMass: mean[groups]!, numValid: ofReplan(resolved.numValid, replan) };
    if (!grouping.ratio) return values;
    const [numerator, denominator] = sides(mass, grouping);
    const quotient = (ofGroups: Float64Array): number => {
      const [above, below] = sides(ofGroups, grouping);
      return above / below;
    };
    const ratios = layers.map((layer) => quotient(of(layer)));
    const one = ratios.length === 1;
    const value = one ? ratios[0]! : finiteGeometricMean(ratios);
    const ofRatios = one ? ratios[0]! : finiteMean(ratios);
    const expected = uniformOfLayers(given.map(quotient), ratios);
    return { ...values, ratio: { numerator, denominator, value, mean: ofRatios, uniform: expected, lift: value / expected } };
  });
}

/**
 * The uniform ratio of a mean over layers: the geometric mean of the layers whose ratio has a logarithm, of all layers where
 * none has; where all layers have the same, this one.
 */
function uniformOfLayers(uniforms: readonly number[], ratios: readonly number[]): number {
  if (uniforms.every((value) => Object.is(value, uniforms[0]))) return uniforms[0]!;
  const known = ratios.map((ratio) => ratio > 0 && Number.isFinite(ratio));
  return finiteGeometricMean(known.includes(true) ? uniforms.filter((_, i) => known[i]) : uniforms);
}

/** What an episode's replans give together. */
export interface EpisodeValues {
  /** Of each group, means over the replans in which they are defined. */
  readonly groups: { mass: number; fraction: number; keys: number; lift: number }[];
  /** Geometric means over the replans with a finite positive ratio; NaN without a ratio. */
  readonly geometricMean: number;
  readonly uniformRatio: number;
  readonly ratioLift: number;
  /** Replans whose ratio is infinite or undefined. */
  readonly numNonfinite: number;
}

/** The rows of `episodes` and `episodes_groups` from those of the replans. */
export function episodeValues(replans: readonly ReplanValues[]): EpisodeValues {
  const ratios = replans.flatMap((one) => (one.ratio ? [one.ratio] : []));
  return {
    groups: Array.from(replans[0]!.groups.mass, (_, group) => {
      const mean = (measure: keyof GroupMeasures): number => finiteMean(replans.map((one) => one.groups[measure][group]!));
      return { mass: mean("mass"), fraction: mean("fraction"), keys: mean("keys"), lift: mean("lift") };
    }),
    geometricMean: finiteGeometricMean(ratios.map((one) => one.value)),
    uniformRatio: finiteGeometricMean(ratios.map((one) => one.uniform)),
    ratioLift: finiteGeometricMean(ratios.map((one) => one.lift)),
    numNonfinite: ratios.filter((one) => !Number.isFinite(one.mean)).length,
  };
}
