/** Decoded chunks of an episode's arrays, by zarrita, with a cache: what runs in a worker. */
import { Array as ZarrArray, type DataType } from "zarrita";

import { type CheckedArray, checkArray } from "./array_metadata";
import type { ByteSource } from "./byte_source";
import { ByteCache } from "./cache";
import { itemBytes } from "./codecs";
import { NotThere, StoreError } from "./errors";
import { parseDocument } from "./json_fields";
import { DOCUMENT_BYTES } from "./limits";

export type Values = Float32Array | Float64Array | Uint8Array | Int32Array;

/** What the episode's attributes say of an array. */
export interface ArrayName {
  path: string;
  shape: readonly number[];
  type: string;
}

interface Seen {
  read?: boolean;
}

/** A source as zarrita reads it. A file that is missing is an error: zarrita would take it for fill values. */
class ZarrStore {
  constructor(
    private readonly source: ByteSource,
    private readonly most: number,
  ) {}

  async get(key: string, options?: Seen): Promise<Uint8Array> {
    if (options) options.read = true;
    return this.source.whole(key.slice(1), this.most);
  }

  async getRange(
    key: string,
    range: { offset: number; length: number } | { suffixLength: number },
    options?: Seen,
  ): Promise<Uint8Array> {
    if ("suffixLength" in range) return this.source.part(key.slice(1), { suffix: range.suffixLength });
    if (options) options.read = true;
    if (!(range.length <= this.most)) throw new StoreError(`A chunk of ${key.slice(1)} claims ${range.length} bytes.`);
    return this.source.part(key.slice(1), range);
  }
}

interface Opened extends CheckedArray {
  array: ZarrArray<DataType, never>;
}

export class ArrayReader {
  readonly #opened = new Map<string, Promise<Opened>>();
  readonly #chunks: ByteCache<Promise<Values>>;

  constructor(
    private readonly source: ByteSource,
    cacheBytes: number,
  ) {
    this.#chunks = new ByteCache(cacheBytes);
  }

  async #open({ path, shape, type }: ArrayName): Promise<Opened> {
    const document = parseDocument(await this.source.whole(`${path}/zarr.json`, DOCUMENT_BYTES), `the zarr.json of ${path}`);
    const checked = checkArray(document, path, shape, type);
    // Blosc never makes a chunk longer than this.
    const store = new ZarrStore(this.source, checked.chunkBytes + 1024 + checked.chunkBytes / 10);
    return { ...checked, array: new ZarrArray(store as never, `/${path}`, checked.metadata) };
  }

  open(name: ArrayName): Promise<Opened> {
    let opened = this.#opened.get(name.path);
    if (!opened) {
      opened = this.#open(name);
      this.#opened.set(name.path, opened);
      opened.catch(() => this.#opened.delete(name.path));
    }
    return opened;
  }

  /** One decoded chunk, in C order, of the full extent of a chunk. It is shared: nobody may write into it. */
  async chunk(name: ArrayName, place: readonly number[]): Promise<Values> {
    const { array, chunkBytes } = await this.open(name);
    const key = `${name.path}/${place.join(".")}`;
    const kept = this.#chunks.get(key);
    if (kept) return kept;
    const reading = (async () => {
      const seen: Seen = {};
      const { data } = await array.getChunk([...place], seen as never);
      if (!seen.read) throw new NotThere(`A chunk of ${name.path} is missing: the store is damaged.`);
      return data as unknown as Values;
    })();
    this.#chunks.set(key, reading, chunkBytes);
    reading.catch(() => this.#chunks.delete(key));
    return reading;
  }

  /** Copy a chunk's part inside of the array to its place in `target`, which begins at `first` along the first axis. */
  async copyChunk(name: ArrayName, place: readonly number[], target: Values, first: number, count: number): Promise<void> {
    const { chunk } = await this.open(name);
    const values = await this.chunk(name, place);
    const axes = name.shape.length;
    const from = place.map((index, axis) => index * chunk[axis]!);
    const extent = from.map((start, axis) => Math.min(chunk[axis]!, name.shape[axis]! - start));
    const run = extent[axes - 1]!;
    const index = new Array<number>(axes).fill(0);
    for (;;) {
      let source = 0;
      let there = 0;
      for (let axis = 0; axis < axes; axis++) {
        source = source * chunk[axis]! + index[axis]!;
        const shift = axis === 0 ? first : 0;
        there = there * (axis === 0 ? 1 : name.shape[axis]!) + from[axis]! + index[axis]! - shift;
      }
      const row = from[0]! + index[0]!;
      if (row >= first && row < first + count) target.set(values.subarray(source, source + run) as never, there);
      let axis = axes - 2;
      while (axis >= 0 && ++index[axis]! >= extent[axis]!) index[axis--] = 0;
      if (axis < 0) return;
    }
  }

  /** The values of `count` places of the first axis from `first` on, in C order. */
  async part(name: ArrayName, first: number, count: number): Promise<Values> {
    const { chunk } = await this.open(name);
    const inner = name.shape.slice(1).reduce((product, extent) => product * extent, 1);
    const target = emptyValues(name.type, count * inner);
    const range = name.shape.map((extent, axis) => {
      const [low, high] = axis === 0 ? [first, first + count] : [0, extent];
      return [Math.floor(low / chunk[axis]!), Math.ceil(high / chunk[axis]!)] as const;
    });
    const places: number[][] = [];
    const walk = (place: number[]): void => {
      if (place.length === range.length) places.push(place);
      else for (let i = range[place.length]![0]; i < range[place.length]![1]; i++) walk([...place, i]);
    };
    walk([]);
    for (const place of places) await this.copyChunk(name, place, target, first, count);
    return target;
  }
}

function emptyValues(type: string, length: number): Values {
  if (itemBytes(type) === undefined) throw new StoreError(`Arrays of ${type} are not read.`);
  if (type === "float32") return new Float32Array(length);
  if (type === "float64") return new Float64Array(length);
  if (type === "int32") return new Int32Array(length);
  return new Uint8Array(length);
}
