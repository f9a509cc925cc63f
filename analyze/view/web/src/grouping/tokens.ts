/** What selectors need of one episode's keys at one site, and the names in it: schemas/groupings/vocabulary.py. */
import { INVALID_ROLES, ROLES } from "../store/documents";
import type { GridDocument, PromptDocument, ObjectDocument, SiteDocument, SpanDocument } from "../store/documents";
import { BadArgument, casefold, characters, decimalDigits, listing, shortened, unknownName, visible } from "./text";
import { wordsOf, type Word } from "./words";

/** Role codes (replan or 1, key), C order; one replan where they never change. */
export interface KeyRole {
  readonly replans: number;
  readonly keys: number;
  readonly codes: Uint8Array;
}

/** Area of each patch that each object covers, (replan, patch, object), C order, 0..1. */
export interface ObjectCoverage {
  readonly replans: number;
  readonly patches: number;
  readonly objects: number;
  readonly values: Float32Array;
}

export interface TokensOfEpisode {
  readonly layout: SiteDocument;
  readonly keyRole: KeyRole;
  readonly numReplans: number;
  /** The different prompts, with their pieces at this site's keys; none at a site without text. */
  readonly prompts: readonly PromptDocument[];
  /** Which prompt each replan had. */
  readonly promptIndex: readonly number[];
  readonly objects: readonly ObjectDocument[];
  /** By camera of the site. */
  readonly coverage: ReadonlyMap<string, ObjectCoverage>;
}

/** The tokens, and what follows from them. */
export class EpisodeTokens {
  readonly layout: SiteDocument;
  readonly keyRole: KeyRole;
  readonly keys: number;
  readonly numReplans: number;
  readonly prompts: readonly PromptDocument[];
  readonly promptIndex: readonly number[];
  readonly objects: readonly ObjectDocument[];
  readonly coverage: ReadonlyMap<string, ObjectCoverage>;
  /** Keys that can hold information, (replan or 1, key). */
  readonly valid: Uint8Array;
  private wordsOfPrompts: Word[][] | undefined;

  constructor(tokens: TokensOfEpisode) {
    this.layout = tokens.layout;
    this.keys = tokens.keyRole.keys;
    this.keyRole = onceIfSame(tokens.keyRole);
    this.numReplans = tokens.numReplans;
    this.prompts = tokens.prompts;
    this.promptIndex = tokens.promptIndex;
    this.objects = tokens.objects;
    this.coverage = tokens.coverage;
    this.valid = this.keyRole.codes.map((code) => (INVALID_ROLES.includes(code) ? 0 : 1));
  }

  /** The instruction's words for each of `prompts`; throws `BadArgument` for words at keys that do not exist. */
  get words(): Word[][] {
    if (this.wordsOfPrompts === undefined) {
      const words = this.prompts.map(wordsOf);
      for (const word of words.flat()) this.checkKeysOf(word);
      this.wordsOfPrompts = words;
    }
    return this.wordsOfPrompts;
  }

  private checkKeysOf(word: Word): void {
    if (word.keys.some((key) => key < 0 || key >= this.keys)) {
      throw new BadArgument(
        `The word '${visible(shortened(word.text))}' has the keys ${listing(word.keys)}; the site has ${this.keys}.`,
      );
    }
  }
}

function onceIfSame(roles: KeyRole): KeyRole {
  const { replans, keys, codes } = roles;
  for (let i = keys; i < codes.length; i++) if (codes[i] !== codes[i - keys]) return roles;
  return replans === 1 ? roles : { replans: 1, keys, codes: codes.slice(0, keys) };
}

// Spans by name: schemas/layout.py.

export function camerasOf(layout: SiteDocument): string[] {
  return [...new Set(layout.spans.flatMap((span) => (span.camera === null ? [] : [span.camera])))];
}

/** Cameras that have patches. */
export function picturedCameras(layout: SiteDocument): string[] {
  return [...new Set(layout.spans.flatMap((span) => (span.camera !== null && span.grid ? [span.camera] : [])))];
}

export function spanNamed(layout: SiteDocument, name: string): SpanDocument {
  const found = layout.spans.find((span) => span.name === name);
  if (found) return found;
  throw unknownName("span", name, layout.spans.map((span) => span.name));
}

/** All spans of a camera, in key order. */
export function cameraSpans(layout: SiteDocument, camera: string): SpanDocument[] {
  const found = layout.spans.filter((span) => span.camera === camera);
  if (found.length) return found;
  throw unknownName("camera", camera, camerasOf(layout));
}

/** Those of them whose keys are patches. */
export function gridSpans(layout: SiteDocument, camera: string): (SpanDocument & { grid: GridDocument })[] {
  return cameraSpans(layout, camera).filter((span): span is SpanDocument & { grid: GridDocument } => span.grid !== null);
}

/** Numbers of the keys of some spans, in order. */
export function keysOfSpans(spans: readonly SpanDocument[]): number[] {
  return spans.flatMap(({ start, stop }) => Array.from({ length: stop - start }, (_, i) => start + i));
}

/** Keys of the patches of all grids of a camera: the patches of its coverage. */
export function patchKeys(layout: SiteDocument, camera: string): number[] {
  return keysOfSpans(gridSpans(layout, camera));
}

/** A latent frame by its name, by `frameN`, or as `curr_last`: the last frame with a current camera picture. */
export function latentFrame(layout: SiteDocument, name: string): SpanDocument {
  const frames = layout.spans.filter((span) => span.kind === "latent");
  const named = frames.find((span) => span.name === name);
  if (named) return named;
  const digits = name.startsWith("frame") ? decimalDigits(name.slice("frame".length)) : null;
  if (digits !== null && digits.length < 9 && Number(digits) < frames.length) return frames[Number(digits)];
  const seen = frames.filter((span) => span.camera !== null);
  if (name === "curr_last" && seen.length) return seen[seen.length - 1];
  const aliases = frames.length ? [...frames.map((_, i) => `frame${i}`), "curr_last"] : [];
  throw unknownName("latent frame", name, [...frames.map((span) => span.name), ...aliases]);
}

const LABELS = Object.keys(ROLES) as (keyof typeof ROLES)[];

/** The label of a role code. */
export function roleLabel(code: number): string {
  return LABELS.find((label) => ROLES[label] === code)!;
}

/** The code of a role's label. */
export function findRole(label: string): number {
  const found = LABELS.find((known) => known === casefold(label));
  if (found) return ROLES[found];
  throw unknownName("role", label, LABELS);
}

// The names that selectors may use.

/** Why a site has no words to name, or no objects, and what to do about it. */
export const NO_WORDS =
  "the keys of this site spell no words; choose a site with text by --site (Cosmos: cross); a text that was captured " +
  "without its tokenizer needs a capture with --t5-tokenizer, va.record with tokenizer=...";
export const NO_COVERAGE =
  "no selected episode has object coverage at this site: captures take it from the simulator's segmentation, " +
  "va.record from the masks or coverage that replan() is given, and replays of data sets have none; choose a site " +
  "with pictures by --site (Cosmos: self), or a store that is no copy without objects";

export interface Vocabulary {
  readonly cameras: readonly string[];
  readonly spans: readonly string[];
  readonly roles: readonly string[];
  /** Case-folded. */
  readonly words: readonly string[];
  readonly objects: readonly string[];
  readonly layout: SiteDocument;
  /** The instructions as case-folded words. */
  readonly sentences: readonly (readonly string[])[];
}

/** Union of the names in episodes in order of appearance, without cameras that are always masked. */
export function vocabularyOf(episodes: readonly EpisodeTokens[]): Vocabulary {
  const cameras = new Set<string>();
  const spans = new Set<string>();
  const roles = new Set<string>();
  const words = new Set<string>();
  const objects = new Set<string>();
  const sentences = new Map<string, string[]>();
  for (const tokens of episodes) {
    for (const span of tokens.layout.spans) {
      spans.add(span.name);
      if (span.camera !== null && hasOtherRole(tokens, span, ROLES.masked_image)) cameras.add(span.camera);
    }
    for (const code of [...new Set(tokens.keyRole.codes)].sort((a, b) => a - b)) roles.add(roleLabel(code));
    for (const line of tokens.words) {
      if (!line.some((word) => word.keys.length)) continue; // a text that was captured without its tokenizer
      const sentence = line.map((word) => casefold(word.text));
      sentences.set(JSON.stringify(sentence), sentence);
      sentence.forEach((word) => words.add(word));
    }
    if (tokens.coverage.size) tokens.objects.forEach((thing) => objects.add(thing.name));
  }
  const layout = episodes[episodes.length - 1].layout;
  return {
    cameras: [...cameras],
    spans: [...spans],
    roles: [...roles],
    words: [...words],
    objects: [...objects],
    layout,
    sentences: [...sentences.values()],
  };
}

function hasOtherRole(tokens: EpisodeTokens, span: SpanDocument, role: number): boolean {
  const { replans, keys, codes } = tokens.keyRole;
  for (let replan = 0; replan < replans; replan++) {
    for (let key = span.start; key < span.stop; key++) if (codes[replan * keys + key] !== role) return true;
  }
  return false;
}

/** A key in words, for messages: its number, its span, and its piece of text if it has one. */
export function pieceAt(tokens: EpisodeTokens, key: number): string | undefined {
  for (const prompt of tokens.prompts) {
    const piece = prompt.pieces.find((one) => one.key === key);
    if (piece) return piece.text;
  }
  return undefined;
}

/** The instruction inside a prompt's text. */
export function instructionText(prompt: PromptDocument): string {
  return characters(prompt.text).slice(prompt.instruction[0], prompt.instruction[1]).join("");
}
