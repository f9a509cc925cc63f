/** Changes of a selector's text by clicks: a part more or less in its union, patches painted or erased. */
import {
  type Atom,
  atomText,
  isOperation,
  parseSelector,
  type Selector,
  selectorText,
} from "../grouping/selector_parser";
import { patchRegion, type PatchRegion } from "../grouping/selectors";
import { attempt, trimmed } from "../grouping/text";
import { type Cells, PictureMap } from "../measures/picture_map";
import type { SiteDocument } from "../store/documents";
import { coveringRectangles } from "./rectangles";

/** The parts of a union, left to right; throws `SelectorError` for text that cannot be read. */
function partsOf(text: string): Selector[] {
  if (!trimmed(text)) return [];
  const parts: Selector[] = [];
  let tree = parseSelector(text);
  while (isOperation(tree) && tree.operator === "|") {
    parts.unshift(tree.right);
    tree = tree.left;
  }
  return [tree, ...parts];
}

function unionText(parts: readonly Selector[]): string {
  if (!parts.length) return "";
  return selectorText(parts.slice(1).reduce((left, right) => ({ operator: "|", left, right }), parts[0]!));
}

/**
 * The selector with a part added to its union, or taken out where it is there already; null where the part cannot be
 * written. Throws `SelectorError` for text that cannot be read.
 */
export function toggledPart(text: string, atom: Atom): string | null {
  const own = atomText(atom);
  if (own === null) return null;
  const parts = partsOf(text);
  const left = parts.filter((part) => selectorText(part) !== own);
  return unionText(left.length < parts.length ? left : [...parts, atom]);
}

/** Whether a part is in the selector's union. */
export function hasPart(text: string, atom: Atom): boolean {
  const own = atomText(atom);
  return attempt(() => partsOf(text).some((part) => selectorText(part) === own)).value ?? false;
}

/**
 * The selector with cells of a camera's map painted or erased. The union's `patch:` parts of that camera whose borders are
 * those of cells become as few rectangles as possible, at the place of the first; other parts stay. Null where the camera's
 * name cannot be written.
 */
export function paintedPatches(
  text: string,
  layout: SiteDocument,
  camera: string,
  patches: readonly number[],
  erase: boolean,
): string | null {
  const { rows, columns, cellsArePatches } = new PictureMap(layout, camera);
  const mask = new Uint8Array(rows * columns);
  const parts: (Selector | null)[] = [];
  for (const part of partsOf(text)) {
    const region = regionOf(part, layout, { rows, columns });
    if (region?.camera !== camera) {
      parts.push(part);
      continue;
    }
    for (let row = region.r0; row < region.r1; row++) mask.fill(1, row * columns + region.c0, row * columns + region.c1);
    if (!parts.includes(null)) parts.push(null); // the place of the rectangles
  }
  for (const patch of patches) mask[patch] = erase ? 0 : 1;
  if (!parts.includes(null)) parts.push(null);
  const painted = coveringRectangles(mask, rows, columns).map(
    ({ r0, r1, c0, c1 }): Atom => {
      const [a, b, c, d] = cellsArePatches ? [r0, r1, c0, c1] : [r0 / rows, r1 / rows, c0 / columns, c1 / columns].map(decimal);
      return { kind: "patch", argument: `${camera}[${a}:${b},${c}:${d}]` };
    },
  );
  if (painted.some((atom) => atomText(atom) === null)) return null;
  return unionText(parts.flatMap((part) => (part === null ? painted : [part])));
}

function decimal(part: number): string {
  return Number.isInteger(part) ? part.toFixed(1) : String(part);
}

/** The region of a `patch:` part in cells; null where its borders are not those of cells. */
function regionOf(part: Selector, layout: SiteDocument, { rows, columns }: Cells): PatchRegion | null {
  if (typeof part === "string" || isOperation(part) || part.kind !== "patch") return null;
  const region = attempt(() => patchRegion(part.argument, layout)).value;
  if (!region) return null;
  if (!region.fractions) return new PictureMap(layout, region.camera).cellsArePatches ? region : null;
  const inCells = (side: number, cells: number): number => (Math.round(side * cells) / cells === side ? Math.round(side * cells) : NaN);
  const [r0, r1] = [inCells(region.r0, rows), inCells(region.r1, rows)];
  const [c0, c1] = [inCells(region.c0, columns), inCells(region.c1, columns)];
  return Number.isNaN(r0 + r1 + c0 + c1) ? null : { ...region, r0, r1, c0, c1 };
}
