/**
 * The kinds of selectors: the keys that each takes, and what makes a name wrong. schemas/groupings/selectors.py.
 */
import { coversAll, type GridDocument, type SiteDocument } from "../store/documents";
import type { Atom } from "./selector_parser";
import { casefold, didYouMean, listing, SelectorError, SPACE } from "./text";
import {
  cameraSpans,
  camerasOf,
  type EpisodeTokens,
  findRole,
  gridSpans,
  keysOfSpans,
  latentFrame,
  NO_COVERAGE,
  NO_WORDS,
  patchKeys,
  spanNamed,
  type Vocabulary,
} from "./tokens";
import { findPhrase, hasPhrase, type Word, wordClass, wordTexts } from "./words";

/**
 * The (key, cell) pairs that a selector takes: 0 or 1, axes (replan or 1, key, cell or 1). Every key is divided into
 * cells, one per scene object and one that no object covers, so that set operations on objects are exact.
 */
export interface Membership {
  readonly replans: number;
  readonly keys: number;
  readonly cells: number;
  readonly bits: Uint8Array;
}

interface SelectorKind {
  keys(argument: string, tokens: EpisodeTokens): Membership;
  /** What is wrong with the argument, as the end of a sentence, or null. */
  problem(argument: string, vocabulary: Vocabulary, layout: SiteDocument): string | null;
}

const s = `[${SPACE}]*`;
const N = "[0-9]{0,9}(?:\\.[0-9]{1,20})?";
const PATCH = new RegExp(`^(?<camera>[^\\[]+)\\[(?<r0>${N}):(?<r1>${N})${s},${s}(?<c0>${N}):(?<c1>${N})\\]$`, "u");
const KEYS = /^([0-9]{1,9})(?:-([0-9]{1,9}))?$/;
const OBJECT_CLASSES = ["@interest", "@robot", "@background"];
const WORD_CLASSES = ["content", "stop", "all"];

export function noKeys(tokens: EpisodeTokens): Membership {
  return { replans: 1, keys: tokens.keys, cells: 1, bits: new Uint8Array(tokens.keys) };
}

export function everyKey(tokens: EpisodeTokens): Membership {
  return { replans: 1, keys: tokens.keys, cells: 1, bits: new Uint8Array(tokens.keys).fill(1) };
}

function keyRange(tokens: EpisodeTokens, start: number, stop: number): Membership {
  const member = noKeys(tokens);
  member.bits.fill(1, start, stop);
  return member;
}

/** The problem of a name that is not among the existing ones. */
function missing(kind: string, name: string, existing: readonly string[]): string | null {
  if (existing.includes(name)) return null;
  return `there is no ${kind} '${name}'.${didYouMean(name, existing)} Existing: ${listing(existing, 40)}.`;
}

function spanKind(
  find: (layout: SiteDocument, name: string) => { start: number; stop: number },
  problem: SelectorKind["problem"],
): SelectorKind {
  return {
    keys(argument, tokens) {
      const span = find(tokens.layout, argument);
      return keyRange(tokens, span.start, span.stop);
    },
    problem,
  };
}

function roleKeys(argument: string, tokens: EpisodeTokens): Membership {
  const { replans, keys, codes } = tokens.keyRole;
  const role = findRole(argument);
  return { replans, keys, cells: 1, bits: codes.map((code) => (code === role ? 1 : 0)) };
}

function wordKeys(argument: string, tokens: EpisodeTokens): Membership {
  return keysOfWords(
    tokens,
    tokens.words.map((words) => findPhrase(words, argument)),
  );
}

function wordProblem(argument: string, vocabulary: Vocabulary): string | null {
  if (!vocabulary.words.length) return `${NO_WORDS}.`;
  const words = wordTexts(argument);
  if (!words.length) return `'${argument}' has no letter or digit, so it is no word.`;
  for (const word of words) {
    if (!vocabulary.words.includes(casefold(word))) {
      const near = didYouMean(word, vocabulary.words);
      return `no instruction has the word '${word}'.${near} Words: ${listing(vocabulary.words, 40)}.`;
    }
  }
  if (vocabulary.sentences.some((sentence) => hasPhrase(sentence, argument))) return null;
  const shared = (sentence: readonly string[]): number =>
    words.filter((word) => sentence.includes(casefold(word))).length;
  const nearest = vocabulary.sentences.reduce((best, other) => (shared(other) > shared(best) ? other : best));
  return (
    `no instruction has the words '${argument}' one after the other. Nearest: '${nearest.join(" ")}'; a list of ` +
    "word: selectors takes single words."
  );
}

function wordsKeys(argument: string, tokens: EpisodeTokens): Membership {
  const wanted = casefold(argument);
  const problem = WORD_CLASSES.includes(wanted) ? null : missing("word class", argument, WORD_CLASSES);
  if (problem) throw new SelectorError(problem[0]!.toUpperCase() + problem.slice(1));
  return keysOfWords(
    tokens,
    tokens.words.map((words) => words.filter((word) => wanted === "all" || wordClass(word.text) === wanted)),
  );
}

function wordsProblem(argument: string, vocabulary: Vocabulary): string | null {
  if (!WORD_CLASSES.includes(casefold(argument))) return missing("word class", argument, WORD_CLASSES);
  return vocabulary.words.length ? null : `${NO_WORDS}.`;
}

/** The keys of the words that were chosen from each of the episode's prompts. */
function keysOfWords(tokens: EpisodeTokens, chosen: readonly (readonly Word[])[]): Membership {
  const { keys, promptIndex } = tokens;
  const byPrompt = chosen.map((words) => {
    const row = new Uint8Array(keys);
    for (const word of words) for (const key of word.keys) row[key] = 1;
    return row;
  });
  if (byPrompt.length <= 1 || !promptIndex.length) {
    return { replans: 1, keys, cells: 1, bits: byPrompt[0] ?? new Uint8Array(keys) };
  }
  const bits = new Uint8Array(promptIndex.length * keys);
  promptIndex.forEach((prompt, replan) => bits.set(byPrompt[prompt]!, replan * keys));
  return { replans: promptIndex.length, keys, cells: 1, bits };
}

function objectKeys(argument: string, tokens: EpisodeTokens): Membership {
  const cells = 1 + tokens.objects.length;
  const bits = new Uint8Array(tokens.keys * cells);
  tokens.objects.forEach((thing, i) => {
    const byClass: Record<string, boolean> = {
      "@interest": thing.of_interest,
      "@robot": thing.kind === "robot",
      "@background": thing.kind === "background",
    };
    const taken = Object.hasOwn(byClass, argument) ? byClass[argument]! : thing.name === argument;
    if (!taken) return;
    for (const camera of tokens.coverage.keys()) {
      for (const key of patchKeys(tokens.layout, camera)) bits[key * cells + 1 + i] = 1;
    }
  });
  return { replans: 1, keys: tokens.keys, cells, bits };
}

function objectProblem(argument: string, vocabulary: Vocabulary): string | null {
  const isClass = OBJECT_CLASSES.includes(argument);
  if (argument.startsWith("@") && !isClass) return missing("object class", argument, OBJECT_CLASSES);
  if (!vocabulary.objects.length) return `${NO_COVERAGE}.`;
  return isClass ? null : missing("object", argument, vocabulary.objects);
}

/** A region of a camera's picture, the ends excluded: rows and columns of its patch grid, or fractions of the picture. */
export interface PatchRegion {
  readonly camera: string;
  readonly fractions: boolean;
  readonly r0: number;
  readonly r1: number;
  readonly c0: number;
  readonly c1: number;
}

function describeGrid(grid: GridDocument): string {
  const sides = grid.part.map((side) => Number(side.toPrecision(4))).join(", ");
  return `${grid.rows} x ${grid.columns} patches${coversAll(grid) ? "" : ` of the part (${sides})`}`;
}

/** The region that the argument of `patch:` names; throws `SelectorError` unless the camera's picture has it. */
export function patchRegion(argument: string, layout: SiteDocument): PatchRegion {
  const match = PATCH.exec(argument)?.groups;
  if (!match) {
    throw new SelectorError(
      `Cannot read selector 'patch:${argument}'; expected patch:CAMERA[r0:r1,c0:c1] with rows and columns of ` +
        "patches, or with fractions of the picture such as 0.5.",
    );
  }
  const camera = match.camera!;
  const grids = gridSpans(layout, camera).map(({ grid }) => grid);
  if (!grids.length) throw new SelectorError(`Camera '${camera}' has no patch grid.`);
  const given = [match.r0!, match.r1!, match.c0!, match.c1!].filter((end) => end !== "");
  const fractions = !given.length || given.some((end) => end.includes("."));
  if (grids.length > 1 && !fractions) {
    throw new SelectorError(
      `Selector 'patch:${argument}' counts patches, and camera '${camera}' has ${grids.length} grids ` +
        `(${listing(grids.map(describeGrid))}); expected fractions of the whole picture, which take ` +
        `patches of all of them, such as patch:${camera}[0.0:0.5,0.25:1.0]; & span:NAME takes one grid's.`,
    );
  }
  const [rows, columns] = fractions ? [1, 1] : [grids[0]!.rows, grids[0]!.columns];
  const [r0, r1] = [Number(match.r0), Number(match.r1 || rows)];
  const [c0, c1] = [Number(match.c0), Number(match.c1 || columns)];
  if (!(r0 < r1 && r1 <= rows && c0 < c1 && c1 <= columns)) {
    throw new SelectorError(
      fractions
        ? `Selector 'patch:${argument}' leaves the picture of camera '${camera}', whose sides are 1 in fractions; ` +
            "expected 0 <= r0 < r1 <= 1 and 0 <= c0 < c1 <= 1."
        : `Selector 'patch:${argument}' leaves the grid of camera '${camera}', which has ${rows} rows and ` +
            `${columns} columns of patches; expected 0 <= r0 < r1 <= ${rows} and 0 <= c0 < c1 <= ${columns}.`,
    );
  }
  return { camera, fractions, r0, r1, c0, c1 };
}

function patchMembers(argument: string, tokens: EpisodeTokens): Membership {
  const { camera, fractions, r0, r1, c0, c1 } = patchRegion(argument, tokens.layout);
  const member = noKeys(tokens);
  for (const { start, stop, grid } of gridSpans(tokens.layout, camera)) {
    const [top, left, height, width] = grid.part;
    for (let key = start; key < stop; key++) {
      const column = (key - start) % grid.columns;
      const row = (key - start - column) / grid.columns;
      const down = fractions ? ((row + 0.5) / grid.rows) * height + top : row;
      const across = fractions ? ((column + 0.5) / grid.columns) * width + left : column;
      if (r0 <= down && down < r1 && c0 <= across && across < c1) member.bits[key] = 1;
    }
  }
  return member;
}

function numberKeys(argument: string, tokens: EpisodeTokens): Membership {
  const match = KEYS.exec(argument);
  if (!match) throw new SelectorError(`Cannot read selector 'keys:${argument}'; expected keys:a or keys:a-b.`);
  const first = Number(match[1]);
  const last = Number(match[2] ?? match[1]);
  if (!(first <= last && last < tokens.keys)) {
    throw new SelectorError(
      `Selector 'keys:${argument}' leaves the site's keys; expected a <= b <= ${tokens.keys - 1}.`,
    );
  }
  return keyRange(tokens, first, last + 1);
}

const cameraProblem: SelectorKind["problem"] = (argument, _, layout) => missing("camera", argument, camerasOf(layout));

const SELECTOR_KINDS: Record<string, SelectorKind> = {
  camera: {
    keys(argument, tokens) {
      const member = noKeys(tokens);
      for (const key of keysOfSpans(cameraSpans(tokens.layout, argument))) member.bits[key] = 1;
      return member;
    },
    problem: cameraProblem,
  },
  role: {
    keys: roleKeys,
    problem: (argument) => {
      findRole(argument); // throws the error that lists the roles
      return null;
    },
  },
  span: spanKind(spanNamed, (argument, vocabulary) => missing("span", argument, vocabulary.spans)),
  frame: spanKind(latentFrame, (argument, _, layout) => {
    latentFrame(layout, argument); // throws the error that lists the frames
    return null;
  }),
  word: { keys: wordKeys, problem: wordProblem },
  words: { keys: wordsKeys, problem: wordsProblem },
  object: { keys: objectKeys, problem: objectProblem },
  patch: {
    keys: patchMembers,
    problem: (argument, vocabulary, layout) => cameraProblem(argument.split("[")[0]!, vocabulary, layout),
  },
  keys: { keys: numberKeys, problem: () => null }, // a range that leaves the site is found when the keys are taken
};

/** The keys that one part of a selector takes. */
export function keysOf(atom: Atom, tokens: EpisodeTokens): Membership {
  return SELECTOR_KINDS[atom.kind]!.keys(atom.argument, tokens);
}

/** What is wrong with one part of a selector, as the end of a sentence, or null. */
export function problemOf(atom: Atom, vocabulary: Vocabulary): string | null {
  return SELECTOR_KINDS[atom.kind]!.problem(atom.argument, vocabulary, vocabulary.layout);
}
