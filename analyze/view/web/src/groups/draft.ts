/**
 * What somebody is making in the panel: groups as lines, what they begin from, a ratio; as text (for the page's link),
 * as a grouping, as a command of `vla-analyze`.
 */
import { findGrouping } from "../grouping/builtin_groupings";
import { conventionalRatio, type Grouping, makeGrouping, parseRatioArgument, withGroups } from "../grouping/grouping";
import { checkNames, resolve, resolveChecked, type ResolvedGrouping } from "../grouping/resolve";
import { attempt, trimmed, UserError } from "../grouping/text";
import { type EpisodeTokens, type Vocabulary, vocabularyOf } from "../grouping/tokens";

export interface GroupLine {
  readonly name: string;
  readonly selector: string;
}

export interface Draft {
  /** A built-in grouping whose groups come after these lines; null: none. */
  readonly base: string | null;
  /** The name of a grouping that was read from a file: its groups are all there are. Null: none was. */
  readonly file: string | null;
  readonly lines: readonly GroupLine[];
  /** `A,B/C`; empty: the usual one. */
  readonly ratio: string;
  readonly overlap: boolean;
  /** Groups of a file that may have no keys. */
  readonly allowEmpty: readonly string[];
}

export const EMPTY_DRAFT: Draft = { base: null, file: null, lines: [], ratio: "", overlap: false, allowEmpty: [] };

/** A draft as text: `@base NAME`, `@file NAME`, `@ratio A/B`, `@overlap`, `@empty NAME`, and lines `NAME = SELECTOR`. */
export function textOfDraft(draft: Draft): string {
  const lines: string[] = [];
  if (draft.base !== null) lines.push(`@base ${draft.base}`);
  if (draft.file !== null) lines.push(`@file ${draft.file}`);
  if (draft.ratio) lines.push(`@ratio ${draft.ratio}`);
  if (draft.overlap) lines.push("@overlap");
  for (const name of draft.allowEmpty) lines.push(`@empty ${name}`);
  for (const { name, selector } of draft.lines) lines.push(`${name} = ${selector}`);
  return lines.map((line) => line.replaceAll("\n", " ")).join("\n");
}

/** The draft that a text says; lines without "=" are groups without a selector. */
export function draftOfText(text: string): Draft {
  let draft = EMPTY_DRAFT;
  for (const line of text.split("\n")) {
    if (!line) continue;
    const [, word, value] = /^@(\w+)(?: (.*))?$/u.exec(line) ?? [];
    if (word === "base") draft = { ...draft, base: value ?? null };
    else if (word === "file") draft = { ...draft, file: value ?? "" };
    else if (word === "ratio") draft = { ...draft, ratio: value ?? "" };
    else if (word === "overlap") draft = { ...draft, overlap: true };
    else if (word === "empty") draft = { ...draft, allowEmpty: [...draft.allowEmpty, value ?? ""] };
    else {
      const at = line.indexOf("=");
      const [name, selector] = at < 0 ? [line, ""] : [line.slice(0, at), line.slice(at + 1)];
      draft = { ...draft, lines: [...draft.lines, { name: trimmed(name), selector: trimmed(selector) }] };
    }
  }
  return draft;
}

/** A grouping that was read from a file, as a draft. */
export function draftOfGrouping(grouping: Grouping): Draft {
  const { ratio } = grouping;
  return {
    base: null,
    file: grouping.name,
    lines: [...grouping.groups].flatMap(([name, selectors]) => selectors.map((selector) => ({ name, selector }))),
    ratio: ratio ? `${ratio.numerator.join(",")}/${ratio.denominator.join(",")}` : "",
    overlap: grouping.overlap,
    allowEmpty: grouping.allowEmpty,
  };
}

/** Lines that say something: a new one without a selector does not yet. */
function written(draft: Draft): GroupLine[] {
  return draft.lines.filter(({ selector }) => selector);
}

/** The grouping of a draft, as the command line or a file makes it; throws `UserError`. Null for an empty draft. */
export function groupingOfDraft(draft: Draft, vocabulary: Vocabulary): Grouping | null {
  const lines = written(draft);
  const base = draft.base === null ? null : findGrouping(draft.base, vocabulary);
  let grouping = base;
  if (draft.file !== null) {
    const groups = new Map<string, string[]>();
    for (const { name, selector } of lines) groups.set(name, [...(groups.get(name) ?? []), selector]);
    const ratio = conventionalRatio(groups.keys());
    grouping = makeGrouping({ name: draft.file, groups, ratio, allowEmpty: draft.allowEmpty });
  } else if (lines.length) {
    grouping = withGroups(base, lines.map(({ name, selector }) => [name, selector] as const));
  }
  if (!grouping) return null;
  const ratio = draft.ratio ? parseRatioArgument(draft.ratio) : grouping.ratio;
  return makeGrouping({ ...grouping, ratio, overlap: grouping.overlap || draft.overlap });
}

export interface Evaluated {
  /** Null for an empty draft, and where something is wrong. */
  readonly grouping: Grouping | null;
  readonly resolved: ResolvedGrouping | null;
  /** What is wrong with each line; empty: nothing. */
  readonly ofLines: readonly string[];
  /** What is wrong with the whole; empty: nothing. */
  readonly ofWhole: string;
}

/** What is wrong with lines, by their text: a stroke of the brush changes one of them. */
const problems = new WeakMap<EpisodeTokens, Map<string, string>>();
const MOST_KEPT = 100;

/** A draft on an episode's keys, with what is wrong beside the line that it is about. */
export function evaluateDraft(draft: Draft, tokens: EpisodeTokens): Evaluated {
  const vocabulary = vocabularyOf([tokens]);
  const ofLines = draft.lines.map((line) => (line.selector ? problemOfLine(line, tokens, vocabulary) : ""));
  if (ofLines.some((problem) => problem)) return { grouping: null, resolved: null, ofLines, ofWhole: "" };
  const found = attempt(() => {
    const grouping = groupingOfDraft(draft, vocabulary);
    return { grouping, resolved: grouping && resolveChecked(grouping, tokens, vocabulary) };
  });
  if (found.error === undefined) return { ...found.value, ofLines, ofWhole: "" };
  // An empty group, or one that shares keys with another, is named at the beginning of the sentence.
  const second = /^Groups '.*?' and '(.*?)'/su.exec(found.error)?.[1];
  const place = draft.lines.findIndex(({ name }) => found.error.startsWith(`Group '${name}'`) || name === second);
  const beside = ofLines.map((_, i) => (i === place ? found.error : ""));
  return { grouping: null, resolved: null, ofLines: beside, ofWhole: place < 0 ? found.error : "" };
}

function problemOfLine(line: GroupLine, tokens: EpisodeTokens, vocabulary: Vocabulary): string {
  let kept = problems.get(tokens);
  if (!kept || kept.size >= MOST_KEPT) problems.set(tokens, (kept = new Map()));
  const text = `${line.name}=${line.selector}`;
  const problem = kept.get(text) ?? foundProblem(line, tokens, vocabulary);
  kept.set(text, problem);
  return problem;
}

function foundProblem({ name, selector }: GroupLine, tokens: EpisodeTokens, vocabulary: Vocabulary): string {
  try {
    const grouping = makeGrouping({ name, groups: new Map([[name, [selector]]]) });
    checkNames(grouping, vocabulary);
    resolve(grouping, tokens);
  } catch (error) {
    if (error instanceof UserError) return error.message;
    throw error;
  }
  return "";
}

/** A word of a shell command, quoted where it needs to be, as Python's `shlex.quote`. */
export function shellWord(text: string): string {
  return /^[\w@%+=:,./-]+$/.test(text) ? text : `'${text.replaceAll("'", `'"'"'`)}'`;
}

/** The arguments of `vla-analyze` that ask for the draft's grouping; null where only a file can say it. */
export function argumentsOfDraft(draft: Draft): string[] | null {
  if (draft.file !== null || draft.overlap) return null;
  const base = draft.base === null ? [] : ["--grouping", draft.base];
  const groups = written(draft).flatMap(({ name, selector }) => ["--group", `${name}=${selector}`]);
  return [...base, ...groups, ...(draft.ratio ? ["--ratio", draft.ratio] : [])];
}
