/** Patches that were painted, as rectangles: as few as possible, which may overlap, as a union of `patch:` may. */

export interface Rectangle {
  readonly r0: number;
  readonly r1: number;
  readonly c0: number;
  readonly c1: number;
}

/** Steps of the search for fewer rectangles; a drawing by hand needs some hundred. */
const MOST_STEPS = 20_000;

/** Rectangles whose union is the mask (row, column). */
export function coveringRectangles(mask: Uint8Array, rows: number, columns: number): Rectangle[] {
  const maximal = maximalRectangles(mask, rows, columns);
  const cells = maximal.map(({ r0, r1, c0, c1 }) => {
    const own: number[] = [];
    for (let row = r0; row < r1; row++) for (let column = c0; column < c1; column++) own.push(row * columns + column);
    return own;
  });
  const covering = new Map<number, number[]>();
  cells.forEach((own, i) => {
    for (const cell of own) {
      const list = covering.get(cell);
      if (list) list.push(i);
      else covering.set(cell, [i]);
    }
  });
  let best = greedy(cells, covering);
  const largest = Math.max(1, ...cells.map((own) => own.length));
  const covered = new Map<number, number>();
  let steps = 0;
  const search = (chosen: number[]): void => {
    if (++steps > MOST_STEPS) return;
    const open = [...covering.keys()].filter((cell) => !covered.get(cell));
    if (!open.length) {
      if (chosen.length < best.length) best = [...chosen];
      return;
    }
    if (chosen.length + Math.ceil(open.length / largest) >= best.length) return;
    // The cell with the fewest rectangles: one of these must be chosen.
    const cell = open.reduce((least, one) => (covering.get(one)!.length < covering.get(least)!.length ? one : least));
    for (const i of covering.get(cell)!) {
      cells[i]!.forEach((own) => covered.set(own, (covered.get(own) ?? 0) + 1));
      search([...chosen, i]);
      cells[i]!.forEach((own) => covered.set(own, covered.get(own)! - 1));
    }
  };
  search([]);
  return best.sort((a, b) => a - b).map((i) => maximal[i]!);
}

/** The rectangle that covers most of what is left, again and again. */
function greedy(cells: readonly number[][], covering: ReadonlyMap<number, number[]>): number[] {
  const open = new Set(covering.keys());
  const chosen: number[] = [];
  while (open.size) {
    const gains = cells.map((own) => own.filter((cell) => open.has(cell)).length);
    const most = gains.indexOf(Math.max(...gains));
    chosen.push(most);
    cells[most]!.forEach((cell) => open.delete(cell));
  }
  return chosen;
}

/** Rectangles of the mask that are part of no larger one, from the top left. */
function maximalRectangles(mask: Uint8Array, rows: number, columns: number): Rectangle[] {
  const found: Rectangle[] = [];
  const full = (row: number, c0: number, c1: number): boolean => {
    if (row < 0 || row >= rows) return false;
    for (let column = c0; column < c1; column++) if (!mask[row * columns + column]) return false;
    return true;
  };
  for (let r0 = 0; r0 < rows; r0++) {
    const whole = new Uint8Array(columns).fill(1);
    for (let r1 = r0 + 1; r1 <= rows; r1++) {
      for (let column = 0; column < columns; column++) whole[column]! &= mask[(r1 - 1) * columns + column]!;
      for (let c0 = 0; c0 < columns; c0++) {
        if (!whole[c0]) continue;
        let c1 = c0;
        while (c1 < columns && whole[c1]) c1++;
        if (!full(r0 - 1, c0, c1) && !full(r1, c0, c1)) found.push({ r0, r1, c0, c1 });
        c0 = c1;
      }
    }
  }
  return found;
}
