// Pure parts of the page in node: `node page_pieces.mjs viewer.mjs CASES.json RESULTS.json`; test_page_pieces.py compares.
import { readFile, writeFile } from "node:fs/promises";

globalThis.self = globalThis; // the page's script takes a place without a document for a worker
const [module, from, to] = process.argv.slice(2);
const { reading } = await import(module);
const { grids, links, actions, strokes, searches } = JSON.parse(await readFile(from, "utf8"));

const centre = ([left, top, width, height]) => [left + width / 2, top + height / 2];
const results = {
  // For each patch: where its centre is shown, and the patch that is found there.
  grids: grids.map(({ rows, columns, upright, mirrored }) => {
    const span = { grid: { rows, columns, image_height: 2 * rows, image_width: 2 * columns } };
    const view = { upright, mirrored };
    return Array.from({ length: rows * columns }, (_, patch) => {
      const place = centre(reading.placeOfPatch(patch, span, view));
      return [...place, reading.patchAt(...place, span, view)];
    });
  }),
  links: links.map((query) => reading.linkOfState(reading.stateOfLink(query))),
  actions: actions.map(({ shape, values, starts, end }) =>
    reading.closingReplan({ replans: shape[0], size: shape[1] * shape[2], shape, values: Float64Array.from(values) }, starts, end),
  ),
  strokes: strokes.map(([start, stop, columns]) => reading.patchesBetween(start, stop, columns)),
  searches: searches.map(({ rows, search, sort }) => reading.found(rows, search, sort).map((row) => row.name)),
};
await writeFile(to, JSON.stringify(results));
