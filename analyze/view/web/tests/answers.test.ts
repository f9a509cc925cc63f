import assert from "node:assert/strict";
import { test } from "node:test";

import { pretend } from "./page";

pretend();
const asked: string[] = [];
/** A file of numbers of so many bytes, as the server sends them. */
function numbers(bytes: number): ArrayBuffer {
  const header = `{'descr': '<f4', 'fortran_order': False, 'shape': (${bytes / 4},), }`.padEnd(118);
  const file = new Uint8Array(128 + bytes);
  file.set([0x93, 0x4e, 0x55, 0x4d, 0x50, 0x59, 1, 0, 118, 0]);
  file.set(new TextEncoder().encode(header), 10);
  return file.buffer;
}
let status = 200;
globalThis.fetch = ((address: string) => {
  asked.push(address);
  return Promise.resolve(status === 200 ? new Response(numbers(16e6)) : new Response('{"error": "a.zarr is gone"}', { status }));
}) as unknown as typeof fetch;
const { MOST_BYTES, readArray, trouble } = await import("../src/answers");

test("what was asked for stays while it is below a number of bytes, the last used longest", async () => {
  const fitting = Math.floor(MOST_BYTES / 16e6);
  for (let i = 0; i < fitting - 1; i++) assert.deepEqual((await readArray(`${i}.npy`)).shape, [4e6]);
  await readArray("0.npy"); // used again
  assert.equal(asked.length, fitting - 1);
  await readArray("more.npy");
  await readArray("0.npy");
  assert.equal(asked.length, fitting);
  await readArray("1.npy");
  assert.deepEqual(asked.slice(fitting), ["1.npy"]);
});

test("a store that is gone is said, until there is an answer again", async () => {
  status = 410;
  await assert.rejects(readArray("gone.npy"), /a.zarr is gone/);
  assert.equal(trouble.value, "a.zarr is gone");
  status = 200;
  await readArray("gone.npy");
  assert.equal(trouble.value, "");
});
