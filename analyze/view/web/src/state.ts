/** What is shown, as signals: the link (run, episode, replan, layer ...), and what was read for it. */
import { batch, computed, effect, type ReadonlySignal, type Signal, signal } from "@preact/signals";

import {
  type About, address, type Covered, type Effect, type Effects, type EpisodeEvent, type Groups, type NumberArray, readArray,
  readJson, readJsonNow, readRuns, type RunNumbers, type SiteLayout, type Word,
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
    asked.then((value) => settle(value, null), (error: unknown) => settle(null, error instanceof Error ? error.message : String(error)));
  });
  return answer;
}

/** The parts of the link, as texts; what is not in it has its default. */
const DEFAULTS = {
  run: "0", episode: "", replan: "0", site: "", layer: "mean", head: "mean", denoise: "mean", words: "", beside: "", group: "",
  find: "", task: "", show: "all", curve: "ratio",
} as const;
export type Part = keyof typeof DEFAULTS;

const link = Object.fromEntries(Object.entries(DEFAULTS).map(([name, text]) => [name, signal<string>(text)])) as Record<Part, Signal<string>>;

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

/** Shows an episode from its beginning, or the overview (an empty name); the browser's Back returns from it. */
export function openEpisode(episode: string, run = Number(part("run"))): void {
  history.pushState(null, "", location.href);
  setPart({ run, episode, replan: 0, group: "", head: "mean", layer: "mean" });
}

export const runs = answered(() => readRuns());
export const runNumber = computed(() => Math.max(0, Math.min(Math.trunc(Number(part("run"))) || 0, (runs.value.value?.runs.length ?? 1) - 1)));
export const run = computed(() => runs.value.value?.runs[runNumber.value] ?? null);
/** A page of one episode has no list. */
export const onlyEpisode = computed(() => (runs.value.value?.copy && runs.value.value.runs.length === 1 && run.value?.episodes.length === 1 ? run.value.episodes[0]!.name : ""));
export const episodeName = computed(() => part("episode") || onlyEpisode.value);

export const runNumbers = signal<RunNumbers | null>(null);
const AGAIN_MS = 1000;
effect(() => {
  const wanted = runNumber.value;
  runNumbers.value = null;
  if (!run.value) return;
  let timer = 0;
  const read = async (): Promise<void> => {
    const numbers = await readJsonNow<RunNumbers>(address.numbers(wanted)).catch(() => null);
    if (runNumber.peek() !== wanted) return;
    if (numbers) runNumbers.value = numbers;
    if (numbers && !numbers.complete) timer = setTimeout(() => void read(), AGAIN_MS);
  };
  void read();
  return () => clearTimeout(timer);
});

export const site = computed(() => part("site") || run.value?.sites[0]?.name || "");
export const axes = computed(() => run.value?.sites.find(({ name }) => name === site.value) ?? null);

const choice = (name: "layer" | "head" | "denoise", known: () => readonly number[]): ReadonlySignal<Choice> =>
  computed(() => {
    const given = part(name);
    return given !== "mean" && known().includes(Number(given)) ? Number(given) : "mean";
  });
export const layer = choice("layer", () => axes.value?.layers ?? []);
export const head = choice("head", () => axes.value?.heads ?? []);
export const denoise = choice("denoise", () => axes.value?.denoise_steps ?? []);
const position = (known: readonly number[] | undefined, chosen: Choice): Choice => (chosen === "mean" ? chosen : (known ?? []).indexOf(chosen));

/** An episode with what was read of it, for the chosen site, layer, head and denoise step. */
export interface Scene {
  readonly name: ReadonlySignal<string>;
  readonly run: ReadonlySignal<number>;
  readonly about: ReadonlySignal<Answer<About>>;
  readonly layout: ReadonlySignal<SiteLayout | null>;
  readonly rows: ReadonlySignal<Answer<NumberArray>>;
  readonly groups: ReadonlySignal<Answer<Groups>>;
  readonly covered: ReadonlySignal<Answer<Covered>>;
  /** Of every replan: masses of keys, (key). */
  readonly masses: ReadonlySignal<Float64Array[] | null>;
  /** The same of uniform attention, of every replan or once. */
  readonly even: ReadonlySignal<Float64Array[] | null>;
  /** Whether all of it is there. */
  readonly ready: ReadonlySignal<boolean>;
}

const readAt = <T>(at: string | null): Promise<T> | null => (at === null ? null : readJson<T>(at));
const arrayAt = (at: string | null): Promise<NumberArray> | null => (at === null ? null : readArray(at));

function sceneOf(ofRun: ReadonlySignal<number>, name: ReadonlySignal<string>): Scene {
  const own = (path: string): string | null => (runs.value.value && name.value ? `${address.episode(ofRun.value, name.value)}/${path}` : null);
  const ofSite = (path: string): string | null => (about.value.value && site.value ? own(`${site.value}/${path}`) : null);
  const about = answered(() => readAt<About>(own("about.json")));
  const rows = answered<NumberArray>(() => arrayAt(ofSite(`${head.value === "mean" ? "rows" : "heads"}/${layer.value}.npy`)));
  const uniform = answered<NumberArray>(() => arrayAt(ofSite(`uniform/${layer.value}.npy`)));
  const steps = computed(() => position(axes.value?.denoise_steps, denoise.value));
  const groups = answered<Groups>(() => {
    const parts = Object.entries({ denoise: denoise.value, head: head.value }).filter(([, one]) => one !== "mean");
    return readAt(ofSite(`groups/${parts.map(([of, one]) => `${of}-${one}`).join(".") || "all"}.json`));
  });
  const covered = answered<Covered>(() => readAt(ofSite("objects.json")));
  return {
    name,
    run: ofRun,
    about,
    rows,
    groups,
    covered,
    ready: computed(() => ![about, rows, uniform, groups, covered].some(({ value }) => value.pending)),
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
export const replan = computed(() => Math.max(0, Math.min(Math.trunc(Number(part("replan"))) || 0, numReplans.value - 1)));

// What a link names and does not exist is put right in the link, too.
effect(() => {
  if (numReplans.value && part("replan") !== String(replan.value)) setPart({ replan: replan.value });
  if (axes.value) for (const [name, known] of [["layer", layer], ["head", head], ["denoise", denoise]] as const) if (part(name) !== String(known.value)) setPart({ [name]: known.value });
  if (runs.value.value && part("run") !== String(runNumber.value)) setPart({ run: runNumber.value });
});

/** Shows the overview. */
export function closeEpisode(): void {
  setPart({ episode: "", replan: 0, layer: "mean", head: "mean", denoise: "mean", group: "", beside: "" });
}

/** The episode beside it, in the link as RUN:EPISODE; shown at the call whose step is nearest. */
const besideParts = computed(() => part("beside").split(":"));
export const beside = sceneOf(computed(() => Number(besideParts.value[0]) || 0), computed(() => besideParts.value[1] ?? ""));
export const besideReplan = computed(() => {
  const step = about.value.value?.starts[replan.value] ?? 0;
  const starts = beside.about.value.value?.starts ?? [];
  return starts.reduce((best, start, i) => (Math.abs(start - step) < Math.abs(starts[best]! - step) ? i : best), 0);
});

export const effects = answered<Effects | null>(() => (about.value.value?.effects ? readJson<Effects | null>(`${address.episode(runNumber.value, episodeName.value)}/effects.json`) : null));

export const words = computed<readonly Word[]>(() => {
  const prompts = layout.value?.prompts ?? [];
  return prompts[about.value.value?.prompt_index[replan.value] ?? 0]?.words ?? [];
});

/** Events with the leaving of solved episodes, which is computed from all of them. */
export const events = computed<readonly EpisodeEvent[]>(() => {
  const episode = about.value.value;
  if (!episode) return [];
  const leaves = runNumbers.value?.leaves?.[episode.name];
  if (leaves === undefined) return episode.events;
  const before = episode.starts.filter((start) => start <= leaves).length - 1;
  const own: EpisodeEvent = { step: leaves, replan: Math.max(0, before), kind: "leaves", text: "leaves the solved episodes", thing: "" };
  return [...episode.events, own].sort((a, b) => a.step - b.step);
});

/** The effect of a word: when nobody reads it, or where that was not tried, when the action queries do not. */
export function effectOf(item: string): Effect | null {
  const own = effects.value.value?.items.filter((one) => one.kind === "without" && one.item === item) ?? [];
  return own.find(({ reader }) => reader === "total") ?? own.find(({ reader }) => reader === "direct") ?? null;
}

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
    else cells[text.slice(0, at)] = text.slice(at + 1).split(".").map(Number);
  }
  return { cells, words: chosen, selector };
});

export function pick(changes: Partial<Picked>): void {
  const { cells, words: chosen, selector } = { ...picked.peek(), ...changes };
  const parts = Object.entries(cells).filter(([, some]) => some.length).map(([camera, some]) => `${camera}:${some.join(".")}`);
  if (chosen.length) parts.push(`words:${chosen.join(".")}`);
  if (selector) parts.push(`=${selector.replaceAll(";", " ")}`);
  setPart({ group: parts.join(";") });
}

export function toggled(all: readonly number[], one: number): number[] {
  return all.includes(one) ? all.filter((other) => other !== one) : [...all, one].sort((a, b) => a - b);
}

/** The keys of a typed selector by replan, or why there are none. */
export const typed = answered<{ keys: [number, number][][] }>(() => {
  const { selector } = picked.value;
  return selector && about.value.value ? readJson(`${address.episode(runNumber.value, episodeName.value)}/${site.value}/keys.json?${new URLSearchParams({ selector })}`) : null;
});

export type Keys = Map<number, number>;

/** The keys of the picked cells and of a typed selector (`seen`), and of the picked words (`read`), at a replan. */
export function pickedKeys(at: number): { seen: Keys; read: Keys } {
  const seen: Keys = new Map();
  for (const [camera, cells] of Object.entries(picked.value.cells)) {
    const how = layout.value?.cameras[camera];
    const wanted = new Set(cells);
    how?.keys.forEach((key, i) => wanted.has(how.cells[i]!) && seen.set(key, Math.min(1, (seen.get(key) ?? 0) + (how.shares?.[i] ?? 1))));
  }
  const ofReplans = typed.value.value?.keys ?? [];
  for (const [key, weight] of ofReplans[at] ?? ofReplans[0] ?? []) seen.set(key, weight);
  const read: Keys = new Map();
  for (const place of picked.value.words) for (const key of words.value[place]?.keys ?? []) read.set(key, 1);
  return { seen, read };
}

export const playing = signal(false);
const REPLANS_PER_SECOND = 10;
effect(() => {
  if (!playing.value) return;
  const timer = setInterval(() => {
    const next = replan.peek() + 1;
    if (next >= numReplans.peek()) playing.value = false;
    else setPart({ replan: next });
  }, 1000 / REPLANS_PER_SECOND);
  return () => clearInterval(timer);
});
