/** What is below the pointer: a patch's share and objects, or a word and the heads that read it most. */
import { ofReplan } from "../grouping/resolve";
import { PictureMap } from "../measures/picture_map";
import type { HeadRows } from "../store/episode";
import { sentenceOf } from "../store/errors";
import { uniformKeys } from "./baselines";
import { element } from "./dom";
import { itemsOfWords, wordEffect } from "./effect_words";
import { formatNumber, formatPercent } from "./number_text";
import type { PictureBoard } from "./picture_board";
import type { Shown } from "./shown";
import { measuresOfKeys, type WordStrip } from "./word_strip";

/** Heads whose patches are shown for a word. */
const HEADS_OF_WORD = 3;
/** An object that covers less of a patch is not named. */
const LEAST_COVERED = 0.005;

export interface Reader {
  layer: number;
  head: number;
  mass: number;
}

/** The heads (positions in `rows`) with the most attention on some keys, most first. */
export function headsThatRead(rows: HeadRows, keys: readonly number[], most: number): Reader[] {
  const found: Reader[] = [];
  rows.layers.forEach((layer, i) => {
    for (let head = 0; head < rows.heads; head++) {
      const first = (i * rows.heads + head) * rows.keys;
      found.push({ layer, head, mass: keys.reduce((sum, key) => sum + rows.values[first + key]!, 0) });
    }
  });
  return found.sort((a, b) => b.mass - a.mass).slice(0, most);
}

export interface ObjectOfPatch {
  name: string;
  /** Part of the patch that it covers. */
  covered: number;
  /** Part of the camera's attention that lies on it. */
  share: number;
}

/** The objects that cover the smallest patch at a cell, and the part of the attention on the camera's patches on each. */
export function objectsAt(shown: Shown, camera: string, map: PictureMap, cell: number): ObjectOfPatch[] {
  const coverage = shown.coverage.get(camera);
  const [patch] = map.patchesAt(cell);
  if (!coverage || patch === undefined) return [];
  const first = coverage.replans === 1 ? 0 : shown.replan * coverage.patches * coverage.objects;
  const at = (place: number, thing: number): number => coverage.values[first + place * coverage.objects + thing]!;
  const ofPatches = map.keys.reduce((sum, key) => sum + shown.row[key]!, 0);
  return shown.tokens.objects
    .map(({ name }, thing) => {
      let mass = 0;
      for (let place = 0; place < coverage.patches; place++) mass += shown.row[map.keys[place]!]! * at(place, thing);
      return { name, covered: at(patch, thing), share: mass / ofPatches };
    })
    .filter(({ covered }) => covered >= LEAST_COVERED)
    .sort((a, b) => b.covered - a.covered);
}

export class Inspector {
  readonly host = element("p", { class: "inspector", role: "status", "data-inspector": "" });
  #shown: Shown | null = null;
  #asked = 0;

  constructor(
    private readonly pictures: PictureBoard,
    words: WordStrip,
  ) {
    pictures.onHover((camera, patch) => (patch === null ? this.#clear() : this.#patch(camera, patch)));
    words.onHover((place) => (place === null ? this.#clear() : void this.#word(place)));
  }

  show(shown: Shown): void {
    this.#shown = shown;
    this.#asked++;
    this.#clear();
  }

  #clear(): void {
    this.#asked++;
    this.pictures.preview(null);
    this.host.replaceChildren("Point at a patch or a word.");
  }

  #patch(camera: string, patch: number): void {
    const shown = this.#shown;
    if (!shown) return;
    const map = new PictureMap(shown.site.layout, camera);
    const { columns } = map;
    const { mass, lift } = measuresOfKeys(map.patchesAt(patch).map((place) => map.keys[place]!), shown);
    const image = map.keys.reduce((sum, key) => sum + shown.row[key]!, 0);
    const number = (name: string, value: number, text: string): HTMLElement =>
      element("strong", { "data-number": name, "data-value": String(value) }, text);
    const things = objectsAt(shown, camera, map, patch).map(
      ({ name, covered, share }) => `${name} covers ${formatPercent(covered, 0)} of it and has ${formatPercent(share)} of this picture's attention`,
    );
    this.host.replaceChildren(
      `${camera}, ${map.cellsArePatches ? "patch" : "patches at"} row ${Math.floor(patch / columns)} column ${patch % columns}: `,
      number("patch-mass", mass, formatPercent(mass, 2)),
      " of all attention, ",
      number("patch-share", mass / image, formatPercent(mass / image, 2)),
      " of this picture's, lift ",
      number("patch-lift", lift, formatNumber(lift)),
      things.length ? `. ${things.join("; ")}.` : ".",
    );
  }

  /** What the word does to the action, where words are shaded by that; else nothing. */
  #effect({ effects, state, replan, words }: Shown, place: number): string {
    if (!effects?.known || state.words === "attention") return "";
    const item = itemsOfWords(effects.known, words)[place] ?? null;
    return `${wordEffect(item, effects.known, state.words === "replan" ? replan : null).said}. `;
  }

  async #word(place: number): Promise<void> {
    const shown = this.#shown;
    const word = shown?.words[place];
    if (!shown || !word) return;
    const asked = ++this.#asked;
    const { mass, lift } = measuresOfKeys(word.keys, shown);
    const start = `"${word.text}": ${this.#effect(shown, place)}${formatPercent(mass, 2)} of all attention, lift ${formatNumber(lift)}`;
    this.host.textContent = `${start}.`;
    try {
      const { site, episode, selection, replan } = shown;
      const rows = await episode.headRows(site.layout.name, selection, replan);
      if (asked !== this.#asked) return;
      const best = headsThatRead(rows, word.keys, HEADS_OF_WORD);
      const given = await Promise.all(
        best.map(async ({ layer, head }) => {
          const there = { ...selection, layers: [layer], heads: [head] };
          return ofReplan(await uniformKeys({ ...shown, selection: there }), replan);
        }),
      );
      if (asked !== this.#asked) return;
      const named = best.map(({ layer, head, mass: own }) => `layer ${site.layers[layer]} head ${site.heads[head]} (${formatPercent(own)})`);
      const row = new Float64Array(site.keys);
      const uniform = new Float64Array(site.keys);
      for (const [i, { layer, head }] of best.entries()) {
        const first = (rows.layers.indexOf(layer) * rows.heads + head) * rows.keys;
        for (let key = 0; key < rows.keys; key++) {
          row[key]! += rows.values[first + key]! / best.length;
          uniform[key]! += given[i]![key]! / best.length;
        }
      }
      this.host.textContent = `${start}. The heads that read it most: ${named.join(", ")}; the pictures show where they look.`;
      this.pictures.preview({ row, uniform });
    } catch (failure) {
      if (asked === this.#asked) this.host.textContent = sentenceOf(failure);
    }
  }
}
