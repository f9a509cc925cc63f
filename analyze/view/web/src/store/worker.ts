/** The worker's side: fetches, checks and decodes, so that the page never waits for a chunk. */
import { ArrayReader, type Values } from "./array_reader";
import { type ByteSource, FolderSource } from "./byte_source";
import { registerCodecs } from "./codecs";
import { NotThere, sentenceOf } from "./errors";
import { parseDocument } from "./json_fields";
import type { Answer, Asked, Place, Question } from "./messages";
import { addEachHead, addHeads, meanOverQueries } from "./row_means";

/** Decoded chunks that a worker keeps of one episode, and of how many episodes. */
const CHUNK_CACHE_BYTES = 96_000_000;
const EPISODES_KEPT = 2;

interface Opened {
  source: ByteSource;
  reader: ArrayReader;
}

const opened = new Map<string, Opened>();

function openedAt(place: Place): Opened {
  const key = JSON.stringify(place);
  let found = opened.get(key);
  if (found) opened.delete(key);
  else {
    const source = new FolderSource(place.url);
    found = { source, reader: new ArrayReader(source, CHUNK_CACHE_BYTES) };
  }
  opened.set(key, found);
  if (opened.size > EPISODES_KEPT) opened.delete(opened.keys().next().value!);
  return found;
}

type Found = { document: unknown } | { values: Values; first: number; count: number };

async function find({ source, reader }: Opened, question: Question): Promise<Found> {
  switch (question.kind) {
    case "document":
      return { document: parseDocument(await source.whole(question.path, question.most), question.path) };
    case "chunk": {
      const { chunk } = await reader.open(question.array);
      return { values: Int32Array.from(chunk), first: 0, count: chunk.length };
    }
    case "part": {
      const { array, first, count } = question;
      return { values: await reader.part(array, first, count), first, count };
    }
    case "rows": {
      const { array, layer, denoise, replan } = question;
      const { chunk } = await reader.open(array);
      const block = Math.floor(replan / chunk[0]!);
      const first = block * chunk[0]!;
      const count = Math.min(chunk[0]!, array.shape[0]! - first);
      const inner = array.shape.slice(3).reduce((product, extent) => product * extent, 1);
      const values = (await reader.chunk(array, [block, layer, denoise, 0, 0, 0])).slice(0, count * inner);
      return { values, first, count };
    }
    case "sum": {
      const { array, cells, heads, query, first, count } = question;
      const values = new Float64Array(count * array.shape[5]!);
      for (const [layer, denoise] of cells) {
        await addHeads(reader, array, layer, denoise, { heads, query }, first, count, values);
      }
      return { values, first, count };
    }
    case "heads": {
      const { array, layers, denoise, query, replan } = question;
      const size = array.shape[3]! * array.shape[5]!;
      const values = new Float64Array(layers.length * size);
      for (const [i, layer] of layers.entries()) {
        const own = values.subarray(i * size, (i + 1) * size);
        for (const step of denoise) await addEachHead(reader, array, layer, step, query, replan, own);
      }
      return { values, first: replan, count: 1 };
    }
    case "queries": {
      const values = await meanOverQueries(reader, question.array, question.query);
      return { values, first: 0, count: question.array.shape[0]! };
    }
  }
}

/** The answer to one question, and what of it can be handed over without a copy. */
export async function answerTo({ id, place, question }: Asked): Promise<{ answer: Answer; transfer: ArrayBuffer[] }> {
  try {
    const found = await find(openedAt(place), question);
    return { answer: { id, ...found }, transfer: "values" in found ? [found.values.buffer as ArrayBuffer] : [] };
  } catch (failure) {
    return { answer: { id, failure: sentenceOf(failure), missing: failure instanceof NotThere }, transfer: [] };
  }
}

/** Answer the page's questions until the page ends. */
export function serveWorker(): void {
  registerCodecs();
  const scope = globalThis as unknown as {
    onmessage: ((event: MessageEvent<Asked>) => void) | null;
    postMessage(answer: Answer, transfer: Transferable[]): void;
  };
  scope.onmessage = async ({ data }) => {
    const { answer, transfer } = await answerTo(data);
    scope.postMessage(answer, transfer);
  };
}
