/** One episode: its attributes, and what is read of its arrays. Everything comes from the workers and is kept a while. */
import type { ArrayName } from "./array_reader";
import { type UniformKeys, storedPlaces } from "../grouping/key_counts";
import { ByteCache } from "./cache";
import type { AxesDocument, EpisodeDocument, PromptDocument, RootDocument, SiteDocument } from "./documents";
import { numKeys, parseAxes } from "./documents";
import { StoreError } from "./errors";
import { ARRAY_IN_PAGE_BYTES, DOCUMENT_BYTES } from "./limits";
import type {
  Atoms,
  Coverage,
  HeadRows,
  KeyRole,
  MeanRows,
  Picture,
  RowBlock,
  Selection,
  Series,
  SiteInfo,
} from "./episode_values";
import type { Place } from "./messages";
import { promptAtSite } from "./prompt_at_site";
import type { Found, ReaderPool } from "./reader_pool";

/** What the page keeps of what workers gave it, over all episodes. */
const KEPT_BYTES = 192_000_000;
const kept = new ByteCache<Promise<unknown>>(KEPT_BYTES);

export type * from "./episode_values";

const product = (shape: readonly number[]): number => shape.reduce((all, extent) => all * extent, 1);

export class Episode {
  readonly numReplans: number;
  readonly sites: readonly SiteInfo[];

  private constructor(
    readonly root: RootDocument,
    readonly name: string,
    readonly document: EpisodeDocument,
    axes: ReadonlyMap<string, AxesDocument>,
    private readonly place: Place,
    private readonly pool: ReaderPool,
  ) {
    this.numReplans = document.num_replans;
    this.sites = root.sites.filter((site) => axes.has(site.name)).map((site) => this.#site(site, axes.get(site.name)!));
    if (!this.sites.length) throw new StoreError(`Episode ${name} has no attention: its attributes list no rows.`);
  }

  /** Read the axes of the episode's sites, and compare the attributes with each other. */
  static async open(root: RootDocument, name: string, document: EpisodeDocument, place: Place, pool: ReaderPool): Promise<Episode> {
    const named = root.sites.filter((site) => `${site.name}/rows` in document.arrays);
    const axes = await Promise.all(
      named.map(async (site) => {
        const where = `the zarr.json of ${site.name}`;
        return [site.name, parseAxes(await pool.document(place, `${site.name}/zarr.json`, DOCUMENT_BYTES), where)] as const;
      }),
    );
    return new Episode(root, name, document, new Map(axes), place, pool);
  }

  #site(layout: SiteDocument, axes: AxesDocument): SiteInfo {
    const { recording } = this.root;
    const numActionQueries = layout.num_action_queries || recording.num_action_queries;
    const numQueries = { mean: 1, steps: recording.num_pools, all: numActionQueries }[recording.queries];
    const segments = this.document.segments[layout.name] ?? [];
    const keys = numKeys(layout);
    const expected = [this.numReplans, axes.layer.length, axes.denoise.length, axes.head.length, numQueries, keys];
    const given = this.document.arrays[`${layout.name}/rows`]!.shape;
    if (given.join() !== expected.join() || product(expected) === 0) {
      throw new StoreError(
        `The rows of site ${layout.name} have the shape (${given.join(", ")}); the attributes say (${expected.join(", ")}).`,
      );
    }
    const uniformShape = this.#uniformShape(`${layout.name}/uniform`, expected);
    const { layer: layers, denoise, head: heads } = axes;
    return { layout, keys, layers, denoise, heads, numQueries, segments, uniformShape };
  }

  #uniformShape(path: string, rows: readonly number[]): readonly number[] {
    const given = this.document.arrays[path]?.shape;
    if (!given) throw new StoreError(`Episode ${this.name} has no array ${path}, which every store has.`);
    const last = rows.length - 1;
    if (given.length !== rows.length || given.some((extent, axis) => extent !== rows[axis] && (axis === last || extent !== 1))) {
      throw new StoreError(
        `The array ${path} has the shape (${given.join(", ")}); expected (${rows.join(", ")}), or 1 in place of a length but the last.`,
      );
    }
    return given;
  }

  /** A site by its name. */
  site(name: string): SiteInfo {
    const found = this.sites.find((site) => site.layout.name === name);
    if (!found) throw new StoreError(`Episode ${this.name} has no site ${name}.`);
    return found;
  }

  /** The site that is shown first: the first one that has cameras, else the first. */
  get firstSite(): SiteInfo {
    return this.sites.find((site) => site.layout.spans.some((span) => span.camera && span.grid)) ?? this.sites[0]!;
  }

  has(path: string): boolean {
    return path in this.document.arrays;
  }

  #array(path: string, type: string, shape?: readonly number[]): ArrayName {
    const given = this.document.arrays[path]?.shape;
    if (!given) throw new StoreError(`Episode ${this.name} has no array ${path}.`);
    if (shape && shape.join() !== given.join()) {
      throw new StoreError(`The array ${path} has the shape (${given.join(", ")}); expected (${shape.join(", ")}).`);
    }
    return { path, type, shape: given };
  }

  #rows(site: SiteInfo): ArrayName {
    return this.#array(`${site.layout.name}/rows`, "float32");
  }

  #once<T>(key: string, bytes: number, read: () => Promise<T>): Promise<T> {
    if (bytes > ARRAY_IN_PAGE_BYTES) {
      return Promise.reject(new StoreError(`What is to be shown of ${this.name} takes ${bytes} bytes, more than a page can hold.`));
    }
    const whole = `${JSON.stringify(this.place)}|${key}`;
    const found = kept.get(whole) as Promise<T> | undefined;
    if (found) return found;
    const reading = read();
    kept.set(whole, reading, bytes + 200);
    reading.catch(() => kept.delete(whole));
    return reading;
  }

  #whole(array: ArrayName, bytesOfItem: number): Promise<Found> {
    const [first = 1] = array.shape;
    return this.#once(array.path, product(array.shape) * bytesOfItem, () =>
      this.pool.values(this.place, { kind: "part", array, first: 0, count: first }),
    );
  }

  /** Roles of all keys at all replans. */
  async keyRole(site: string): Promise<KeyRole> {
    const { keys } = this.site(site);
    const found = await this.#whole(this.#array(`${site}/key_role`, "uint8", [this.numReplans, keys]), 1);
    return { replans: this.numReplans, keys, codes: found.values as Uint8Array };
  }

  /** How many replans a chunk of a site's rows holds. */
  async replansPerChunk(site: string): Promise<number> {
    const array = this.#rows(this.site(site));
    const found = await this.#once(`${array.path}|chunk`, 100, () => this.pool.values(this.place, { kind: "chunk", array }));
    return found.values[0]!;
  }

  /** The rows of one layer and denoise step (positions) of the chunk that holds a replan. */
  async rows(site: string, layer: number, denoise: number, replan: number): Promise<RowBlock> {
    const info = this.site(site);
    const array = this.#rows(info);
    const found = await this.pool.values(this.place, { kind: "rows", array, layer, denoise, replan }, layer);
    return {
      firstReplan: found.first,
      replans: found.count,
      heads: info.heads.length,
      queries: info.numQueries,
      keys: info.keys,
      values: found.values as Float32Array,
    };
  }

  /** All rows of one layer and denoise step, chunk by chunk. */
  async *allRows(site: string, layer: number, denoise: number): AsyncGenerator<RowBlock> {
    for (let replan = 0; replan < this.numReplans; ) {
      const block = await this.rows(site, layer, denoise, replan);
      yield block;
      replan = block.firstReplan + block.replans;
    }
  }

  /** The mean of values like rows over a selection, (count, key); computed once. */
  #meansOf(array: ArrayName, selection: Selection, first: number, count: number): Promise<Float64Array> {
    const { layers, denoise, heads, query } = selection;
    const key = ["mean", array.path, layers, denoise, heads, query, first, count].join("|");
    const size = count * array.shape[5]!;
    return this.#once(key, size * 8, async () => {
      const asked = [];
      for (let which = 0; which < this.pool.size; which++) {
        const cells = layers
          .filter((layer) => layer % this.pool.size === which)
          .flatMap((layer) => denoise.map((step): [number, number] => [layer, step]));
        if (!cells.length) continue;
        const question = { kind: "sum", array, cells, heads: [...heads], query, first, count } as const;
        asked.push(this.pool.values(this.place, question, which));
      }
      const parts = await Promise.all(asked);
      const mean = new Float64Array(size);
      const number = layers.length * denoise.length * heads.length;
      for (let i = 0; i < mean.length; i++) {
        let sum = 0;
        for (const part of parts) sum += part.values[i]!;
        mean[i] = sum / number;
      }
      if (mean.some(Number.isNaN)) throw new StoreError(`Values of ${array.path} are missing: the store is damaged.`);
      return mean;
    });
  }

  /** The mean row (key) of a replan over a selection. Only its chunks are read. */
  meanRow(site: string, selection: Selection, replan: number): Promise<Float64Array> {
    return this.#meansOf(this.#rows(this.site(site)), selection, replan, 1);
  }

  /** The mean rows of the whole episode over a selection: `mean_rows` of analyze/measures/patch_maps.py. */
  async meanRows(site: string, selection: Selection): Promise<MeanRows> {
    const info = this.site(site);
    const values = await this.#meansOf(this.#rows(info), selection, 0, this.numReplans);
    return { replans: this.numReplans, keys: info.keys, values };
  }

  /** The same of uniform attention, of each replan or once. */
  async uniformKeys(site: string, selection: Selection): Promise<UniformKeys> {
    const { keys, uniformShape } = this.site(site);
    const [replans] = uniformShape as [number];
    const array = this.#array(`${site}/uniform`, "float32");
    const values = await this.#meansOf(array, storedPlaces(uniformShape, selection), 0, replans);
    return Array.from({ length: replans }, (_, replan) => values.subarray(replan * keys, (replan + 1) * keys));
  }

  /** The rows of every head at some layers, mean over denoise steps and the query, of one replan. */
  async headRows(site: string, of: Omit<Selection, "heads">, replan: number): Promise<HeadRows> {
    const info = this.site(site);
    const { layers, denoise, query } = of;
    const size = info.heads.length * info.keys;
    const key = ["heads", site, layers, denoise, query, replan].join("|");
    const values = await this.#once(key, layers.length * size * 4, async () => {
      const result = new Float32Array(layers.length * size);
      const array = this.#rows(info);
      const asked = [];
      for (let which = 0; which < this.pool.size; which++) {
        const own = [...layers.keys()].filter((i) => layers[i]! % this.pool.size === which);
        if (!own.length) continue;
        const numbers = own.map((i) => layers[i]!);
        const question = { kind: "heads", array, layers: numbers, denoise: [...denoise], query, replan } as const;
        asked.push(
          this.pool.values(this.place, question, which).then((found) => {
            own.forEach((i, part) => {
              for (let j = 0; j < size; j++) result[i * size + j] = found.values[part * size + j]! / denoise.length;
            });
          }),
        );
      }
      await Promise.all(asked);
      return result;
    });
    return { layers, heads: info.heads.length, keys: info.keys, values };
  }

  /** Masses of the segments, mean over the stored queries or of one query. */
  async atoms(site: string, query: number | "mean" = "mean"): Promise<Atoms> {
    const info = this.site(site);
    const axes = [this.numReplans, info.layers.length, info.denoise.length, info.heads.length] as const;
    const segments = info.segments.length;
    const array = this.#array(`${site}/atoms`, "float32", [...axes, info.numQueries, segments]);
    const found = await this.#once(`${array.path}|${query}`, product(axes) * segments * 4, () =>
      this.pool.values(this.place, { kind: "queries", array, query }, 1),
    );
    const [replans, layers, denoise, heads] = axes;
    return { replans, layers, denoise, heads, segments, values: found.values as Float32Array };
  }

  /** A stored picture, as the model sees it; null where none was stored. */
  async frame(camera: string, replan: number): Promise<Picture | null> {
    const path = `frames/${camera}`;
    if (!this.has(path)) return null;
    const array = this.#array(path, "uint8");
    const [replans, height, width, channels] = array.shape;
    if (array.shape.length !== 4 || replans !== this.numReplans || channels !== 3) {
      throw new StoreError(`The array ${path} has the shape (${array.shape.join(", ")}), which is none of pictures.`);
    }
    const size = height! * width! * 3;
    const found = await this.#once(`${path}|${replan}`, size, () =>
      this.pool.values(this.place, { kind: "part", array, first: replan, count: 1 }, 1),
    );
    return { height: height!, width: width!, values: found.values as Uint8Array };
  }

  /** What the objects cover of a camera's patches, at all replans; null where that is not known. */
  async coverage(camera: string): Promise<Coverage | null> {
    const path = `objects/${camera}`;
    const objects = this.document.objects.length;
    if (!this.has(path) || !objects) return null;
    const array = this.#array(path, "float32");
    const [replans, patches, last] = array.shape;
    if (array.shape.length !== 3 || replans !== this.numReplans || last !== objects) {
      throw new StoreError(`The array ${path} has the shape (${array.shape.join(", ")}), which is none of coverage.`);
    }
    const found = await this.#whole(array, 4);
    return { replans, patches: patches!, objects, values: found.values as Float32Array };
  }

  /** State or actions of all replans; null where they are not known. */
  async series(path: "state" | "actions"): Promise<Series | null> {
    if (!this.has(path)) return null;
    const array = this.#array(path, "float64");
    if (array.shape[0] !== this.numReplans) throw new StoreError(`The array ${path} has another number of replans.`);
    const found = await this.#whole(array, 8);
    const size = product(array.shape.slice(1));
    return { replans: this.numReplans, size, shape: array.shape, values: found.values as Float64Array };
  }

  /** Changes of the normalised actions under the conditions of `document.effects`, (entry, step, dimension); null without any. */
  async effectChanges(): Promise<{ values: Float32Array; shape: readonly number[] } | null> {
    const { effects, arrays } = this.document;
    if (!effects?.replan.length) return null;
    if (8 * effects.conditions.length * this.numReplans > ARRAY_IN_PAGE_BYTES) {
      throw new StoreError(`${effects.conditions.length} conditions at ${this.numReplans} replans are more than a page can hold.`);
    }
    const [, horizon, size] = arrays.actions?.shape ?? [];
    if (horizon === undefined || size !== effects.units.length) {
      throw new StoreError(`The effects of ${this.name} have ${effects.units.length} units, and its actions ${size ?? 0} dimensions.`);
    }
    const array = this.#array("effects/change", "float32", [effects.replan.length, horizon, size]);
    return { values: (await this.#whole(array, 4)).values as Float32Array, shape: array.shape };
  }

  /** A prompt with its pieces at the keys of a site. */
  promptOf(layout: SiteDocument, prompt: PromptDocument): PromptDocument {
    return promptAtSite(this.root.sites, layout, prompt);
  }
}
