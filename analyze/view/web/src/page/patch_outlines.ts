/** Outlines of patches on a canvas that shows a picture as a person sees it. */
import type { Cells } from "../measures/picture_map";
import type { CameraDocument } from "../store/documents";
import { placeOfPatch } from "./overlay";

/** Lines along the border of the member patches. */
export function strokePatches(
  context: CanvasRenderingContext2D,
  { map, view, canvas }: { map: Cells; view: CameraDocument; canvas: HTMLCanvasElement },
  member: (patch: number) => boolean,
  colour: string,
  width: number,
): void {
  const { rows, columns } = map;
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.beginPath();
  for (let patch = 0; patch < rows * columns; patch++) {
    if (!member(patch)) continue;
    const [left, top, across, down] = placeOfPatch(patch, map, view);
    const [x, y] = [left * canvas.width, top * canvas.height];
    const [right, bottom] = [x + across * canvas.width, y + down * canvas.height];
    const row = Math.floor(patch / columns);
    const column = patch % columns;
    const is = (r: number, c: number): boolean => r >= 0 && c >= 0 && r < rows && c < columns && member(r * columns + c);
    const side = view.mirrored ? 1 : -1;
    const over = view.upright ? -1 : 1;
    const line = (x0: number, y0: number, x1: number, y1: number): void => {
      context.moveTo(x0, y0);
      context.lineTo(x1, y1);
    };
    if (!is(row, column + side)) line(x, y, x, bottom);
    if (!is(row, column - side)) line(right, y, right, bottom);
    if (!is(row + over, column)) line(x, y, right, y);
    if (!is(row - over, column)) line(x, bottom, right, bottom);
  }
  context.stroke();
}

/** The patches on the straight line between two, so that a quick stroke of a brush has no gaps. */
export function patchesBetween(from: number, to: number, columns: number): number[] {
  const [row, column] = [Math.floor(from / columns), from % columns];
  const [down, across] = [Math.floor(to / columns) - row, (to % columns) - column];
  const steps = Math.max(Math.abs(down), Math.abs(across), 1);
  const patches = new Set<number>();
  for (let i = 0; i <= steps; i++) {
    patches.add((row + Math.round((i * down) / steps)) * columns + column + Math.round((i * across) / steps));
  }
  return [...patches];
}
