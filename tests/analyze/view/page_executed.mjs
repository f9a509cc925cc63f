// Steps of chunks of 6 that were executed: `node page_executed.mjs viewer.mjs CASES.json RESULTS.json`.
import { readFile, writeFile } from "node:fs/promises";

globalThis.self = globalThis; // the page's script takes a place without a document for a worker
const [module, from, to] = process.argv.slice(2);
const { reading } = await import(module);
const results = JSON.parse(await readFile(from, "utf8")).map(({ name, replan_steps, wait, steps, total }) =>
  reading.executedSteps({ protocol: { name, replan_steps, wait_steps: wait } }, { env_step: steps, num_steps: total, num_replans: steps.length }, 6),
);
await writeFile(to, JSON.stringify(results));
