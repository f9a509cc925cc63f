/** From rows and weights to masses and what follows from them: analyze/measures/masses.py. Pure arithmetic, float64. */
import type { Grouping } from "../grouping/grouping";
import type { UniformKeys } from "../grouping/key_counts";
import { ofReplan } from "../grouping/resolve";

/** Mass of each group, (row, group): sums over keys of rows (row, key) x weights (group, key). */
export function masses(rows: Float32Array | Float64Array, keys: number, weights: Float32Array): Float64Array {
  const [count, groups] = [rows.length / keys, weights.length / keys];
  const sums = new Float64Array(count * groups);
  for (let row = 0; row < count; row++) {
    for (let group = 0; group < groups; group++) {
      let sum = 0;
      for (let key = 0; key < keys; key++) sum += rows[row * keys + key]! * weights[group * keys + key]!;
      sums[row * groups + group] = sum;
    }
  }
  return sums;
}

/** What uniform attention gives groups, (group), of each replan or once; `weights`: (group, key) of each replan or once. */
export function uniformMasses(uniform: UniformKeys, weights: readonly Float32Array[], keys: number): Float64Array[] {
  return Array.from({ length: Math.max(uniform.length, weights.length) }, (_, replan) =>
    masses(ofReplan(uniform, replan), keys, ofReplan(weights, replan)),
  );
}

/** The measures of every group in one cell (replan, layer, denoise step, head), each (group). */
export interface GroupMeasures {
  readonly mass: Float64Array;
  /** mass / sum of the masses of all groups */
  readonly fraction: Float64Array;
  readonly keys: Float64Array;
  /** mass / number of keys; NaN for a group without keys */
  readonly density: Float64Array;
  /** (mass / what uniform attention gives) / (the same of all valid keys); NaN for a group of which no query sees a key */
  readonly lift: Float64Array;
}

/** `uniform`: what uniform attention gives the groups and, as the last, all valid keys, (group + 1). */
export function groupMeasures(
  mass: Float64Array,
  validMass: number,
  numKeys: Float64Array,
  uniform: Float64Array,
): GroupMeasures {
  const total = mass.reduce((sum, value) => sum + value, 0);
  const ofValid = validMass / uniform[mass.length]!;
  return {
    mass,
    fraction: mass.map((value) => value / total),
    keys: numKeys,
    density: mass.map((value, group) => (numKeys[group]! > 0 ? value / numKeys[group]! : NaN)),
    lift: mass.map((value, group) => (uniform[group]! > 0 ? value / uniform[group]! : NaN) / ofValid),
  };
}

/** Sums of values (group) over the groups of the ratio's numerator and of its denominator. */
export function sides(values: Float64Array, grouping: Grouping): [number, number] {
  const names = [...grouping.groups.keys()];
  const sum = (side: readonly string[]): number =>
    side.reduce((total, name) => total + values[names.indexOf(name)]!, 0);
  return [sum(grouping.ratio!.numerator), sum(grouping.ratio!.denominator)];
}

/** Mean over the finite values; NaN where there is none. */
export function finiteMean(values: readonly number[]): number {
  const finite = values.filter(Number.isFinite);
  return finite.length ? finite.reduce((sum, value) => sum + value, 0) / finite.length : NaN;
}

/** Geometric mean of the finite positive values; NaN where there is none. */
export function finiteGeometricMean(values: readonly number[]): number {
  return Math.exp(finiteMean(values.map((value) => (value > 0 ? Math.log(value) : NaN))));
}
