/**
 * The files of a packed episode: members of a zip without compression, read by ranges.
 *
 * The zip's directory is believed no more than any other bytes (docs/store.md, "Packed stores"): every member has to
 * lie between its header and the next one, and zips that `vla-attention store copy --packed` would not write are refused.
 */
import type { ByteSource, Range } from "./byte_source";
import { NotThere, StoreError, visible } from "./errors";
import { EPISODE_FILES } from "./limits";

const END = 0x06054b50;
const END_64 = 0x06064b50;
const END_64_LOCATOR = 0x07064b50;
const ENTRY = 0x02014b50;
const END_BYTES = 22;
const LOCAL_HEADER_BYTES = 30;
const ENCRYPTED_OR_DESCRIPTOR = 0x1 | 0x8;

export interface Member {
  first: number;
  size: number;
}

interface Entry {
  name: string;
  nameBytes: number;
  header: number;
  size: number;
}

const wide = (view: DataView, at: number): number => Number(view.getBigUint64(at, true));

/** Where the directory begins, and how many entries it has. */
function directoryOf(view: DataView, tail: number): { start: number; entries: number } {
  for (let at = view.byteLength - END_BYTES; at >= 0; at--) {
    if (view.getUint32(at, true) !== END) continue;
    const locator = at - 20;
    if (locator >= 0 && view.getUint32(locator, true) === END_64_LOCATOR) {
      const end = wide(view, locator + 8) - tail;
      if (end >= 0 && end + 56 <= view.byteLength && view.getUint32(end, true) === END_64) {
        return { entries: wide(view, end + 32), start: wide(view, end + 48) };
      }
    }
    return { entries: view.getUint16(at + 10, true), start: view.getUint32(at + 16, true) };
  }
  throw new StoreError("it has no directory");
}

function entryAt(view: DataView, at: number): { entry: Entry; next: number } {
  if (at + 46 > view.byteLength || view.getUint32(at, true) !== ENTRY) throw new StoreError("its directory is damaged");
  const flags = view.getUint16(at + 8, true);
  const method = view.getUint16(at + 10, true);
  let packed = view.getUint32(at + 20, true);
  let size = view.getUint32(at + 24, true);
  let header = view.getUint32(at + 42, true);
  const nameBytes = view.getUint16(at + 28, true);
  const extra = view.getUint16(at + 30, true);
  const next = at + 46 + nameBytes + extra + view.getUint16(at + 32, true);
  if (next > view.byteLength) throw new StoreError("its directory is damaged");
  const name = new TextDecoder().decode(new Uint8Array(view.buffer, view.byteOffset + at + 46, nameBytes));
  for (let field = at + 46 + nameBytes; field + 4 <= at + 46 + nameBytes + extra; ) {
    const length = view.getUint16(field + 2, true);
    if (view.getUint16(field, true) === 1) {
      let value = field + 4;
      const end = Math.min(value + length, next);
      const take = (given: number): number => {
        if (given !== 0xffffffff || value + 8 > end) return given;
        value += 8;
        return wide(view, value - 8);
      };
      size = take(size);
      packed = take(packed);
      header = take(header);
    }
    field += 4 + length;
  }
  if (method !== 0 || size !== packed || flags & ENCRYPTED_OR_DESCRIPTOR) {
    throw new StoreError(`it holds ${visible(name)} in another way than vla-attention store copy --packed writes it`);
  }
  return { entry: { name, nameBytes, header, size }, next };
}

/**
 * The members in the tail of a zip: the bytes from `tail` on, of a zip of `length` bytes.
 *
 * Throws `StoreError` with what is wrong with the zip.
 */
export function membersOf(bytes: Uint8Array, tail: number, length: number): Map<string, Member> {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const { start, entries } = directoryOf(view, tail);
  if (entries > EPISODE_FILES) throw new StoreError(`it has more than ${EPISODE_FILES} files`);
  if (start < tail || start >= length) throw new StoreError("its directory is not where the index says");
  const found: Entry[] = [];
  let at = start - tail;
  for (let i = 0; i < entries; i++) {
    const { entry, next } = entryAt(view, at);
    found.push(entry);
    at = next;
  }
  found.sort((a, b) => a.header - b.header);
  const members = new Map<string, Member>();
  found.forEach((entry, i) => {
    const until = found[i + 1]?.header ?? start;
    const first = until - entry.size;
    if (first < entry.header + LOCAL_HEADER_BYTES + entry.nameBytes || until > length || members.has(entry.name)) {
      throw new StoreError(`its file ${visible(entry.name)} does not lie where the directory says`);
    }
    members.set(entry.name, { first, size: entry.size });
  });
  return members;
}

/** The files of one packed episode. The tail is fetched once: metadata and small files. */
export class ZipSource implements ByteSource {
  #opened: Promise<{ bytes: Uint8Array; members: Map<string, Member> }> | undefined;

  constructor(
    private readonly source: ByteSource,
    private readonly file: string,
    private readonly length: number,
    private readonly tail: number,
  ) {}

  async #open(): Promise<{ bytes: Uint8Array; members: Map<string, Member> }> {
    const bytes = await this.source.part(this.file, { offset: this.tail, length: this.length - this.tail });
    try {
      return { bytes, members: membersOf(bytes, this.tail, this.length) };
    } catch (failure) {
      throw new StoreError(`The zip ${this.file} cannot be read: ${(failure as Error).message}.`);
    }
  }

  async #member(path: string): Promise<Member & { bytes: Uint8Array }> {
    this.#opened ??= this.#open();
    const { bytes, members } = await this.#opened;
    const member = members.get(path);
    if (!member) throw new NotThere(`The zip ${this.file} has no file ${path}.`);
    return { ...member, bytes };
  }

  async whole(path: string, most: number): Promise<Uint8Array> {
    const { size } = await this.#member(path);
    if (size > most) throw new StoreError(`The file ${path} has ${size} bytes; expected at most ${most}.`);
    return this.part(path, { offset: 0, length: size });
  }

  async part(path: string, range: Range): Promise<Uint8Array> {
    const { first, size, bytes } = await this.#member(path);
    const length = "suffix" in range ? range.suffix : range.length;
    const offset = "suffix" in range ? size - length : range.offset;
    if (offset < 0 || offset + length > size) throw new StoreError(`The file ${path} ends before byte ${offset + length}.`);
    const at = first + offset;
    if (at >= this.tail) return bytes.slice(at - this.tail, at - this.tail + length);
    return this.source.part(this.file, { offset: at, length });
  }
}
