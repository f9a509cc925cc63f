import assert from "node:assert/strict";
import { test } from "node:test";

import { pretend } from "./page";

const { location, history } = pretend("#run=0&episode=a&group=base_0_rgb:3.4;words:1;=object:cup&curve=constructor&unknown=1");
const state = await import("../src/state");

test("what the link says is there, and what is not in it has its default", () => {
  assert.deepEqual([state.part("episode"), state.part("layer"), state.part("curve")], ["a", "mean", "constructor"]);
  assert.deepEqual(state.picked.value, { cells: { base_0_rgb: [3, 4] }, words: [1], selector: "object:cup" });
});

test("a group that is written into the link is read from it again", () => {
  const groups: (typeof state.picked.value)[] = [
    { cells: { a: [0], "b:c": [1, 2] }, words: [], selector: "" },
    { cells: {}, words: [0, 5], selector: "word:'a;b'" },
    { cells: {}, words: [], selector: "" },
  ];
  for (const group of groups) {
    state.setPart({ group: state.groupOf(group) });
    assert.deepEqual(state.picked.value, { ...group, selector: group.selector.replaceAll(";", " ") });
  }
});

test("a change is in the link without a step back, a step has one, and the same step has none", () => {
  const before = history.length;
  state.setPart({ layer: 3 });
  assert.match(location.hash, /layer=3/);
  assert.equal(history.length, before);
  state.step({ layer: 4 });
  state.step({ layer: 4 });
  assert.equal(history.length, before + 1);
});

test("closing an episode leaves the run's own choices", () => {
  state.setPart({ run: 0, sort: "longest", find: "red" });
  state.closeEpisode();
  assert.deepEqual([state.part("episode"), state.part("layer"), state.part("sort"), state.part("find")], ["", "mean", "longest", "red"]);
});

test("toggling twice changes nothing", () => {
  assert.deepEqual(state.toggled([1, 4], 2), [1, 2, 4]);
  assert.deepEqual(state.toggled(state.toggled([1, 4], 2), 2), [1, 4]);
});
