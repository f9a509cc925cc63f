/** What is read of an episode: the shapes of the values, in C order. */
import type { SegmentDocument, SiteDocument } from "./documents";

/** A site of an episode. `layers`, `denoise` and `heads` are the recorded numbers, in the order of the axes. */
export interface SiteInfo {
  layout: SiteDocument;
  keys: number;
  layers: number[];
  denoise: number[];
  heads: number[];
  /** Length of the query axis. */
  numQueries: number;
  segments: SegmentDocument[];
  /** Lengths of the axes of what uniform attention gives, 1 where nothing changes along one. */
  uniformShape: readonly number[];
}

/** Positions on the axes that means are over. */
export interface Selection {
  layers: readonly number[];
  denoise: readonly number[];
  heads: readonly number[];
  query: number | "mean";
}

export interface KeyRole {
  replans: number;
  keys: number;
  codes: Uint8Array;
}

/** Rows of one layer and denoise step, (replan, head, query, key), from `firstReplan` on. */
export interface RowBlock {
  firstReplan: number;
  replans: number;
  heads: number;
  queries: number;
  keys: number;
  values: Float32Array;
}

/** Masses of segments (replan, layer, denoise, head, segment), mean over the queries or of one. */
export interface Atoms {
  replans: number;
  layers: number;
  denoise: number;
  heads: number;
  segments: number;
  values: Float32Array;
}

/** Mean rows (replan, key) of the whole episode. */
export interface MeanRows {
  replans: number;
  keys: number;
  values: Float64Array;
}

/** Rows (layer, head, key) of one replan; `layers` are the positions that were asked for. */
export interface HeadRows {
  layers: readonly number[];
  heads: number;
  keys: number;
  values: Float32Array;
}

export interface Picture {
  height: number;
  width: number;
  /** (row, column, 3). */
  values: Uint8Array;
}

/** Share of each patch's area that each object covers, (replan, patch, object). */
export interface Coverage {
  replans: number;
  patches: number;
  objects: number;
  values: Float32Array;
}

export interface Series {
  replans: number;
  size: number;
  /** (replan, ...). */
  values: Float64Array;
  shape: readonly number[];
}
