import assert from "node:assert/strict";
import { test } from "node:test";

import { pretend } from "./page";

pretend();
const { escaped, wrapped } = await import("../src/figure");
const { outline } = await import("../src/sums");

test("wrapped text loses no word, and no line is longer than its room but for a word that is", () => {
  const text =
    "Solved: told 'touch the red cube', done after 14 steps, in a sentence that goes on for_a_word_that_is_longer_than_all_the_room_there_is";
  for (const width of [80, 200, 1000]) {
    const lines = wrapped(text, width);
    assert.equal(lines.join(" "), text);
    for (const line of lines) assert.ok(line.length <= Math.max(10, width / 6.9) || !line.includes(" "), line);
  }
});

test("no text ends an element of an SVG, or begins one", () => {
  assert.doesNotMatch(escaped(`</text><script>alert("1")</script>&`), /[<>"]/);
});

test("lines are in pixels where cells have a size", () => {
  const camera = {
    rows: 2,
    columns: 2,
    height: 4,
    width: 4,
    keys: [],
    cells: [],
    shares: null,
    upright: true,
    mirrored: false,
    stored: true,
    note: "",
  };
  assert.equal(
    outline(camera, (cell) => cell === 3, [10, 20]),
    "M10 20H20M10 40H20M10 20V40M20 20V40",
  );
});
