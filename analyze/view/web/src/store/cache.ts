/** What was used last, up to a number of bytes. */
export class ByteCache<T> {
  readonly #kept = new Map<string, { value: T; bytes: number }>();
  #bytes = 0;

  constructor(private readonly most: number) {}

  /** What is kept under a key, which then counts as used last. */
  get(key: string): T | undefined {
    const found = this.#kept.get(key);
    if (!found) return undefined;
    this.#kept.delete(key);
    this.#kept.set(key, found);
    return found.value;
  }

  /** Keep a value; what was not used for longest goes first. One that is larger than all of the cache is not kept. */
  set(key: string, value: T, bytes: number): void {
    this.delete(key);
    if (bytes > this.most) return;
    this.#kept.set(key, { value, bytes });
    this.#bytes += bytes;
    for (const oldest of this.#kept.keys()) {
      if (this.#bytes <= this.most) break;
      this.delete(oldest);
    }
  }

  delete(key: string): void {
    const found = this.#kept.get(key);
    if (!found) return;
    this.#bytes -= found.bytes;
    this.#kept.delete(key);
  }

  get bytes(): number {
    return this.#bytes;
  }
}
