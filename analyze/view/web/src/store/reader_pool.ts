/** Workers that read and decode. A chunk is always asked of the same worker, which keeps it decoded. */
import { NotThere, StoreError } from "./errors";
import type { Answer, Asked, Place, Question } from "./messages";

export interface Found {
  values: Float32Array | Float64Array | Uint8Array | Int32Array;
  first: number;
  count: number;
}

interface Waiting {
  resolve(answer: unknown): void;
  reject(failure: Error): void;
}

/** What sends a question somewhere: a worker, or in tests the reader itself. */
export interface Port {
  postMessage(asked: Asked): void;
  onanswer(listen: (answer: Answer) => void): void;
}

/** A port to a new worker that runs this page's own script. */
export function workerPort(script: string): Port {
  const worker = new Worker(script, { type: "module" });
  return {
    postMessage: (asked) => worker.postMessage(asked),
    onanswer: (listen) => {
      worker.onmessage = (event: MessageEvent<Answer>) => listen(event.data);
    },
  };
}

export class ReaderPool {
  readonly #waiting = new Map<number, Waiting>();
  #last = 0;

  constructor(private readonly ports: readonly Port[]) {
    for (const port of ports) port.onanswer((answer) => this.#answered(answer));
  }

  get size(): number {
    return this.ports.length;
  }

  #answered(answer: Answer): void {
    const waiting = this.#waiting.get(answer.id);
    this.#waiting.delete(answer.id);
    if ("failure" in answer) waiting?.reject(answer.missing ? new NotThere(answer.failure) : new StoreError(answer.failure));
    else waiting?.resolve("document" in answer ? answer.document : answer);
  }

  #ask(place: Place, question: Question, which: number): Promise<unknown> {
    const id = ++this.#last;
    return new Promise((resolve, reject) => {
      this.#waiting.set(id, { resolve, reject });
      this.ports[which % this.ports.length]!.postMessage({ id, place, question });
    });
  }

  /** A document, parsed and not checked. */
  document(place: Place, path: string, most: number): Promise<unknown> {
    return this.#ask(place, { kind: "document", path, most }, 0);
  }

  /** Values that a question of any other kind asks for; `which` chooses the worker. */
  values(place: Place, question: Exclude<Question, { kind: "document" }>, which = 0): Promise<Found> {
    return this.#ask(place, question, which) as Promise<Found>;
  }
}
