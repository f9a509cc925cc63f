/** Changes of a selector's text by clicks: a part more or less in its union, patches painted or erased. */
import {
  type Atom,
  atomText,
  isOperation,
  parseSelector,
  type Selector,
  selectorText,
} from "../grouping/selector_parser";
import { patchRegion } from "../grouping/selectors";
import { attempt, trimmed } from "../grouping/text";
import { cameraSpan } from "../grouping/tokens";
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
 * The selector with patches of a camera painted or erased. The union's `patch:` parts of that camera become as few
 * rectangles as possible, at the place of the first; other parts stay. Null where the camera's name cannot be written.
 */
export function paintedPatches(
  text: string,
  layout: SiteDocument,
  camera: string,
  patches: readonly number[],
  erase: boolean,
): string | null {
  const { rows, columns } = cameraSpan(layout, camera).grid!;
  const mask = new Uint8Array(rows * columns);
  const parts: (Selector | null)[] = [];
  for (const part of partsOf(text)) {
    const region = regionOf(part, layout);
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
    ({ r0, r1, c0, c1 }): Atom => ({ kind: "patch", argument: `${camera}[${r0}:${r1},${c0}:${c1}]` }),
  );
  if (painted.some((atom) => atomText(atom) === null)) return null;
  return unionText(parts.flatMap((part) => (part === null ? painted : [part])));
}

function regionOf(part: Selector, layout: SiteDocument): ReturnType<typeof patchRegion> | null {
  if (typeof part === "string" || isOperation(part) || part.kind !== "patch") return null;
  return attempt(() => patchRegion(part.argument, layout)).value ?? null;
}
