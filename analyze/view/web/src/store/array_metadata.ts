/** The `zarr.json` of an array, compared with what the episode's attributes say, before zarrita believes it. */
import type { ArrayMetadata, DataType } from "zarrita";

import { itemBytes } from "./codecs";
import { StoreError, visible } from "./errors";
import { type Fields, list, object, wholes } from "./json_fields";
import { ARRAY_AXES, CLAIMED_BYTES } from "./limits";

export interface CheckedArray {
  metadata: ArrayMetadata<DataType>;
  /** Shape of what is decoded at once: the chunks inside of a shard, or the array's chunks. */
  chunk: number[];
  /** Bytes of one decoded chunk. */
  chunkBytes: number;
}

const product = (shape: readonly number[]): number => shape.reduce((all, extent) => all * extent, 1);

function namesOf(codecs: unknown, where: string): string[] {
  return list(codecs, where, 4).map((each, i) => String(object(each, `${where}[${i}]`).name));
}

function refuse(path: string, what: string): never {
  throw new StoreError(`The array ${visible(path)} cannot be shown: ${what}.`);
}

const CHAIN = "bytes blosc crc32c";

/** Check an array's document: format, shape, type, chunks, codecs, and how much memory a chunk takes. */
export function checkArray(document: unknown, path: string, shape: readonly number[], type: string): CheckedArray {
  const fields = object(document, `the zarr.json of ${path}`);
  const found = wholes(fields.shape, `the shape of ${path}`, ARRAY_AXES, 2 ** 40);
  if (fields.node_type !== "array" || fields.zarr_format !== 3) refuse(path, "its zarr.json is not one of an array");
  if (found.join() !== shape.join()) refuse(path, `its shape is (${found}), the episode says (${shape.join()})`);
  if (fields.data_type !== type) refuse(path, `its type is ${visible(String(fields.data_type))}, expected ${type}`);
  const grid = object(fields.chunk_grid, `the chunk_grid of ${path}`);
  const extents = (of: Fields, where: string): number[] => {
    const own = wholes(object(of, where).chunk_shape, where, ARRAY_AXES, 2 ** 40, 1);
    if (own.length !== shape.length) refuse(path, "its chunks have another number of axes");
    return own;
  };
  if (grid.name !== "regular") refuse(path, "its chunks are not regular");
  const outer = extents(grid.configuration as Fields, `the chunks of ${path}`);
  const encoding = object(fields.chunk_key_encoding, `the chunk_key_encoding of ${path}`);
  if (encoding.name !== "default") refuse(path, "its chunks have other names");
  const codecs = namesOf(fields.codecs, `the codecs of ${path}`);
  let chunk = outer;
  if (codecs.length === 1 && codecs[0] === "sharding_indexed") {
    const sharding = object((fields.codecs as Fields[])[0]!.configuration, `the shards of ${path}`);
    chunk = extents(sharding, `the chunks of ${path}`);
    if (outer.some((extent, i) => extent % chunk[i]! !== 0)) refuse(path, "its chunks do not fit into its shards");
    const inner = namesOf(sharding.codecs, `the codecs of ${path}`).join(" ");
    const index = namesOf(sharding.index_codecs, `the codecs of the index of ${path}`).join(" ");
    if (inner !== CHAIN || index !== "bytes crc32c" || (sharding.index_location ?? "end") !== "end") {
      refuse(path, `its codecs are ${visible(inner)}, with an index of ${visible(index)}; this page reads ${CHAIN}`);
    }
    const inShard = product(outer.map((extent, i) => extent / chunk[i]!));
    if (16 * inShard > CLAIMED_BYTES) refuse(path, `a shard has ${inShard} chunks`);
  } else if (codecs.join(" ") !== CHAIN) {
    refuse(path, `its codecs are ${visible(codecs.join(" "))}; this page reads ${CHAIN}`);
  }
  const chunkBytes = product(chunk) * itemBytes(type)!;
  if (chunkBytes > CLAIMED_BYTES) refuse(path, `a chunk takes ${chunkBytes} bytes; at most ${CLAIMED_BYTES} are read at once`);
  return { metadata: fields as unknown as ArrayMetadata<DataType>, chunk, chunkBytes };
}
