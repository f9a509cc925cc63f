import assert from "node:assert/strict";
import { test } from "node:test";

import type { CameraLayout } from "../src/answers";
import { cellLifts, cellSums, keyMasses, meanOf, outline, percent, range, scaleEnd, shown, strengthOf } from "../src/sums";

const camera = (rows: number, columns: number, more: Partial<CameraLayout> = {}): CameraLayout => ({
  rows,
  columns,
  height: rows,
  width: columns,
  keys: range(rows * columns),
  cells: range(rows * columns),
  shares: null,
  upright: true,
  mirrored: false,
  stored: true,
  note: "",
  ...more,
});

test("masses of keys are means over denoise steps and heads, or one of them", () => {
  const [replans, steps, heads, keys] = [2, 3, 2, 4];
  const data = Float32Array.from(range(replans * steps * heads * keys));
  const at = (replan: number, step: number, head: number, key: number): number => ((replan * steps + step) * heads + head) * keys + key;
  const rows = { shape: [replans, steps, heads, keys], data };
  const mean = (values: number[]): number => values.reduce((a, b) => a + b) / values.length;
  const close = (one: number, other: number): void => assert.ok(Math.abs(one - other) < 1e-9, `${one} is not ${other}`);
  const all = keyMasses(rows, "mean", "mean");
  const one = keyMasses(rows, 1, 0);
  for (const replan of range(replans))
    for (const key of range(keys)) {
      close(all[replan]![key]!, mean(range(steps).flatMap((step) => range(heads).map((head) => at(replan, step, head, key)))));
      assert.equal(one[replan]![key], at(replan, 1, 0, key));
    }
});

test("a map adds the parts of masses, and even attention has lift 1 in every cell", () => {
  const split = camera(1, 3, { keys: [0, 0, 1], cells: [0, 1, 2], shares: [0.25, 0.75, 1] });
  assert.deepEqual([...cellSums([0.4, 0.6], split)], [0.1, 0.30000000000000004, 0.6]);
  const even = Float64Array.of(0.5, 0.5);
  for (const lift of cellLifts(even, even, split)) assert.equal(lift, 1);
});

test("an outline has every edge between inside and outside once", () => {
  for (const seed of range(50)) {
    let state = seed + 1;
    const next = (): number => {
      state = (state * 48271) % 2147483647;
      return state / 2147483647;
    };
    const [rows, columns] = [1 + Math.floor(6 * next()), 1 + Math.floor(6 * next())];
    const inside = range(rows * columns).map(() => next() < 0.5);
    const has = (row: number, column: number): boolean =>
      row >= 0 && column >= 0 && row < rows && column < columns && inside[row * columns + column]!;
    let edges = 0;
    for (const row of range(rows + 1)) for (const column of range(columns)) edges += Number(has(row, column) !== has(row - 1, column));
    for (const row of range(rows)) for (const column of range(columns + 1)) edges += Number(has(row, column) !== has(row, column - 1));
    const drawn = [...outline(camera(rows, columns), (cell) => inside[cell]!).matchAll(/M([\d.]+) ([\d.]+)([HV])([\d.]+)/g)];
    assert.equal(
      drawn.reduce((sum, [, x, y, way, to]) => sum + Number(to) - Number(way === "H" ? x : y), 0),
      edges,
    );
  }
});

test("a scale ends at 4 or above, with two digits", () => {
  assert.equal(scaleEnd([1, 1, NaN]), 4);
  assert.equal(scaleEnd(range(1000).map((i) => i / 10)), 100);
  assert.equal(scaleEnd([]), 4);
});

test("numbers have three digits, and what is none is a dash", () => {
  assert.deepEqual(
    [shown(12345), shown(0.12345), shown(NaN), shown(null), percent(0.12345), percent(0.012345)],
    ["12300", "0.123", "-", "-", "12.3%", "1.2%"],
  );
});

test("means leave out what is missing, place by place", () => {
  assert.deepEqual(
    meanOf([
      [1, NaN],
      [3, 4],
    ]),
    [2, 4],
  );
  assert.deepEqual(meanOf([]), []);
});

test("a word is coloured by the part that moves most, and by none that noise moves as far", () => {
  const full = [5, 45, 0.5];
  assert.equal(strengthOf([2.5, 0, 0], [1, 1, 0], full), 0.5);
  assert.equal(strengthOf([0.5, 84, 0], [1, 1, 0], full), 1);
  assert.equal(strengthOf([0.9, 0.9, 0], [1, 1, 0], full), 0);
  assert.equal(strengthOf([], [1, 1, 0], full), 0);
  assert.equal(strengthOf([NaN, 9], [NaN, NaN], full), 0.2);
});
