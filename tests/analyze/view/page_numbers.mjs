// Reads stores with the page's own script: `node page_numbers.mjs viewer.mjs QUESTIONS.json ANSWERS.json`.
// A question is a store at an address, an episode and a link's query; the answer what the page shows for it.
import { readFile, writeFile } from "node:fs/promises";

globalThis.self = globalThis; // the page's script takes a place without a document for a worker
const [module, from, to] = process.argv.slice(2);
const { reading, engine } = await import(module);

const libraries = new Map();

function libraryAt(base) {
  if (!libraries.has(base)) libraries.set(base, new reading.Library([reading.inProcessPort(), reading.inProcessPort()], base));
  return libraries.get(base);
}

const plain = (value) => (typeof value === "number" && !Number.isFinite(value) ? String(value) : value);
const plainList = (values) => Array.from(values, plain);

function ofReplan(values, names) {
  const groups = Object.fromEntries(
    names.map((name, i) => [name, ["mass", "fraction", "keys", "lift"].map((of) => plain(values.groups[of][i]))]),
  );
  const { ratio } = values;
  return { groups, ratio: ratio ? [ratio.value, ratio.uniform, ratio.lift].map(plain) : null };
}

/** Sizes of every item by reader, of the episode (mean, lowest, highest, number) and of each replan; what words say of them. */
function ofEffects({ effects, words, replan }) {
  if (!effects?.known) return effects && { note: effects.note, waiting: effects.waiting };
  const { known } = effects;
  const of = (values) => {
    const { mean, low, high, count } = reading.sizesOf(values, null);
    return { mean: [mean, low, high, count].map(plain), replans: plainList(values) };
  };
  const ofItems = (items) =>
    Object.fromEntries(items.map(({ name, by }) => [name, Object.fromEntries(Object.entries(by).map(([reader, values]) => [reader, of(values)]))]));
  return {
    items: ofItems(known.items),
    random: ofItems(known.random),
    noise: known.noise && of(known.noise),
    unchanged: known.unchanged && of(known.unchanged),
    sentences: [null, replan].map((at) => reading.decidingWord(known, at)),
    words: reading.itemsOfWords(known, words).map((item) => reading.wordEffect(item, known, null)).map(({ size, ...more }) => ({ mean: plain(size.mean), ...more })),
  };
}

async function answerOf({ base, root, episode, query, summary }) {
  const entry = { name: root.replace(/\/$/, ""), root, episodes: [{ name: episode }], summary };
  const store = await libraryAt(base).openStore(entry);
  const opened = await store.openEpisode(episode);
  if (summary) await store.readEffectUnits();
  const state = { ...reading.stateOfLink(query), episode };
  const shown = await reading.loadShown(store, opened, state);
  const { site, row, valid, uniform, replan, numbers, selection } = shown;
  const names = [...numbers.grouping.groups.keys()];
  const heads = await opened.headRows(site.layout.name, selection, replan);
  const cells = site.layers.map((_, layer) =>
    site.heads.map((_, head) => {
      const cell = numbers.cell(replan, layer, head);
      return Object.fromEntries(names.map((name, i) => [name, plain(cell.lift[i])]));
    }),
  );
  const cameras = [...shown.frames].map(([camera, frame]) => {
    const map = new engine.PictureMap(site.layout, camera);
    const view = reading.viewOf(store.root.policy.cameras, camera);
    const own = reading.shownValues(map, row, valid, uniform, state.measure);
    const scale = reading.scaleFor(own, state.measure, 1);
    const painting = { scale: { ...scale, high: 3 }, colours: reading.colourTable(state.colours), opacity: 0.8, smooth: state.smooth };
    const { height, width, pixels } = reading.overlayPixels(frame, own, map, view, painting);
    const things = reading.objectsAt(shown, camera, map, 0);
    return { camera, values: plainList(own), high: scale.high, height, width, pixels: [...pixels], things, stored: frame !== null };
  });
  return {
    link: reading.linkOfState(state),
    site: site.layout.name,
    corrections: shown.corrections,
    note: shown.baselineNote,
    row: plainList(row),
    uniform: shown.allUniform.map(plainList),
    replans: numbers.replans.map((values) => ofReplan(values, names)),
    cells,
    cameras,
    words: shown.words.map((word) => ({ text: word.text, keys: word.keys, ...reading.measuresOfKeys(word.keys, shown) })),
    readers: shown.words.length ? reading.headsThatRead(heads, shown.words[0].keys, 3) : [],
    effects: ofEffects(shown),
    happened: reading.happenings(opened.document.steps, opened.document.task_id),
    events: await reading.eventsOf(store.root, opened),
  };
}

const answers = [];
for (const question of JSON.parse(await readFile(from, "utf8"))) {
  try {
    answers.push(await answerOf(question));
  } catch (failure) {
    const told = failure instanceof engine.UserError || failure.name === "StoreError" || failure.name === "NotThere";
    answers.push({ failure: failure.message, told, at: told ? "" : failure.stack });
  }
}
await writeFile(to, JSON.stringify(answers));
