/** The cameras' pictures with attention over them: one canvas a camera, with outlines, a brush and a cursor. */
import { ofReplan } from "../grouping/resolve";
import { listing } from "../grouping/text";
import { cameraSpans, keysOfSpans } from "../grouping/tokens";
import { PictureMap } from "../measures/picture_map";
import { finiteMean } from "../measures/masses";
import { overUniform } from "../measures/ranks";
import type { CameraDocument, SpanDocument } from "../store/documents";
import { colourTable } from "./colour_maps";
import { element } from "./dom";
import { type Painting, type Scale, overlayPixels, patchAt, placeOfPatch, scaleFor, shownValues, viewOf } from "./overlay";
import { patchesBetween, strokePatches } from "./patch_outlines";
import type { Shown } from "./shown";

/** `patch`: a cell of the camera's map. */
export type PatchListener = (camera: string, patch: number, replan: number) => void;

export interface Brush {
  paint(camera: string, patches: number[], erase: boolean): void;
  end(): void;
}

interface Outline {
  name: string;
  colour: string;
  members: ReadonlyMap<string, Uint8Array>;
}

/** Another row and what uniform attention gives in its place, (key). */
export interface Previewed {
  row: Float64Array;
  uniform: Float64Array;
}

interface Drawn {
  figure: HTMLElement;
  canvas: HTMLCanvasElement;
  note: HTMLElement;
  painted: HTMLCanvasElement;
  map: PictureMap;
  view: CameraDocument;
  /** The cell of the map below the pointer or the cursor; -1: none. */
  patch: number;
  cursor: boolean;
}

function massOf(row: Float64Array, spans: readonly SpanDocument[]): number {
  return keysOfSpans(spans).reduce((sum, key) => sum + row[key]!, 0);
}

/** What a camera's map adds up and leaves out; empty where its keys are the patches of one grid. `map_note` of patch_maps.py. */
export function mapNote({ row, site }: Pick<Shown, "row" | "site">, camera: string, share: number): string {
  const spans = cameraSpans(site.layout, camera);
  const [placed, others] = [spans.filter((span) => span.grid), spans.filter((span) => !span.grid)];
  const names = (those: readonly SpanDocument[]): string => listing(those.map((span) => span.name));
  const outside = (100 * massOf(row, others)) / share;
  const leavesOut = others.length ? `, ${outside.toFixed(1)}% of that on keys of ${names(others)}, which lie nowhere in the picture` : "";
  return leavesOut + (placed.length > 1 ? `; the map adds ${names(placed)}` : "");
}

/** How many patches of a picture are named for those who cannot see it. */
const NAMED_PATCHES = 3;

export class PictureBoard {
  readonly host = element("div", { class: "pictures" });
  readonly #drawn = new Map<string, Drawn>();
  readonly #outlines = new Map<string, Outline>();
  readonly #clicked = new Set<PatchListener>();
  readonly #hovered = new Set<(camera: string, patch: number | null) => void>();
  #brush: Brush | null = null;
  #painting: { camera: string; last: number; erase: boolean } | null = null;
  #shown: Shown | null = null;
  #preview: Previewed | null = null;
  #scale: Scale | null = null;
  #others: readonly PictureBoard[] = [];

  constructor() {
    new ResizeObserver(() => this.#compose()).observe(this.host);
  }

  cameras(): string[] {
    return [...this.#drawn.keys()];
  }

  /** Called with the scale whenever the pictures are painted. */
  onScale: (scale: Scale | null) => void = () => undefined;

  /** Draw what is shown. */
  show(shown: Shown): void {
    const before = this.#shown;
    this.#shown = shown;
    this.#preview = null;
    const cameras = [...shown.frames.keys()];
    if (before?.site.layout !== shown.site.layout || cameras.join() !== this.cameras().join()) this.#build(shown, cameras);
    this.#paint();
  }

  /** Lay another row over the pictures for a moment; null: that of what is shown. */
  preview(other: Previewed | null): void {
    if (this.#preview === other) return;
    this.#preview = other;
    this.#paint();
  }

  /** Use one colour scale with other boards. */
  shareScale(...others: PictureBoard[]): void {
    this.#others = others;
    this.#paint();
  }

  /** Outline the patches of a group: those with a weight of at least 128 of 255; null removes it. */
  setOutline(id: string, name: string, colour: string, members: ReadonlyMap<string, Uint8Array> | null): void {
    if (members) this.#outlines.set(id, { name, colour, members });
    else if (!this.#outlines.delete(id)) return;
    this.#compose();
  }

  /** While set, a pointer that is dragged over pictures paints patches. */
  brush(on: Brush | null): void {
    this.#brush = on;
    this.host.classList.toggle("brushing", on !== null);
  }

  onPatch(listen: PatchListener): () => void {
    this.#clicked.add(listen);
    return () => this.#clicked.delete(listen);
  }

  /** Be told which patch the pointer or the cursor is on; null: it left. */
  onHover(listen: (camera: string, patch: number | null) => void): () => void {
    this.#hovered.add(listen);
    return () => this.#hovered.delete(listen);
  }

  #build(shown: Shown, cameras: readonly string[]): void {
    this.#drawn.clear();
    this.host.replaceChildren();
    for (const camera of cameras) {
      const map = new PictureMap(shown.site.layout, camera);
      const canvas = element("canvas", { "data-camera": camera, tabindex: 0, role: "img" });
      canvas.style.aspectRatio = `${map.width} / ${map.height}`;
      const note = element("span", { class: "soft" });
      const figure = element("figure", {}, canvas, element("figcaption", {}, camera, " ", note));
      const drawn: Drawn = {
        figure,
        canvas,
        note,
        painted: document.createElement("canvas"),
        map,
        view: viewOf(shown.store.root.policy.cameras, camera),
        patch: -1,
        cursor: false,
      };
      this.#drawn.set(camera, drawn);
      this.#listen(camera, drawn);
      this.host.append(figure);
    }
  }

  #listen(camera: string, drawn: Drawn): void {
    const { canvas } = drawn;
    const patchOf = (event: PointerEvent): number => {
      const box = canvas.getBoundingClientRect();
      return patchAt((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height, drawn.map, drawn.view);
    };
    canvas.addEventListener("pointermove", (event) => {
      const patch = patchOf(event);
      if (this.#painting && this.#brush) this.#paintTo(camera, drawn, patch);
      this.#hover(camera, drawn, patch);
    });
    canvas.addEventListener("pointerleave", () => this.#hover(camera, drawn, -1));
    canvas.addEventListener("pointerdown", (event) => {
      if (!this.#brush) return;
      event.preventDefault();
      canvas.setPointerCapture(event.pointerId);
      this.#painting = { camera, last: -1, erase: event.shiftKey || event.button === 2 };
      this.#paintTo(camera, drawn, patchOf(event));
    });
    const end = (): void => {
      if (this.#painting) this.#brush?.end();
      this.#painting = null;
    };
    canvas.addEventListener("pointerup", end);
    canvas.addEventListener("pointercancel", end);
    canvas.addEventListener("contextmenu", (event) => {
      if (this.#brush) event.preventDefault();
    });
    canvas.addEventListener("click", (event) => {
      if (this.#brush || !this.#shown) return;
      const patch = patchOf(event as PointerEvent);
      this.#hover(camera, drawn, patch);
      for (const listen of this.#clicked) listen(camera, patch, this.#shown.replan);
    });
    canvas.addEventListener("keydown", (event) => this.#key(event, camera, drawn));
    canvas.addEventListener("blur", () => {
      drawn.cursor = false;
      this.#hover(camera, drawn, -1);
    });
  }

  /** Paint from the last patch to this one, so that a quick stroke has no gaps. */
  #paintTo(camera: string, drawn: Drawn, patch: number): void {
    const painting = this.#painting!;
    if (painting.camera !== camera || painting.last === patch) return;
    const from = painting.last < 0 ? patch : painting.last;
    const patches = patchesBetween(from, patch, drawn.map.columns);
    painting.last = patch;
    this.#brush!.paint(camera, patches, painting.erase);
  }

  /** Enter begins the cursor, arrows move it, space paints or clicks, Escape ends it. */
  #key(event: KeyboardEvent, camera: string, drawn: Drawn): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (!drawn.cursor) {
      if (event.key !== "Enter") return;
      drawn.cursor = true;
      this.#hover(camera, drawn, Math.max(drawn.patch, 0));
    } else if (event.key === "Escape") {
      drawn.cursor = false;
      this.#hover(camera, drawn, -1);
    } else if (event.key === " " || event.key === "Enter") {
      if (this.#brush) {
        this.#brush.paint(camera, [drawn.patch], event.shiftKey);
        this.#brush.end();
      } else if (this.#shown) for (const listen of this.#clicked) listen(camera, drawn.patch, this.#shown.replan);
    } else {
      const steps: Record<string, [number, number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
      const step = steps[event.key];
      if (!step) return;
      const [left, top, width, height] = placeOfPatch(drawn.patch, drawn.map, drawn.view);
      const x = Math.min(Math.max(left + (0.5 + step[0]) * width, 0), 1 - width / 2);
      const y = Math.min(Math.max(top + (0.5 + step[1]) * height, 0), 1 - height / 2);
      this.#hover(camera, drawn, patchAt(x, y, drawn.map, drawn.view));
    }
    event.preventDefault();
    event.stopPropagation();
  }

  #hover(camera: string, drawn: Drawn, patch: number): void {
    if (drawn.patch === patch) return;
    drawn.patch = patch;
    this.#compose(camera);
    for (const listen of this.#hovered) listen(camera, patch < 0 ? null : patch);
  }

  /** The values of all shown patches of all replans, where they are known: the scale does not change from one to the next. */
  #patchValues(): { values: number[]; uniform: number } {
    const shown = this.#shown!;
    const { site, state, tokens } = shown;
    const maps = [...this.#drawn.values()].map((drawn) => drawn.map);
    const values: number[] = [];
    const expected: number[] = [];
    const rows = this.#preview ? null : shown.allRows;
    const replans = rows ? shown.episode.numReplans : 1;
    for (let replan = 0; replan < replans; replan++) {
      const row = rows ? rows.subarray(replan * site.keys, (replan + 1) * site.keys) : (this.#preview ?? shown).row;
      const uniform = rows ? ofReplan(shown.allUniform, replan) : (this.#preview ?? shown).uniform;
      const first = rows && tokens.keyRole.replans > 1 ? replan * site.keys : 0;
      const valid = rows ? tokens.valid.subarray(first, first + site.keys) : shown.valid;
      const ofValid = overUniform(row, valid, uniform);
      const given = uniform.map((value, key) => (valid[key] ? value : 0));
      for (const map of maps) {
        for (const value of shownValues(map, row, valid, uniform, state.measure)) values.push(value);
        for (const value of map.spread(given)) expected.push(value > 0 ? 100 * value * ofValid : NaN);
      }
    }
    return { values, uniform: finiteMean(expected) || 0 };
  }

  readonly #scales = new WeakMap<object, Map<string, Scale>>();

  /** The scale of what is shown; computed once for an episode's rows. */
  ownScale(): Scale | null {
    const shown = this.#shown;
    if (!shown || !this.#drawn.size) return null;
    const key = this.#preview?.row ?? shown.allRows ?? shown.row;
    let of = this.#scales.get(key);
    if (!of) this.#scales.set(key, (of = new Map()));
    let scale = of.get(shown.state.measure);
    if (!scale) {
      const { values, uniform } = this.#patchValues();
      scale = scaleFor(values, shown.state.measure, uniform);
      of.set(shown.state.measure, scale);
    }
    return scale;
  }

  #paint(): void {
    const shown = this.#shown;
    if (!shown) return;
    const scales = [this, ...this.#others].map((board) => board.ownScale()).filter((scale): scale is Scale => scale !== null);
    this.#scale = scales.length ? scales.reduce((high, scale) => (scale.high > high.high ? scale : high)) : null;
    this.onScale(this.#scale);
    if (!this.#scale) return;
    const { state } = shown;
    const { row, uniform } = this.#preview ?? shown;
    const painting: Painting = { scale: this.#scale, colours: colourTable(state.colours), opacity: state.opacity, smooth: state.smooth };
    for (const [camera, drawn] of this.#drawn) {
      const { map, view, painted, canvas } = drawn;
      const own = shownValues(map, row, shown.valid, uniform, state.measure);
      const { height, width, pixels } = overlayPixels(shown.frames.get(camera) ?? null, own, map, view, painting);
      painted.width = width;
      painted.height = height;
      painted.getContext("2d")!.putImageData(new ImageData(pixels, width, height), 0, 0);
      canvas.dataset.top = String(this.#scale.high);
      this.#describe(camera, drawn, own);
    }
    this.#compose();
  }

  #describe(camera: string, drawn: Drawn, own: Float64Array): void {
    const shown = this.#shown!;
    const { columns } = drawn.map;
    const best = [...own.keys()].filter((i) => !Number.isNaN(own[i]!)).sort((a, b) => own[b]! - own[a]!);
    const named = best.slice(0, NAMED_PATCHES).map((patch) => `row ${Math.floor(patch / columns)} column ${patch % columns}`);
    const share = massOf(shown.row, cameraSpans(shown.site.layout, camera));
    drawn.note.textContent = `${(100 * share).toFixed(1)}% of the attention${mapNote(shown, camera, share)}`;
    drawn.canvas.dataset.mass = String(share);
    drawn.canvas.setAttribute(
      "aria-label",
      `Camera ${camera} at replan ${shown.replan}: ${(100 * share).toFixed(1)} per cent of the attention; ` +
        `most on the patches ${named.join(", ")} of the stored picture. Enter: move over the patches with the arrow keys.`,
    );
  }

  /** Put pictures, outlines and the cursor on the canvases, at the resolution of the screen. */
  #compose(only?: string): void {
    for (const [camera, drawn] of this.#drawn) {
      if (only !== undefined && only !== camera) continue;
      const { canvas, painted } = drawn;
      const width = Math.round(canvas.clientWidth * devicePixelRatio);
      const height = Math.round(canvas.clientHeight * devicePixelRatio);
      if (!width || !height || !painted.width) continue;
      if (canvas.width !== width || canvas.height !== height) {
        canvas.width = width;
        canvas.height = height;
      }
      const context = canvas.getContext("2d")!;
      context.imageSmoothingEnabled = painted.width >= 128;
      context.drawImage(painted, 0, 0, width, height);
      for (const { colour, members } of this.#outlines.values()) {
        const own = members.get(camera);
        if (own) strokePatches(context, drawn, (patch) => (own[patch] ?? 0) >= 128, colour, 2 * devicePixelRatio);
      }
      const hovered = drawn.patch;
      if (hovered >= 0) {
        strokePatches(context, drawn, (patch) => patch === hovered, "#000", 4 * devicePixelRatio);
        strokePatches(context, drawn, (patch) => patch === hovered, "#fff", 2 * devicePixelRatio);
      }
    }
  }
}
