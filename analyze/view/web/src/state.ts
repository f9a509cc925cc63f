/** What is shown, as signals: the link (run, episode, replan, layer ...), and what was read for it. */
import { batch, computed, effect, type ReadonlySignal, type Signal, signal } from "@preact/signals";

import {
  type About,
  address,
  type Covered,
  type EpisodeEvent,
  type EpisodeLine,
  type Groups,
  type Moves,
  type NumberArray,
  type RunNumbers,
  readArray,
  readJson,
  readJsonNow,
  readRuns,
  type SiteLayout,
  type Word,
} from "./answers";
import { type Choice, keyMasses } from "./sums";

export interface Answer<T> {
  readonly value: T | null;
  readonly error: string | null;
  /** Whether another one was asked for since. */
  readonly pending: boolean;
}

/** What `ask` gives, read anew whenever a signal that it uses changes; null asks nothing. Until it is there, the last one stays. */
export function answered<T>(ask: () => Promise<T> | null): ReadonlySignal<Answer<T>> {
  const answer = signal<Answer<T>>({ value: null, error: null, pending: false });
  let newest = 0;
  effect(() => {
    const own = ++newest;
    const asked = ask();
    if (asked === null) {
      answer.value = { value: null, error: null, pending: false };
      return;
    }
    answer.value = { ...answer.peek(), pending: true };
    const settle = (value: T | null, error: string | null): void => {
      if (own === newest) answer.value = { value, error, pending: false };
    };
    asked.then(
      (value) => settle(value, null),
      (error: unknown) => settle(null, error instanceof Error ? error.message : String(error)),
    );
  });
  return answer;
}

/** The parts of the link, as texts; what is not in it has its default. */
const DEFAULTS = {
  run: "0",
  episode: "",
  replan: "0",
  site: "",
  layer: "mean",
  head: "mean",
  denoise: "mean",
  words: "",
  beside: "",
  group: "",
  without: "",
  find: "",
  task: "",
  show: "all",
  curve: "ratio",
  lines: "both",
  step: "",
  sort: "task",
  target: "",
  of: "",
} as const;
export type Part = keyof typeof DEFAULTS;

const link = Object.fromEntries(Object.entries(DEFAULTS).map(([name, text]) => [name, signal<string>(text)])) as Record<
  Part,
  Signal<string>
>;

function readLink(): void {
  const given = new URLSearchParams(location.hash.slice(1));
  batch(() => {
    for (const name of Object.keys(DEFAULTS) as Part[]) link[name].value = given.get(name) ?? DEFAULTS[name];
  });
}

readLink();
addEventListener("hashchange", readLink);
effect(() => {
  const parts = new URLSearchParams();
  for (const name of Object.keys(DEFAULTS) as Part[]) if (link[name].value !== DEFAULTS[name]) parts.set(name, link[name].value);
  const wanted = parts.size ? `#${parts}` : " ";
  if (wanted.trim() !== location.hash) history.replaceState(null, "", wanted === " " ? location.pathname + location.search : wanted);
});

export function part(name: Part): string {
  return link[name].value;
}

export function setPart(changes: Partial<Record<Part, string | number>>): void {
  batch(() => {
    for (const [name, value] of Object.entries(changes)) link[name as Part].value = String(value);
  });
}

/** The same for what a person thinks of as a step: the browser's Back undoes it. */
export function step(changes: Partial<Record<Part, string | number>>): void {
  if (Object.entries(changes).every(([name, value]) => part(name as Part) === String(value))) return;
  history.pushState(null, "", location.href);
  setPart(changes);
}

const CLOSED = {
  episode: "",
  replan: 0,
  layer: "mean",
  head: "mean",
  denoise: "mean",
  group: "",
  without: "",
  beside: "",
  step: "",
  of: "",
};

/** Shows an episode from its beginning. */
export function openEpisode(episode: string): void {
  step({ ...CLOSED, episode });
}

/** Shows the overview; behind an episode that was opened from a head's page, that one. */
export function closeEpisode(): void {
  const { episode, replan, group, without, beside: other, step: at } = CLOSED;
  step(part("episode") && part("of") ? { episode, replan, group, without, beside: other, step: at } : CLOSED);
}

export const runs = answered(() => readRuns());
export const runNumber = computed(() =>
  Math.max(0, Math.min(Math.trunc(Number(part("run"))) || 0, (runs.value.value?.runs.length ?? 1) - 1)),
);
export const run = computed(() => runs.value.value?.runs[runNumber.value] ?? null);
/** A page of one episode has no list. */
export const onlyEpisode = computed(() =>
  runs.value.value?.copy && runs.value.value.runs.length === 1 && run.value?.episodes.length === 1 ? run.value.episodes[0]!.name : "",
);
export const episodeName = computed(() => part("episode") || onlyEpisode.value);

export const runNumbers = signal<RunNumbers | null>(null);
const AGAIN_MS = 1000;
effect(() => {
  const wanted = runNumber.value;
  runNumbers.value = null;
  if (!run.value) return;
  let timer: ReturnType<typeof setTimeout> | undefined;
  const read = async (): Promise<void> => {
    const numbers = await readJsonNow<RunNumbers>(address.numbers(wanted)).catch(() => null);
    if (runNumber.peek() !== wanted) return;
    if (numbers) runNumbers.value = numbers;
    if (!numbers?.complete) timer = setTimeout(() => void read(), AGAIN_MS);
  };
  void read();
  return () => clearTimeout(timer);
});

/** The site that the link names; the first one where the run does not have it. */
export const site = computed(() => {
  const known = run.value?.sites.map(({ name }) => name) ?? [];
  return !run.value || known.includes(part("site")) ? part("site") : (known[0] ?? "");
});
/** What the link names and the run does not have, in a sentence. */
export const mended = computed(() =>
  run.value && part("site") && part("site") !== site.value ? `The run has no site '${part("site")}': '${site.value}' is shown.` : "",
);
export const axes = computed(() => run.value?.sites.find(({ name }) => name === site.value) ?? null);

const choice = (name: "layer" | "head" | "denoise", known: () => readonly number[]): ReadonlySignal<Choice> =>
  computed(() => {
    const given = part(name);
    return given !== "mean" && known().includes(Number(given)) ? Number(given) : "mean";
  });
export const layer = choice("layer", () => axes.value?.layers ?? []);
/** Those whose rows are there: a copy may have none of them. */
export const headsKnown = computed(() => (runs.value.value?.copy?.heads === false ? [] : (axes.value?.heads ?? [])));
export const head = choice("head", () => headsKnown.value);
export const denoise = choice("denoise", () => axes.value?.denoise_steps ?? []);
const position = (known: readonly number[] | undefined, chosen: Choice): Choice =>
  chosen === "mean" ? chosen : (known ?? []).indexOf(chosen);

/** What was clicked or typed: cells of cameras, words (positions), selectors. In the link as CAMERA:1.2.3;words:0.2;=selector */
export interface Picked {
  readonly cells: Readonly<Record<string, readonly number[]>>;
  readonly words: readonly number[];
  readonly selector: string;
}

export const picked = computed<Picked>(() => {
  const cells: Record<string, number[]> = {};
  let chosen: number[] = [];
  let selector = "";
  for (const text of part("group").split(";").filter(Boolean)) {
    const at = text.lastIndexOf(":");
    if (text.startsWith("=")) selector = text.slice(1);
    else if (text.startsWith("words:")) chosen = text.slice(6).split(".").map(Number);
    else
      cells[text.slice(0, at)] = text
        .slice(at + 1)
        .split(".")
        .map(Number);
  }
  return { cells, words: chosen, selector };
});

/** What another site has not, or others. */
export const OTHER_SITE = { layer: "mean", head: "mean", group: "", target: "", without: "" };

/** An episode with what was read of it, for the chosen site, layer, head and denoise step. */
export interface Scene {
  readonly name: ReadonlySignal<string>;
  readonly run: ReadonlySignal<number>;
  readonly about: ReadonlySignal<Answer<About>>;
  readonly layout: ReadonlySignal<SiteLayout | null>;
  readonly rows: ReadonlySignal<Answer<NumberArray>>;
  readonly groups: ReadonlySignal<Answer<Groups>>;
  readonly covered: ReadonlySignal<Answer<Covered>>;
  readonly moves: ReadonlySignal<Answer<Moves>>;
  /** Of every replan: masses of keys, (key). */
  readonly masses: ReadonlySignal<Float64Array[] | null>;
  /** The same of uniform attention, of every replan or once. */
  readonly even: ReadonlySignal<Float64Array[] | null>;
  /** The keys of the typed selector by replan, or why there are none. */
  readonly typed: ReadonlySignal<Answer<{ keys: [number, number][][] }>>;
  /** Whether all of it is there. */
  readonly ready: ReadonlySignal<boolean>;
}

const readAt = <T>(at: string | null): Promise<T> | null => (at === null ? null : readJson<T>(at));
const arrayAt = (at: string | null): Promise<NumberArray> | null => (at === null ? null : readArray(at));

function sceneOf(ofRun: ReadonlySignal<number>, name: ReadonlySignal<string>): Scene {
  const own = (path: string): string | null =>
    runs.value.value && name.value ? `${address.episode(ofRun.value, name.value)}/${path}` : null;
  const ofSite = (path: string): string | null => (about.value.value && site.value ? own(`${site.value}/${path}`) : null);
  const about = answered(() => readAt<About>(own("about.json")));
  const rows = answered<NumberArray>(() => arrayAt(ofSite(`${head.value === "mean" ? "rows" : "heads"}/${layer.value}.npy`)));
  const uniform = answered<NumberArray>(() => arrayAt(ofSite(`uniform/${layer.value}.npy`)));
  const steps = computed(() => position(axes.value?.denoise_steps, denoise.value));
  const groups = answered<Groups>(() => readAt(ofSite(`groups/${denoise.value}/${head.value}.json`)));
  const covered = answered<Covered>(() => readAt(ofSite("objects.json")));
  const moves = answered<Moves>(() => readAt(about.value.value?.sites[site.value]?.moves ? ofSite("moves.json") : null));
  const typed = answered<{ keys: [number, number][][] }>(() => {
    const { selector } = picked.value;
    return selector ? readAt(ofSite(`keys.json?${new URLSearchParams({ selector })}`)) : null;
  });
  return {
    name,
    run: ofRun,
    about,
    rows,
    groups,
    covered,
    moves,
    typed,
    ready: computed(() => ![about, rows, uniform, groups, covered, moves, typed].some(({ value }) => value.pending)),
    layout: computed(() => about.value.value?.sites[site.value] ?? null),
    masses: computed(() => rows.value.value && keyMasses(rows.value.value, steps.value, position(axes.value?.heads, head.value))),
    even: computed(() => uniform.value.value && keyMasses(uniform.value.value, steps.value, "mean")),
  };
}

/** The place of the chosen layer in the numbers of groups. */
export const layerPlace = (numbers: Groups): number => numbers.layers.indexOf(String(layer.value));

/** Masses of keys at a replan. */
export const massesOf = (scene: Scene, at: number): Float64Array | null => scene.masses.value?.[at] ?? null;
export const evenOf = (scene: Scene, at: number): Float64Array | null => scene.even.value?.[at] ?? scene.even.value?.[0] ?? null;

export const main = sceneOf(runNumber, episodeName);
export const { about, layout, rows, groups, covered, masses } = main;
export const massesAt = (at: number): Float64Array | null => massesOf(main, at);
export const uniformAt = (at: number): Float64Array | null => evenOf(main, at);
export const numReplans = computed(() => about.value.value?.starts.length ?? 0);

/** The episode beside it, in the link as RUN:EPISODE. */
const besideParts = computed(() => part("beside").split(":"));
const besideRun = computed(() => Number(besideParts.value[0]) || 0);
/** Whether there is such an episode, and it is another one. */
export const besideKnown = computed(() => {
  const known = runs.value.value?.runs[besideRun.value]?.episodes.some(({ name }) => name === besideParts.value[1]) ?? false;
  return known && !(besideRun.value === runNumber.value && besideParts.value[1] === episodeName.value);
});
export const beside = sceneOf(
  besideRun,
  computed(() => (besideKnown.value ? besideParts.value[1]! : "")),
);

const startsOf = (scene: Scene): readonly number[] => scene.about.value.value?.starts ?? [];
/** The place of the last start that is not after a step. */
const placeAt = (starts: readonly number[], step: number): number => Math.max(0, starts.filter((start) => start <= step).length - 1);

/** The steps at which a policy call begins; of two episodes those of both, so that the longer one is seen to its end. */
export const moments = computed(() => {
  const other = part("beside") ? startsOf(beside) : [];
  return other.length ? [...new Set([...startsOf(main), ...other])].sort((a, b) => a - b) : startsOf(main);
});
/** The step that is shown: of the main episode's call; where two are shown, the link names the step itself. */
export const moment = computed(() => {
  const [all, starts, given] = [moments.value, startsOf(main), part("step")];
  if (part("beside") && given !== "") return all[placeAt(all, Number(given) || 0)] ?? 0;
  return starts[Math.max(0, Math.min(Math.trunc(Number(part("replan"))) || 0, starts.length - 1))] ?? 0;
});
export const replan = computed(() => placeAt(startsOf(main), moment.value));
export const besideReplan = computed(() => placeAt(startsOf(beside), moment.value));
/** The last step of what is shown. */
export const end = computed(() => Math.max(about.value.value?.end ?? 0, part("beside") ? (beside.about.value.value?.end ?? 0) : 0));

/** Shows what was there at a step. */
export function goTo(step: number): void {
  const at = moments.peek()[placeAt(moments.peek(), step)] ?? 0;
  setPart({ replan: placeAt(startsOf(main), at), step: part("beside") ? at : "" });
}

/** Goes so many calls on. */
export function walk(by: number): void {
  const all = moments.peek();
  goTo(all[Math.max(0, Math.min(placeAt(all, moment.peek()) + by, all.length - 1))] ?? 0);
}

/** Puts each of two episodes in the other's place. */
export function swap(): void {
  const [ofRun, name] = besideParts.value;
  step({ run: ofRun!, episode: name!, beside: `${runNumber.value}:${episodeName.value}`, step: moment.value });
}

// What a link names and does not exist is put right in the link, too.
effect(() => {
  if (numReplans.value && part("replan") !== String(replan.value)) setPart({ replan: replan.value });
  if (
    part("step") !== "" &&
    (!part("beside") || (numReplans.value && !about.value.pending && !beside.about.value.pending && part("step") !== String(moment.value)))
  )
    setPart({ step: part("beside") ? moment.value : "" });
  if (axes.value)
    for (const [name, known] of [
      ["layer", layer],
      ["head", head],
      ["denoise", denoise],
    ] as const)
      if (part(name) !== String(known.value)) setPart({ [name]: known.value });
  if (runs.value.value && part("run") !== String(runNumber.value)) setPart({ run: runNumber.value });
});

/** What is on the screen: the episode, and the one beside it. */
export interface Side {
  readonly scene: Scene;
  readonly at: number;
}
export const sides = computed<readonly Side[]>(() => [
  { scene: main, at: replan.value },
  ...(beside.about.value.value ? [{ scene: beside, at: besideReplan.value }] : []),
]);

/** In an exchange an episode is known by what it was told, and where. */
export const nameInRun = (line: EpisodeLine): string =>
  line.scene == null ? `episode ${line.episode}` : `told '${line.told}', scene ${line.scene}`;

/** As "told.zarr, task 1, episode 3". */
export function fullNameOf({ scene }: Side): string {
  const line = scene.about.value.value;
  return line ? `${runs.value.value?.runs[scene.run.value]?.name}, task ${line.task}, ${nameInRun(line)}` : "";
}

/** The same where two episodes are shown; empty where there is one alone. */
export const nameOf = (side: Side): string => (sides.value.length > 1 ? fullNameOf(side) : "");

export function wordsOf({ scene, at }: Side): readonly Word[] {
  const prompts = scene.layout.value?.prompts ?? [];
  return prompts[scene.about.value.value?.prompt_index[at] ?? 0]?.words ?? [];
}
export const words = computed(() => wordsOf({ scene: main, at: replan.value }));

/** Events of an episode, with the leaving of solved episodes, which is computed from all of its run. */
export function eventsOf(scene: Scene): readonly EpisodeEvent[] {
  const episode = scene.about.value.value;
  if (!episode) return [];
  const leaves = scene.run.value === runNumber.value ? runNumbers.value?.leaves?.[episode.name] : undefined;
  if (leaves === undefined) return episode.events;
  const own: EpisodeEvent = {
    step: leaves,
    replan: placeAt(episode.starts, leaves),
    kind: "leaves",
    text: "leaves the solved episodes",
    thing: "",
  };
  return [...episode.events, own].sort((a, b) => a.step - b.step);
}

/** The link's text of what is picked. */
export function groupOf(changes: Partial<Picked>): string {
  const { cells, words: chosen, selector } = { ...picked.peek(), ...changes };
  const parts = Object.entries(cells)
    .filter(([, some]) => some.length)
    .map(([camera, some]) => `${camera}:${some.join(".")}`);
  if (chosen.length) parts.push(`words:${chosen.join(".")}`);
  if (selector) parts.push(`=${selector.replaceAll(";", " ")}`);
  return parts.join(";");
}

export function toggled(all: readonly number[], one: number): number[] {
  return all.includes(one) ? all.filter((other) => other !== one) : [...all, one].sort((a, b) => a - b);
}

export type Keys = Map<number, number>;

/** Whether an episode's map of a camera has the main one's cells. */
export function hasCells(scene: Scene, camera: string): boolean {
  const [own, how] = [layout.value?.cameras[camera], scene.layout.value?.cameras[camera]];
  return own?.rows === how?.rows && own?.columns === how?.columns;
}

/** The picked cells of a camera; in the episode beside it the same. */
export const cellsOf = (scene: Scene, camera: string): readonly number[] =>
  hasCells(scene, camera) ? (picked.value.cells[camera] ?? []) : [];

/** The keys of the picked cells and of a typed selector (`seen`), and of the words at the picked places (`read`). */
export function pickedKeys({ scene, at }: Side): { seen: Keys; read: Keys } {
  const seen: Keys = new Map();
  for (const [camera, how] of Object.entries(scene.layout.value?.cameras ?? {})) {
    const wanted = new Set(cellsOf(scene, camera));
    for (const [i, key] of how.keys.entries())
      if (wanted.has(how.cells[i]!)) seen.set(key, Math.min(1, (seen.get(key) ?? 0) + (how.shares?.[i] ?? 1)));
  }
  const ofReplans = scene.typed.value.value?.keys ?? [];
  for (const [key, weight] of ofReplans[at] ?? ofReplans[0] ?? []) seen.set(key, weight);
  const read: Keys = new Map();
  for (const place of picked.value.words) for (const key of wordsOf({ scene, at })[place]?.keys ?? []) read.set(key, 1);
  return { seen, read };
}

export const playing = signal(false);
const REPLANS_PER_SECOND = 10;
effect(() => {
  if (!playing.value) return;
  const timer = setInterval(() => {
    const before = moment.peek();
    walk(1);
    if (moment.peek() === before) playing.value = false;
  }, 1000 / REPLANS_PER_SECOND);
  return () => clearInterval(timer);
});
