/** Sums of the arrays that the server sent, and nothing else that is computed here. Axes: (replan, denoise[, head], key). */
import type { CameraLayout, NumberArray } from "./answers";

/** A place on an axis, or the mean over it. */
export type Choice = number | "mean";

/** Masses of all keys at every replan, (replan) of (key): of a denoise step and head, or means over them. */
export function keyMasses({ shape, data }: NumberArray, denoise: Choice, head: Choice): Float64Array[] {
  const keys = shape.at(-1)!;
  const [replans, steps] = [shape[0]!, shape[1]!];
  const heads = shape.length === 4 ? shape[2]! : 1;
  const ofSteps = denoise === "mean" || steps === 1 ? range(steps) : [denoise];
  const ofHeads = head === "mean" || heads === 1 ? range(heads) : [head];
  const share = 1 / (ofSteps.length * ofHeads.length);
  return range(replans).map((replan) => {
    const mean = new Float64Array(keys);
    for (const step of ofSteps) {
      for (const one of ofHeads) {
        const first = ((replan * steps + step) * heads + one) * keys;
        for (let key = 0; key < keys; key++) mean[key]! += data[first + key]! * share;
      }
    }
    return mean;
  });
}

/** The sum over some keys, each with a weight. */
export function sumOf(masses: ArrayLike<number>, keys: Iterable<readonly [number, number]>): number {
  let sum = 0;
  for (const [key, weight] of keys) sum += masses[key]! * weight;
  return sum;
}

/** Masses of keys as cells of a camera's map. */
export function cellSums(masses: ArrayLike<number>, { rows, columns, keys, cells, shares }: CameraLayout): Float64Array {
  const sums = new Float64Array(rows * columns);
  for (const [i, key] of keys.entries()) sums[cells[i]!]! += masses[key]! * (shares ? shares[i]! : 1);
  return sums;
}

/** Of every cell how many times what uniform attention gives it; NaN where that is nothing. */
export function cellLifts(masses: ArrayLike<number>, uniform: ArrayLike<number>, camera: CameraLayout): Float64Array {
  const even = cellSums(uniform, camera);
  return cellSums(masses, camera).map((mass, cell) => (even[cell]! > 0 ? mass / even[cell]! : NaN));
}

/** Lines around the cells for which `inside` holds, as a path in units of cells, or of so many pixels a cell; `by`: so far
 * within them, in parts of a cell. */
export function outline(
  { rows, columns }: { rows: number; columns: number },
  inside: (cell: number) => boolean,
  [wide, high]: readonly [number, number] = [1, 1],
  by = 0,
): string {
  const parts: string[] = [];
  const holds = (row: number, column: number): boolean =>
    row >= 0 && row < rows && column >= 0 && column < columns && inside(row * columns + column);
  for (let cell = 0; by && cell < rows * columns; cell++) {
    const [row, column] = [Math.floor(cell / columns), cell % columns];
    if (!holds(row, column)) continue;
    const free = [holds(row - 1, column), holds(row + 1, column), holds(row, column - 1), holds(row, column + 1)].map((held) =>
      held ? 0 : by,
    );
    const [top, bottom] = [(row + free[0]!) * high, (row + 1 - free[1]!) * high];
    const [left, right] = [(column + free[2]!) * wide, (column + 1 - free[3]!) * wide];
    const sides = [`M${left} ${top}H${right}`, `M${left} ${bottom}H${right}`, `M${left} ${top}V${bottom}`, `M${right} ${top}V${bottom}`];
    parts.push(...sides.filter((_, i) => free[i]));
  }
  if (by) return parts.join("");
  // Runs of edges become one line each.
  for (let row = 0; row <= rows; row++) {
    for (let column = 0, begin = -1; column <= columns; column++) {
      const edge = column < columns && holds(row, column) !== holds(row - 1, column);
      if (edge && begin < 0) begin = column;
      if (!edge && begin >= 0) {
        parts.push(`M${begin * wide} ${row * high}H${column * wide}`);
        begin = -1;
      }
    }
  }
  for (let column = 0; column <= columns; column++) {
    for (let row = 0, begin = -1; row <= rows; row++) {
      const edge = row < rows && holds(row, column) !== holds(row, column - 1);
      if (edge && begin < 0) begin = row;
      if (!edge && begin >= 0) {
        parts.push(`M${column * wide} ${begin * high}V${row * high}`);
        begin = -1;
      }
    }
  }
  return parts.join("");
}

export function range(count: number): number[] {
  return Array.from({ length: count }, (_, i) => i);
}

/** Numbers as the commands print them: three digits. */
export function shown(value: number | null | undefined): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return "-";
  return String(Number(value.toPrecision(3)));
}

export function percent(value: number | null | undefined): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return "-";
  return `${Number((100 * value).toPrecision(100 * value >= 10 ? 3 : 2))}%`;
}

/** Where a scale of lifts ends, as `scale_end` of analyze/core/camera_maps.py has it. */
export function scaleEnd(lifts: readonly number[]): number {
  const sorted = lifts.filter(Number.isFinite).sort((a, b) => a - b);
  const at = 0.995 * (sorted.length - 1);
  const [below, above] = [sorted[Math.floor(at)] ?? 0, sorted[Math.ceil(at)] ?? 0];
  const high = Math.max(4, below + (at - Math.floor(at)) * (above - below) || 0);
  const step = 10 ** (Math.floor(Math.log10(high)) - 1);
  return Math.ceil(Number((high / step).toFixed(9))) * step;
}

/** The mean of lists of numbers, place by place, of what is there; NaN where nothing is. */
export function meanOf(lists: readonly (readonly number[])[]): number[] {
  return range(Math.max(0, ...lists.map(({ length }) => length))).map((i) => {
    const known = lists.map((list) => list[i]!).filter(Number.isFinite);
    return known.reduce((a, b) => a + b, 0) / known.length;
  });
}

/** How strongly a change of the action is coloured, 0 to 1: by the part that moves most for what is `full` there. Parts that
 * move no more than by another noise seed do not count. */
export function strengthOf(sizes: readonly number[], noise: readonly number[], full: readonly number[]): number {
  return Math.max(0, ...sizes.map((size, i) => (size > (noise[i] || 0) ? Math.min(1, size / full[i]!) : 0)));
}
