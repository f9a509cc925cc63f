/** What the page asks its workers. Shapes and types come from the episode's attributes; workers check the files. */
import type { ArrayName } from "./array_reader";

/** The folder of an episode's files. Addresses end in a slash. */
export interface Place {
  url: string;
}

export type Question =
  | { kind: "document"; path: string; most: number }
  /** The shape of what is decoded at once. */
  | { kind: "chunk"; array: ArrayName }
  | { kind: "part"; array: ArrayName; first: number; count: number }
  /** Rows of one layer and denoise step, all of one chunk. */
  | { kind: "rows"; array: ArrayName; layer: number; denoise: number; replan: number }
  /** Sums over (layer, denoise) cells and heads, mean over queries: (count, key) float64. */
  | {
      kind: "sum";
      array: ArrayName;
      cells: readonly (readonly [number, number])[];
      heads: readonly number[];
      query: number | "mean";
      first: number;
      count: number;
    }
  /** Sums over denoise steps of each layer's rows of each head at a replan: (layer, head, key) float64. */
  | { kind: "heads"; array: ArrayName; layers: readonly number[]; denoise: readonly number[]; query: number | "mean"; replan: number }
  | { kind: "queries"; array: ArrayName; query: number | "mean" };

export interface Asked {
  id: number;
  place: Place;
  question: Question;
}

export type Answer =
  | { id: number; document: unknown }
  | { id: number; values: Float32Array | Float64Array | Uint8Array | Int32Array; first: number; count: number }
  | { id: number; failure: string; missing: boolean };
