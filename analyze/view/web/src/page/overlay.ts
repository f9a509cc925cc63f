/**
 * Attention laid over a picture: values of patches, their scale (as analyze/core/camera_maps.py), and pixels (as
 * analyze/show/patch_pictures.py). Pure functions.
 */
import type { Cells, PictureMap } from "../measures/picture_map";
import { keyRanks, overUniform } from "../measures/ranks";
import type { CameraDocument } from "../store/documents";
import type { Picture } from "../store/episode";
import type { Measure } from "./state";

/** Part of the picture's own colour that is kept, so that a yellow cup does not look like a bright patch. */
const COLOUR_KEPT = 0.35;
/** Grey that stands for a picture that was not stored. */
const NO_PICTURE = 205;
const TOP_QUANTILE = 0.995;
const LEAST_TOP = 4;

/** 0 is transparent, `high` and more have the last colour. `uniform`: what uniform attention gives. */
export interface Scale {
  readonly high: number;
  readonly uniform: number | null;
  readonly label: string;
  readonly unit: string;
}

/**
 * What is shown of every cell of a camera's map: per cent of the attention, lift over uniform attention (as `keyLifts`), or
 * the highest rank of a patch there in per cent. `row`, `valid` and `uniform` are of keys.
 */
export function shownValues(map: PictureMap, row: Float64Array, valid: Uint8Array, uniform: Float64Array, measure: Measure): Float64Array {
  if (measure === "raw") return map.spread(row).map((value) => 100 * value);
  if (measure === "rank") return map.highest(keyRanks(row, valid)).map((rank) => 100 * rank);
  const ofValid = overUniform(row, valid, uniform);
  const given = map.spread(uniform.map((value, key) => (valid[key] ? value : 0)));
  return map.spread(row).map((value, cell) => (given[cell]! > 0 ? value / given[cell]! / ofValid : NaN));
}

function roundUp(value: number): number {
  const step = 10 ** (Math.floor(Math.log10(value)) - 1);
  return Number((Math.ceil(Number((value / step).toFixed(9))) * step).toPrecision(12));
}

/** The linear quantile of finite values, as numpy's; 0 where there is none. */
export function quantile(values: readonly number[] | Float64Array, part: number): number {
  const sorted = Float64Array.from(values).filter(Number.isFinite).sort();
  if (!sorted.length) return 0;
  const place = part * (sorted.length - 1);
  const below = Math.floor(place);
  const above = Math.min(below + 1, sorted.length - 1);
  return sorted[below]! + (place - below) * (sorted[above]! - sorted[below]!);
}

/** One scale for values that are compared. `uniform`: what uniform attention gives a patch, of the measure `raw`. */
export function scaleFor(values: readonly number[] | Float64Array, measure: Measure, uniform: number): Scale {
  if (measure === "rank") return { high: 100, uniform: null, label: "rank among the valid keys", unit: "%" };
  const even = measure === "lift" ? 1 : uniform;
  const high = roundUp(Math.max(quantile(values, TOP_QUANTILE), LEAST_TOP * even, Number.MIN_VALUE));
  return measure === "lift"
    ? { high, uniform: 1, label: "lift: attention on a patch / what uniform attention gives it", unit: "" }
    : { high, uniform: even, label: "share of all attention on a patch", unit: "%" };
}

/** The cell of a map on which a pixel or a pointer lies, in the stored picture; all in 0 to 1. */
export function patchAt(x: number, y: number, grid: Cells, view: CameraDocument): number {
  const across = view.mirrored ? 1 - x : x;
  const down = view.upright ? y : 1 - y;
  const column = Math.min(grid.columns - 1, Math.max(0, Math.floor(across * grid.columns)));
  const row = Math.min(grid.rows - 1, Math.max(0, Math.floor(down * grid.rows)));
  return row * grid.columns + column;
}

/** Where a cell is shown: its left, top, width and height in parts of the picture. */
export function placeOfPatch(patch: number, { rows, columns }: Cells, view: CameraDocument): [number, number, number, number] {
  const column = patch % columns;
  const row = (patch - column) / columns;
  const across = view.mirrored ? columns - 1 - column : column;
  const down = view.upright ? row : rows - 1 - row;
  return [across / columns, down / rows, 1 / columns, 1 / rows];
}

/** Places of pixels' centres between patch centres along one axis: the patch before, the one after, and the part. */
function between(pixels: number, cells: number, smooth: boolean): { before: Int32Array; after: Int32Array; part: Float64Array } {
  const before = new Int32Array(pixels);
  const after = new Int32Array(pixels);
  const part = new Float64Array(pixels);
  for (let i = 0; i < pixels; i++) {
    const centre = ((i + 0.5) * cells) / pixels;
    if (!smooth) {
      before[i] = after[i] = Math.floor(centre);
      continue;
    }
    const place = Math.min(Math.max(centre - 0.5, 0), cells - 1);
    before[i] = Math.floor(place);
    after[i] = Math.min(before[i]! + 1, cells - 1);
    part[i] = place - before[i]!;
  }
  return { before, after, part };
}

export interface Painting {
  readonly scale: Scale;
  readonly colours: Uint8Array;
  readonly opacity: number;
  readonly smooth: boolean;
}

/**
 * A picture with attention over it as a person sees the scene, RGBA (row, column, 4).
 *
 * `values`: of the map's cells, in the stored order; NaN leaves the picture as it is.
 */
export function overlayPixels(
  frame: Picture | null,
  values: Float64Array,
  grid: PictureMap,
  view: CameraDocument,
  { scale, colours, opacity, smooth }: Painting,
): { height: number; width: number; pixels: Uint8ClampedArray<ArrayBuffer> } {
  const height = frame ? frame.height : grid.height;
  const width = frame ? frame.width : grid.width;
  const pixels = new Uint8ClampedArray(height * width * 4);
  const down = between(height, grid.rows, smooth);
  const across = between(width, grid.columns, smooth);
  for (let row = 0; row < height; row++) {
    const shownRow = view.upright ? row : height - 1 - row;
    const above = down.before[row]! * grid.columns;
    const below = down.after[row]! * grid.columns;
    const lower = down.part[row]!;
    for (let column = 0; column < width; column++) {
      const left = across.before[column]!;
      let value = values[above + left]!;
      if (smooth) {
        const right = across.after[column]!;
        const part = across.part[column]!;
        const high = (1 - part) * value + part * values[above + right]!;
        const low = (1 - part) * values[below + left]! + part * values[below + right]!;
        value = (1 - lower) * high + lower * low;
      }
      const source = (row * width + column) * 3;
      let red = NO_PICTURE;
      let green = NO_PICTURE;
      let blue = NO_PICTURE;
      if (frame) {
        red = frame.values[source]!;
        green = frame.values[source + 1]!;
        blue = frame.values[source + 2]!;
      }
      const grey = 0.299 * red + 0.587 * green + 0.114 * blue;
      const place = Number.isNaN(value) ? 0 : Math.min(Math.max(value / scale.high, 0), 1);
      const colour = 3 * Math.min(255, Math.floor(place * 256));
      const over = opacity * place;
      const under = 1 - over;
      const at = (shownRow * width + (view.mirrored ? width - 1 - column : column)) * 4;
      pixels[at] = under * (COLOUR_KEPT * red + (1 - COLOUR_KEPT) * grey) + over * colours[colour]!;
      pixels[at + 1] = under * (COLOUR_KEPT * green + (1 - COLOUR_KEPT) * grey) + over * colours[colour + 1]!;
      pixels[at + 2] = under * (COLOUR_KEPT * blue + (1 - COLOUR_KEPT) * grey) + over * colours[colour + 2]!;
      pixels[at + 3] = 255;
    }
  }
  return { height, width, pixels };
}

/** How a camera's picture was turned; as stored where the policy does not say. */
export function viewOf(cameras: readonly CameraDocument[], name: string): CameraDocument {
  return cameras.find((camera) => camera.name === name) ?? { name, source: name, upright: true, mirrored: false, visible: 1 };
}

/** How the pictures were turned for display, in a sentence; empty when they are shown as stored. */
export function orientationNote(views: readonly CameraDocument[], missing: readonly string[]): string {
  const notes: string[] = [];
  const which = (those: readonly CameraDocument[]): string =>
    those.length === views.length ? "Pictures are" : `${those.map((view) => view.name).join(", ")}:`;
  const mirrored = views.filter((view) => view.mirrored);
  const turned = views.filter((view) => !view.upright);
  if (mirrored.length) notes.push(`${which(mirrored)} shown as the scene is; the model sees left and right exchanged.`);
  if (turned.length) notes.push(`${which(turned)} shown right way up; the model sees them upside down.`);
  if (missing.length) notes.push(`No pictures were stored of ${missing.join(", ")}: attention alone, on grey.`);
  return notes.join(" ");
}
