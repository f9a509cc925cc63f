/**
 * Text as Python counts and shows it: characters are code points, and what cannot be printed is an escape.
 * The same as schemas/errors.py, so that a sentence is the same wherever it is read.
 */

const NAME_CHARACTERS = 255;
const SHOWN_CHARACTERS = 300;
const SENTENCE_CHARACTERS = 4000;
const COMPARED_NAMES = 5000;

/** A mistake in what was given. Its message is the sentence that Python would print. */
export class UserError extends Error {
  constructor(sentence: string) {
    super(visible(shortened(sentence, SENTENCE_CHARACTERS)));
  }
}

export class BadArgument extends UserError {}
export class UnknownName extends UserError {}
export class SelectorError extends UserError {}
export class GroupingError extends UserError {}

/** The value of a function, or the sentence of the `UserError` that it throws. Other errors are defects. */
export function attempt<T>(make: () => T): { value: T; error?: undefined } | { value?: undefined; error: string } {
  try {
    return { value: make() };
  } catch (error) {
    if (error instanceof UserError) return { error: error.message };
    throw error;
  }
}

/** The characters (code points) of a text. */
export function characters(text: string): string[] {
  return Array.from(text);
}

/** Number of characters (code points). */
export function length(text: string): number {
  let pairs = 0;
  for (let i = 0; i + 1 < text.length; i++) {
    if ((text.charCodeAt(i) & 0xfc00) === 0xd800 && (text.charCodeAt(i + 1) & 0xfc00) === 0xdc00) pairs++, i++;
  }
  return text.length - pairs;
}

const UNPRINTABLE = /[\p{C}\p{Z}]/u;

function isPrintable(character: string): boolean {
  return character === " " || !UNPRINTABLE.test(character);
}

function escaped(character: string): string {
  const short: Record<string, string> = { "\n": "\\n", "\r": "\\r", "\t": "\\t" };
  if (character in short) return short[character];
  const code = character.codePointAt(0)!;
  if (code < 0x100) return `\\x${code.toString(16).padStart(2, "0")}`;
  if (code < 0x10000) return `\\u${code.toString(16).padStart(4, "0")}`;
  return `\\U${code.toString(16).padStart(8, "0")}`;
}

/** Text with its unprintable characters as escapes. */
export function visible(text: string): string {
  return characters(text)
    .map((character) => (isPrintable(character) ? character : escaped(character)))
    .join("");
}

/** Text as Python's `repr` writes it, with quotes. */
export function quoted(text: string): string {
  const quote = text.includes("'") && !text.includes('"') ? '"' : "'";
  const inner = characters(text).map((character) => {
    if (character === quote || character === "\\") return `\\${character}`;
    return isPrintable(character) ? character : escaped(character);
  });
  return quote + inner.join("") + quote;
}

/** A whole number with commas between thousands. */
export function thousands(number: number | bigint): string {
  return String(number).replace(/\B(?=(\d{3})+$)/g, ",");
}

/** A text of at most about `most` characters: a longer one without its middle, and how much that is. */
export function shortened(text: string, most = SHOWN_CHARACTERS): string {
  if (text.length <= most) return text;
  const all = characters(text);
  if (all.length <= most) return text;
  const first = Math.floor((most * 2) / 3);
  const last = Math.floor(most / 3);
  const left = thousands(all.length - first - last);
  return `${all.slice(0, first).join("")} [... ${left} characters ...] ${all.slice(-last).join("")}`;
}

/** Names joined for a message: at most `limit` of them, then how many more there are. */
export function listing(names: Iterable<string | number>, limit = 12): string {
  const items = Array.from(names, (name) => shortened(String(name)));
  if (!items.length) return "none";
  const shown = items.slice(0, limit).join(", ");
  return items.length <= limit ? shown : `${shown} and ${items.length - limit} more`;
}

/** Text for comparing without regard to case, as Python's `casefold`. */
export function casefold(text: string): string {
  if (/^[\x00-\x7f]*$/.test(text)) return text.toLowerCase();
  return characters(text).map(foldedCharacter).join("");
}

function foldedCharacter(character: string): string {
  const code = character.codePointAt(0)!;
  if (code === 0x131) return character; // dotless i
  if (code === 0x1e9e) return "ss"; // capital sharp s
  // Cherokee folds to its capitals.
  if ((code >= 0x13a0 && code < 0x1400) || (code >= 0xab70 && code < 0xabc0)) return character.toUpperCase();
  return characters(character.toUpperCase())
    .map((upper) => upper.toLowerCase())
    .join("");
}

/** White space as Python's `\s` and `strip` take it; JavaScript's differ. */
export const SPACE = "\\t-\\r\\x1c-\\x20\\x85\\xa0\\u1680\\u2000-\\u200a\\u2028\\u2029\\u202f\\u205f\\u3000";
const LEADING = new RegExp(`^[${SPACE}]+`, "u");
const TRAILING_ONE = new RegExp(`[${SPACE}]`, "u");

export function trimmedEnd(text: string): string {
  let end = text.length;
  while (end > 0 && TRAILING_ONE.test(text[end - 1])) end--;
  return text.slice(0, end);
}

export function trimmed(text: string): string {
  return trimmedEnd(text).replace(LEADING, "");
}

/** A run of decimal digits of any script as a number in ASCII; null for any other text. */
export function decimalDigits(text: string): string | null {
  if (!/^\p{Nd}+$/u.test(text)) return null;
  return characters(text)
    .map((character) => {
      let first = character.codePointAt(0)!;
      while (/\p{Nd}/u.test(String.fromCodePoint(first - 1))) first--;
      return String((character.codePointAt(0)! - first) % 10);
    })
    .join("");
}

/** " Did you mean 'x'?" for the nearest existing name, or an empty text when nothing is near. */
export function didYouMean(given: string, existing: Iterable<string>): string {
  if (length(given) > NAME_CHARACTERS) return "";
  const byFolded = new Map<string, string>();
  let compared = 0;
  for (const name of existing) {
    if (compared++ >= COMPARED_NAMES) break;
    if (length(name) <= NAME_CHARACTERS) byFolded.set(casefold(name), name);
  }
  const folded = casefold(given);
  const names = [...byFolded.keys()];
  const long = length(folded) > 2;
  const near =
    (long ? names.find((name) => name.startsWith(folded)) : undefined) ??
    closest(folded, names) ??
    (long ? names.find((name) => name.includes(folded)) : undefined);
  return near === undefined ? "" : ` Did you mean '${byFolded.get(near)}'?`;
}

/** The error for a name that does not exist: what was given, the nearest name, and what exists. */
export function unknownName(kind: string, given: string, existing: Iterable<string>): UnknownName {
  const names = [...existing];
  return new UnknownName(
    `Unknown ${kind} '${shortened(given)}'.${didYouMean(given, names)} Existing: ${listing(names)}.`,
  );
}

/** The name most similar to a word, as Python's `difflib.get_close_matches(word, names, n=1, cutoff=0.6)`. */
function closest(word: string, names: readonly string[]): string | undefined {
  const wanted = characters(word);
  let best: string | undefined;
  let highest = 0;
  for (const name of names) {
    const given = characters(name);
    const total = given.length + wanted.length;
    const similar = total ? (2 * matching(given, wanted)) / total : 1;
    if (similar < 0.6) continue;
    if (best === undefined || similar > highest || (similar === highest && comesAfter(name, best))) {
      best = name;
      highest = similar;
    }
  }
  return best;
}

function comesAfter(one: string, other: string): boolean {
  const [a, b] = [characters(one), characters(other)];
  for (let i = 0; i < a.length && i < b.length; i++) {
    if (a[i] !== b[i]) return a[i].codePointAt(0)! > b[i].codePointAt(0)!;
  }
  return a.length > b.length;
}

/** Number of characters in the matching blocks that `difflib.SequenceMatcher` finds. */
function matching(a: readonly string[], b: readonly string[]): number {
  const places = new Map<string, number[]>();
  b.forEach((character, j) => {
    const list = places.get(character);
    if (list) list.push(j);
    else places.set(character, [j]);
  });
  if (b.length >= 200) {
    const most = Math.floor(b.length / 100) + 1;
    for (const [character, list] of places) if (list.length > most) places.delete(character);
  }
  const pending: [number, number, number, number][] = [[0, a.length, 0, b.length]];
  let count = 0;
  while (pending.length) {
    const [aLow, aHigh, bLow, bHigh] = pending.pop()!;
    const [i, j, size] = longestMatch(a, b, places, aLow, aHigh, bLow, bHigh);
    if (!size) continue;
    count += size;
    if (aLow < i && bLow < j) pending.push([aLow, i, bLow, j]);
    if (i + size < aHigh && j + size < bHigh) pending.push([i + size, aHigh, j + size, bHigh]);
  }
  return count;
}

function longestMatch(
  a: readonly string[],
  b: readonly string[],
  places: ReadonlyMap<string, number[]>,
  aLow: number,
  aHigh: number,
  bLow: number,
  bHigh: number,
): [number, number, number] {
  let [bestA, bestB, size] = [aLow, bLow, 0];
  let lengths = new Map<number, number>();
  for (let i = aLow; i < aHigh; i++) {
    const next = new Map<number, number>();
    for (const j of places.get(a[i]) ?? []) {
      if (j < bLow) continue;
      if (j >= bHigh) break;
      const run = (lengths.get(j - 1) ?? 0) + 1;
      next.set(j, run);
      if (run > size) [bestA, bestB, size] = [i - run + 1, j - run + 1, run];
    }
    lengths = next;
  }
  while (bestA > aLow && bestB > bLow && a[bestA - 1] === b[bestB - 1]) [bestA, bestB, size] = [bestA - 1, bestB - 1, size + 1];
  while (bestA + size < aHigh && bestB + size < bHigh && a[bestA + size] === b[bestB + size]) size++;
  return [bestA, bestB, size];
}
