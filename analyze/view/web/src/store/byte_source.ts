/** Bytes of a store's files over HTTP, by ranges. What a server answers is compared with what was asked for. */
import { NotThere, StoreError } from "./errors";

export type Range = { offset: number; length: number } | { suffix: number };

/** Where the files of a store's root, or of one episode, are. */
export interface ByteSource {
  /** A whole file of at most `most` bytes; throws `NotThere`. */
  whole(path: string, most: number): Promise<Uint8Array>;
  /** A part of a file; throws `NotThere`, and `StoreError` where the file ends before. */
  part(path: string, range: Range): Promise<Uint8Array>;
}

async function answer(url: string, path: string, headers: Record<string, string>): Promise<Response> {
  let response: Response;
  try {
    response = await fetch(url, { headers });
  } catch {
    throw new StoreError(`The web server does not answer, so ${path} cannot be read. Is vla-analyze view still running?`);
  }
  if (response.status === 404) throw new NotThere(`The store has no file ${path}.`);
  if (!response.ok) throw new StoreError(`The web server answers ${response.status} to ${path}.`);
  return response;
}

/** The body of an answer, read until it ends or is longer than `most`. */
async function bounded(response: Response, path: string, most: number): Promise<Uint8Array> {
  const tooLong = (): StoreError => new StoreError(`The file ${path} has more than ${most} bytes, more than it may have.`);
  if (Number(response.headers.get("Content-Length") ?? 0) > most) {
    await response.body?.cancel();
    throw tooLong();
  }
  const reader = response.body?.getReader();
  if (!reader) return new Uint8Array(0);
  const parts: Uint8Array[] = [];
  let size = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    parts.push(value);
    size += value.byteLength;
    if (size > most) {
      await reader.cancel();
      throw tooLong();
    }
  }
  if (parts.length === 1) return parts[0]!;
  const joined = new Uint8Array(size);
  let at = 0;
  for (const part of parts) {
    joined.set(part, at);
    at += part.byteLength;
  }
  return joined;
}

/** Files below an address that ends in a slash. */
export class FolderSource implements ByteSource {
  constructor(private readonly url: string) {}

  #address(path: string): string {
    return this.url + path.split("/").map(encodeURIComponent).join("/");
  }

  async whole(path: string, most: number): Promise<Uint8Array> {
    return bounded(await answer(this.#address(path), path, {}), path, most);
  }

  async part(path: string, range: Range): Promise<Uint8Array> {
    const length = "suffix" in range ? range.suffix : range.length;
    if (length === 0) return new Uint8Array(0);
    const wanted = "suffix" in range ? `bytes=-${length}` : `bytes=${range.offset}-${range.offset + length - 1}`;
    const response = await answer(this.#address(path), path, { Range: wanted });
    // A server without ranges sends the whole file, which may be gigabytes.
    if (response.status !== 206) {
      await response.body?.cancel();
      throw new StoreError(`The web server does not answer ranges (${path}); use vla-analyze view or another server.`);
    }
    const bytes = await bounded(response, path, length);
    if (bytes.byteLength !== length) throw new StoreError(`The file ${path} ends before byte ${length} of what it lists.`);
    return bytes;
  }
}
