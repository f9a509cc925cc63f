// Runs what the page computes in node: `node viewer_in_node.mjs viewer.mjs CASES.json RESULTS.json`; see viewer_in_node.py.
// What Python makes of groupings is in the cases, as `expected`.
import { readFile, writeFile } from "node:fs/promises";

globalThis.self = globalThis; // the page's script takes a place without a document for a worker
const [module, from, to] = process.argv.slice(2);
const { engine } = await import(module);
const given = JSON.parse(await readFile(from, "utf8"));

const numbers = (values) => Array.from(values, (value) => (Number.isFinite(value) ? value : String(value)));
const pythons = (values) => values.map((value) => ({ NaN: "nan", Infinity: "inf", "-Infinity": "-inf" })[value] ?? value);
const every = (list, replans) => Array.from({ length: replans }, (_, replan) => engine.ofReplan(list, replan));
const flat = (lists) => pythons(numbers(lists.flatMap((list) => Array.from(list))));

function tokensOf(episode) {
  const keys = episode.layout.spans.at(-1).stop;
  const coverage = new Map(
    Object.entries(episode.coverage).map(([camera, { shape, values }]) => {
      const [replans, patches, objects] = shape;
      return [camera, { replans, patches, objects, values: Float32Array.from(values) }];
    }),
  );
  return new engine.EpisodeTokens({
    layout: episode.layout,
    keyRole: { replans: episode.key_role.length / keys, keys, codes: Uint8Array.from(episode.key_role) },
    numReplans: episode.num_replans,
    prompts: episode.prompts,
    promptIndex: episode.prompt_index,
    objects: episode.objects,
    coverage,
  });
}

function chosenGrouping(one, vocabulary) {
  const base = one.base === null ? null : engine.findGrouping(one.base, vocabulary);
  const grouping = one.groups.length ? engine.withGroups(base, one.groups.map(engine.parseGroupArgument)) : base;
  return engine.makeGrouping({
    ...grouping,
    ratio: one.ratio === null ? grouping.ratio : engine.parseRatioArgument(one.ratio),
    overlap: grouping.overlap || one.overlap,
    allowEmpty: one.allow_empty ? [...grouping.groups.keys()] : grouping.allowEmpty,
  });
}

// Mean over heads and denoise steps of rows (replan, layer, denoise, head, key), by layer: (replan, key).
function meanRows(values, keys, replans, [layers, denoise, heads]) {
  return Array.from({ length: layers }, (_, layer) => {
    const rows = new Float64Array(replans * keys);
    for (let replan = 0; replan < replans; replan++) {
      const first = (replan * layers + layer) * denoise * heads;
      for (let cell = first; cell < first + denoise * heads; cell++) {
        for (let key = 0; key < keys; key++) rows[replan * keys + key] += values[cell * keys + key] / denoise / heads;
      }
    }
    return rows;
  });
}

// Mean of what uniform attention gives, as stored (replan, layer, denoise, head, query, key), over a selection: (key) of
// each replan or once.
function meanUniform({ shape, values }, selection) {
  const { layers, denoise, heads, query } = engine.storedPlaces(shape, selection);
  const queries = query === "mean" ? [...Array(shape[4]).keys()] : [query];
  const places = layers.flatMap((l) => denoise.flatMap((d) => heads.flatMap((h) => queries.map((q) => [l, d, h, q]))));
  return Array.from({ length: shape[0] }, (_, replan) => {
    const mean = new Float64Array(shape[5]);
    for (const place of places) {
      const first = [replan, ...place].reduce((at, position, axis) => at * shape[axis] + position, 0) * shape[5];
      for (let key = 0; key < shape[5]; key++) mean[key] += values[first + key] / places.length;
    }
    return mean;
  });
}

function measured(one) {
  const tokens = tokensOf(given.episodes[one.episode]);
  const others = one.vocabulary.map((number) => tokensOf(given.episodes[number]));
  const vocabulary = engine.vocabularyOf(others);
  const grouping = chosenGrouping(one, vocabulary);
  const resolved = engine.resolveChecked(grouping, tokens, vocabulary);
  const replans = tokens.numReplans;
  const weights = engine.withValid(resolved, tokens);
  const rows = meanRows(one.rows, tokens.keys, replans, given.axes);
  const layers = rows.map((own) => engine.layerMasses(own, weights, tokens.keys));
  const [numLayers, denoise, heads] = given.axes.map((length) => [...Array(length).keys()]);
  const uniform = numLayers.map((layer) => {
    const selection = { layers: [layer], denoise, heads, query: "mean" };
    return engine.uniformMasses(meanUniform(one.uniform, selection), weights, tokens.keys);
  });
  // A layer each, and their mean as the last, as in the tables.
  const values = [...numLayers.map((layer) => [layer]), numLayers].map((own) =>
    engine.replanValues(own.map((i) => layers[i]), own.map((i) => uniform[i]), grouping, resolved),
  );
  const byReplan = Array.from({ length: replans }, (_, replan) => values.map((of) => of[replan]));
  const groups = (name) => flat(byReplan.flatMap((of) => of.map((value) => value.groups[name])));
  const cells = (get) => flat(byReplan.map((of) => of.map(get)));
  const segments = one.expected.segments && engine.weightsOnSegments(weights, tokens, one.expected.segments);
  const ratio = grouping.ratio && {
    numerator_mass: cells((value) => value.ratio.numerator),
    denominator_mass: cells((value) => value.ratio.denominator),
    ratio: cells((value) => value.ratio.value),
    ratio_mean: cells((value) => value.ratio.mean),
    uniform_ratio: cells((value) => value.ratio.uniform),
    ratio_lift: cells((value) => value.ratio.lift),
    log2_ratio: cells((value) => Math.log2(value.ratio.value)),
  };
  return {
    names: resolved.names,
    name: grouping.name,
    description: grouping.description,
    weights: flat(every(resolved.weights, replans)),
    num_keys: flat(every(resolved.numKeys, replans)),
    num_valid: flat([every(resolved.numValid, replans)]),
    on_segments: segments && flat(every(segments, replans)),
    groups: Object.fromEntries(["mass", "fraction", "density", "lift"].map((name) => [name, groups(name)])),
    cells: { valid_mass: cells((value) => value.validMass), num_valid: cells((value) => value.numValid), ...ratio },
  };
}

/** The selector after cells were painted, and after half of them were erased again. */
function painted({ layout, camera, cells }) {
  const drawn = engine.paintedPatches("role:bos", layout, camera, cells, false);
  return [drawn, engine.paintedPatches(drawn, layout, camera, cells.slice(cells.length / 2), true)];
}

const answers = { cases: measured, painted };
const results = {};
for (const [kind, answer] of Object.entries(answers)) {
  results[kind] = (given[kind] ?? []).map((one) => {
    const found = engine.attempt(() => answer(one));
    return found.error === undefined ? found.value : { error: found.error };
  });
}
await writeFile(to, JSON.stringify(results));
