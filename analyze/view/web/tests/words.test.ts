import assert from "node:assert/strict";
import { test } from "node:test";

import { pretend } from "./page";

pretend();
const { piecesOf } = await import("../src/words");

const of = (sentence: string, ...words: string[]): string[] =>
  piecesOf(sentence, words).map(({ text, place }) => (place === null ? `(${text})` : text));

test("what stands between words is kept: signs, emoji, in any script", () => {
  assert.deepEqual(of("Pick the 🍎, then - wait!", "pick", "the", "then", "wait"), ["Pick", "the", "(🍎,)", "then", "(-)", "wait", "(!)"]);
  assert.deepEqual(of("المس المكعب الأحمر.", "المس", "المكعب", "الأحمر"), ["المس", "المكعب", "الأحمر", "(.)"]);
  assert.deepEqual(of("the cup on the cup", "the", "cup", "on", "the", "cup"), ["the", "cup", "on", "the", "cup"]);
});

test("of a sentence that does not hold all words in their order the words stand alone", () => {
  assert.deepEqual(of("touch it", "touch", "this"), ["touch", "this"]);
});

test("a place is the word's own", () => {
  assert.deepEqual(
    piecesOf("a, b", ["a", "b"]).map(({ place }) => place),
    [0, null, 1],
  );
});
