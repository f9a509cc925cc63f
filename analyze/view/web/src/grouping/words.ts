/** Words of an instruction and the keys (token pieces) that spell them: schemas/groupings/words.py. */
import STOP_LIST from "../../../../../schemas/groupings/word_lists/english_stop_words.txt";
import type { PromptDocument } from "../store/documents";
import { BadArgument, casefold, characters, length } from "./text";

/** One word of the instruction: its text, its characters (code points) in the prompt, the keys of all its pieces. */
export interface Word {
  readonly text: string;
  readonly start: number;
  readonly stop: number;
  readonly keys: readonly number[];
}

const LETTER = "\\p{L}\\p{N}_";
const WORD = new RegExp(`[${LETTER}]+(?:['\\u2019-][${LETTER}]+)*`, "gu");
const STOP_WORDS = new Set(
  STOP_LIST.split("\n").flatMap((line) => line.split("#")[0].split(/\s+/).filter((word) => word)),
);

/** Places [start, stop) in characters of the words of a text; underscores separate words. */
export function splitWords(text: string): [number, number][] {
  const places: [number, number][] = [];
  let [position, unit] = [0, 0];
  for (const match of text.replace(/_/g, " ").matchAll(WORD)) {
    const start = position + length(text.slice(unit, match.index));
    const stop = start + length(match[0]);
    places.push([start, stop]);
    [position, unit] = [stop, match.index + match[0].length];
  }
  return places;
}

/** The words themselves. */
export function wordTexts(text: string): string[] {
  const all = characters(text);
  return splitWords(text).map(([start, stop]) => all.slice(start, stop).join(""));
}

/** The words of the prompt's instruction, in order. A piece that touches a word's characters belongs to it. */
export function wordsOf(prompt: PromptDocument): Word[] {
  const [first, last] = prompt.instruction;
  const inside = prompt.pieces.filter((piece) => piece.start < last && piece.stop > first);
  const text = characters(prompt.text).slice(first, last);
  const places = splitWords(text.join(""));
  const most = 10 * (inside.length + places.length) + 1000;
  let touched = 0;
  const keys: number[][] = places.map(() => []);
  for (const piece of inside) {
    places.forEach(([start, stop], i) => {
      if (first + stop > piece.start && first + start < piece.stop) {
        touched++;
        keys[i].push(piece.key);
      }
    });
    if (touched > most) {
      throw new BadArgument(
        `The pieces of a prompt overlap: ${inside.length} touch the ${places.length} words too often.`,
      );
    }
  }
  return places.map(([start, stop], i) => ({
    text: text.slice(start, stop).join(""),
    start: first + start,
    stop: first + stop,
    keys: keys[i],
  }));
}

/** Every word that takes part in an occurrence of the phrase: whole words, in sequence, without regard to case. */
export function findPhrase(words: readonly Word[], phrase: string): Word[] {
  const wanted = wordTexts(phrase).map(casefold);
  const given = words.map((word) => casefold(word.text));
  const taken = new Set<number>();
  for (const first of occurrences(given, wanted)) wanted.forEach((_, i) => taken.add(first + i));
  return words.filter((_, i) => taken.has(i));
}

/** Whether the words of a phrase follow each other in a sentence of case-folded words. */
export function hasPhrase(sentence: readonly string[], phrase: string): boolean {
  return occurrences(sentence, wordTexts(phrase).map(casefold)).length > 0;
}

/** `stop` for a word of the stop list, else `content`; independent of the sentence. */
export function wordClass(word: string): "content" | "stop" {
  return STOP_WORDS.has(casefold(word).replaceAll("\u2019", "'")) ? "stop" : "content";
}

function occurrences(given: readonly string[], wanted: readonly string[]): number[] {
  const found: number[] = [];
  if (!wanted.length) return found;
  for (let first = 0; first + wanted.length <= given.length; first++) {
    if (wanted.every((word, i) => given[first + i] === word)) found.push(first);
  }
  return found;
}
