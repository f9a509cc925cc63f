/** How the patches of a camera lie on a map of its picture. The same as `PictureMap` of analyze/measures/patch_maps.py. */
import { gridSpans, patchKeys } from "../grouping/tokens";
import { coversAll, type GridDocument, type SiteDocument } from "../store/documents";

const ROUNDING = 1e-6;
/** Cells along a side of a map that adds several grids. */
const MOST_CELLS = 128;

/** Even cells over a picture, row by row from its top left corner. */
export interface Cells {
  readonly rows: number;
  readonly columns: number;
}

interface Placed {
  /** Number of the grid's first patch. */
  readonly first: number;
  readonly grid: GridDocument;
  /** Of every row and column of patches the part in each row and column of cells, (patch row, row). */
  readonly down: Float64Array[];
  readonly across: Float64Array[];
  /** The patch at each cell's centre; -1: none. */
  readonly at: Int32Array;
}

/**
 * Even cells over a camera's picture. Those of one grid over all of it are its patches; of several grids they are as small
 * as the smallest patches, and a patch's mass is spread evenly over its area.
 */
export class PictureMap implements Cells {
  readonly keys: readonly number[];
  readonly rows: number;
  readonly columns: number;
  readonly height: number;
  readonly width: number;
  readonly cellsArePatches: boolean;
  /** Smallest patches first. */
  readonly #placed: readonly Placed[];

  constructor(layout: SiteDocument, camera: string) {
    const grids = gridSpans(layout, camera).map(({ grid }) => grid);
    this.keys = patchKeys(layout, camera);
    this.height = grids[0]!.image_height;
    this.width = grids[0]!.image_width;
    this.cellsArePatches = grids.length === 1 && coversAll(grids[0]!);
    const cells = (sides: readonly (readonly [number, number])[], pixels: number): number =>
      this.cellsArePatches ? sides[0]![0] : numCells(sides, pixels);
    this.rows = cells(grids.map(({ rows, part }) => [rows, part[2]]), this.height);
    this.columns = cells(grids.map(({ columns, part }) => [columns, part[3]]), this.width);
    let first = 0;
    const placed = grids.map((grid): Placed => {
      const [top, left, height, width] = grid.part;
      const at = new Int32Array(this.rows * this.columns).fill(-1);
      for (let cell = 0; cell < at.length; cell++) {
        const down = (Math.floor(cell / this.columns) + 0.5) / this.rows;
        const across = ((cell % this.columns) + 0.5) / this.columns;
        const row = Math.floor(((down - top) * grid.rows) / height);
        const column = Math.floor(((across - left) * grid.columns) / width);
        if (row >= 0 && row < grid.rows && column >= 0 && column < grid.columns) at[cell] = first + row * grid.columns + column;
      }
      const own = { first, grid, down: shares(grid.rows, top, height, this.rows), across: shares(grid.columns, left, width, this.columns), at };
      first += grid.rows * grid.columns;
      return own;
    });
    const area = ({ grid: { rows, columns, part } }: Placed): number => (part[2] * part[3]) / (rows * columns);
    this.#placed = placed.sort((a, b) => area(a) - area(b) || a.first - b.first);
  }

  /** Masses of keys as cells of the same sum. */
  spread(masses: Float64Array): Float64Array {
    if (this.cellsArePatches) return Float64Array.from(this.keys, (key) => masses[key]!);
    const cells = new Float64Array(this.rows * this.columns);
    for (const { first, grid, down, across } of this.#placed) {
      for (let patch = 0; patch < grid.rows * grid.columns; patch++) {
        const mass = masses[this.keys[first + patch]!]!;
        const [ownDown, ownAcross] = [down[Math.floor(patch / grid.columns)]!, across[patch % grid.columns]!];
        for (let row = 0; row < this.rows; row++) {
          if (!ownDown[row]) continue;
          for (let column = 0; column < this.columns; column++) {
            cells[row * this.columns + column]! += mass * ownDown[row]! * ownAcross[column]!;
          }
        }
      }
    }
    return cells;
  }

  /** The highest value of the patches at each cell's centre; NaN where there is none. */
  highest(values: ArrayLike<number>): Float64Array {
    const cells = new Float64Array(this.rows * this.columns).fill(NaN);
    for (const { at } of this.#placed) {
      at.forEach((patch, cell) => {
        const value = patch < 0 ? NaN : values[this.keys[patch]!]!;
        if (!(cells[cell]! >= value) && !Number.isNaN(value)) cells[cell] = value;
      });
    }
    return cells;
  }

  /** Numbers of the patches at a cell's centre, the smallest first. */
  patchesAt(cell: number): number[] {
    return this.#placed.map(({ at }) => at[cell]!).filter((patch) => patch >= 0);
  }
}

function numCells(sides: readonly (readonly [number, number])[], pixels: number): number {
  const finest = Math.max(...sides.map(([patches, length]) => Math.ceil(patches / length - ROUNDING)));
  return Math.min(finest, pixels, MOST_CELLS);
}

function shares(patches: number, first: number, length: number, cells: number): Float64Array[] {
  const borders = Float64Array.from({ length: cells + 1 }, (_, i) => {
    const border = ((i / cells - first) * patches) / length;
    return Math.abs(border - Math.round(border)) < ROUNDING ? Math.round(border) : border;
  });
  return Array.from({ length: patches }, (_, patch) =>
    Float64Array.from({ length: cells }, (_, cell) =>
      Math.max(Math.min(borders[cell + 1]!, patch + 1) - Math.max(borders[cell]!, patch), 0),
    ),
  );
}
