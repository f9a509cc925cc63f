/**
 * The two codecs of zarrita that this page replaces, because a store may be damaged or hostile.
 *
 * zarrita's `crc32c` cuts the checksum off without comparing it, and its `blosc` takes the memory that the chunk's own
 * header asks for. Here the checksum is compared first, and the header has to say the size that the array gives it.
 */
import Blosc from "numcodecs/blosc";
import { registry } from "zarrita";

import { crc32c } from "./crc32c";
import { StoreError } from "./errors";

const BLOSC_HEADER_BYTES = 16;
const ITEM_BYTES: Readonly<Record<string, number>> = { uint8: 1, int32: 4, int64: 8, uint64: 8, float32: 4, float64: 8 };

/** Bytes of one value of a data type; undefined for types that stores do not have. */
export function itemBytes(type: string): number | undefined {
  return Object.hasOwn(ITEM_BYTES, type) ? ITEM_BYTES[type] : undefined;
}

class CheckedCrc32c {
  readonly kind = "bytes_to_bytes" as const;
  static fromConfig(): CheckedCrc32c {
    return new CheckedCrc32c();
  }
  encode(): never {
    throw new Error("This page writes nothing.");
  }
  decode(bytes: Uint8Array): Uint8Array {
    const size = bytes.byteLength - 4;
    if (size < 0) throw new StoreError("A chunk is shorter than its checksum.");
    const content = bytes.subarray(0, size);
    const stored = new DataView(bytes.buffer, bytes.byteOffset + size, 4).getUint32(0, true);
    if (crc32c(content) !== stored) throw new StoreError("A chunk is damaged: its checksum (crc32c) does not fit.");
    return content;
  }
  computeEncodedSize(size: number): number {
    return size + 4;
  }
}

class CheckedBlosc {
  readonly kind = "bytes_to_bytes" as const;
  readonly #codec = Blosc.fromConfig({ id: "blosc", clevel: 1, cname: "lz4", shuffle: 0, blocksize: 0 });
  constructor(private readonly expected: number) {}
  static fromConfig(_: unknown, chunk: { shape: number[]; dataType: string }): CheckedBlosc {
    const size = itemBytes(chunk.dataType);
    if (size === undefined) throw new StoreError("A chunk has a data type that stores do not have.");
    return new CheckedBlosc(chunk.shape.reduce((product, extent) => product * extent, size));
  }
  encode(): never {
    throw new Error("This page writes nothing.");
  }
  async decode(bytes: Uint8Array): Promise<Uint8Array> {
    if (bytes.byteLength < BLOSC_HEADER_BYTES) throw new StoreError("A chunk is shorter than its header.");
    const header = new DataView(bytes.buffer, bytes.byteOffset, BLOSC_HEADER_BYTES);
    if (header.getUint32(4, true) !== this.expected || header.getUint32(12, true) !== bytes.byteLength) {
      throw new StoreError("A chunk is damaged: its header says another size than its array.");
    }
    return this.#codec.decode(bytes);
  }
}

/** Make zarrita use the codecs of this file, and no others than stores have. */
export function registerCodecs(): void {
  const kept = new Set(["bytes", "blosc", "crc32c"]);
  for (const known of [...registry.keys()]) if (!kept.has(known)) registry.delete(known);
  registry.set("crc32c", () => CheckedCrc32c as never);
  registry.set("blosc", () => CheckedBlosc as never);
}
