/** What is shown. One immutable value, which the link of the page names. */
import { COLOUR_MAPS, type ColourMap } from "./colour_maps";

export const MEASURES = ["lift", "raw", "rank"] as const;
export type Measure = (typeof MEASURES)[number];
/** What words are shaded by: their effect, mean of the episode or at the replan shown, or attention. */
export const WORD_SHADES = ["effect", "replan", "attention"] as const;
export type WordShade = (typeof WORD_SHADES)[number];
export type OneOrMean = number | "mean";

/** `layer`, `denoise` and `head` are recorded numbers, `query` a position. */
export interface ViewState {
  readonly store: number;
  readonly episode: string | null;
  /** null: the episode's first site with cameras. */
  readonly site: string | null;
  readonly replan: number;
  readonly layer: OneOrMean;
  readonly denoise: OneOrMean;
  readonly head: OneOrMean;
  readonly query: OneOrMean;
  readonly measure: Measure;
  /** Where no effects were recorded, words are shaded by attention. */
  readonly words: WordShade;
  readonly colours: ColourMap;
  /** Of the colours at the top of the scale, 0 to 1. */
  readonly opacity: number;
  readonly smooth: boolean;
  /** The group whose lift the grid of layers and heads shows. */
  readonly gridGroup: string;
  /** The text of the groups panel; empty: none. */
  readonly grouping: string;
  readonly otherStore: number | null;
  readonly otherEpisode: string | null;
  /** Not part of the link. */
  readonly playing: boolean;
}

export const FIRST_STATE: ViewState = {
  store: 0,
  episode: null,
  site: null,
  replan: 0,
  layer: "mean",
  denoise: "mean",
  head: "mean",
  query: "mean",
  measure: "lift",
  words: "effect",
  colours: "inferno",
  opacity: 0.8,
  smooth: false,
  gridGroup: "visual",
  grouping: "",
  otherStore: null,
  otherEpisode: null,
  playing: false,
};

const MOST_TEXT = 20_000;

const whole = (text: string | null): number | null => (text !== null && /^[0-9]{1,9}$/.test(text) ? Number(text) : null);

function among<T extends string>(text: string | null, choices: readonly T[], otherwise: T): T {
  return choices.includes(text as T) ? (text as T) : otherwise;
}

/** The state that a link's query names; what it does not name, or names wrongly, is as at first. */
export function stateOfLink(query: string): ViewState {
  const link = new URLSearchParams(query);
  const oneOrMean = (name: string): OneOrMean => whole(link.get(name)) ?? "mean";
  const opacity = Number(link.get("opacity") ?? NaN);
  const other = /^([0-9]{1,6}):(.+)$/.exec(link.get("other") ?? "");
  return {
    ...FIRST_STATE,
    store: whole(link.get("store")) ?? 0,
    episode: link.get("episode"),
    site: link.get("site"),
    replan: whole(link.get("replan")) ?? 0,
    layer: oneOrMean("layer"),
    denoise: oneOrMean("denoise"),
    head: oneOrMean("head"),
    query: oneOrMean("query"),
    measure: among(link.get("measure"), MEASURES, FIRST_STATE.measure),
    words: among(link.get("words"), WORD_SHADES, FIRST_STATE.words),
    colours: among(link.get("colours"), COLOUR_MAPS, FIRST_STATE.colours),
    opacity: opacity >= 0 && opacity <= 1 ? opacity : FIRST_STATE.opacity,
    smooth: link.get("smooth") === "1",
    gridGroup: link.get("grid") ?? FIRST_STATE.gridGroup,
    grouping: (link.get("grouping") ?? "").slice(0, MOST_TEXT),
    otherStore: other ? Number(other[1]) : null,
    otherEpisode: other ? other[2]! : null,
  };
}

/** The query of the link that names a state; what is as at first is left out. */
export function linkOfState(state: ViewState): string {
  const link = new URLSearchParams();
  const put = (name: string, value: string | number, first: string | number | null): void => {
    if (value !== first) link.set(name, String(value));
  };
  put("store", state.store, FIRST_STATE.store);
  if (state.episode !== null) link.set("episode", state.episode);
  if (state.site !== null) link.set("site", state.site);
  put("replan", state.replan, 0);
  for (const axis of ["layer", "denoise", "head", "query"] as const) put(axis, state[axis], "mean");
  put("measure", state.measure, FIRST_STATE.measure);
  put("words", state.words, FIRST_STATE.words);
  put("colours", state.colours, FIRST_STATE.colours);
  put("opacity", state.opacity, FIRST_STATE.opacity);
  if (state.smooth) link.set("smooth", "1");
  put("grid", state.gridGroup, FIRST_STATE.gridGroup);
  put("grouping", state.grouping, "");
  if (state.otherStore !== null && state.otherEpisode !== null) link.set("other", `${state.otherStore}:${state.otherEpisode}`);
  const text = link.toString();
  return text ? `?${text}` : "";
}

export type Listener = (now: ViewState, before: ViewState) => void;

/** Fields of which each change is a step that "back" undoes; others replace the step. */
const STEPS: readonly (keyof ViewState)[] = ["store", "episode", "site", "layer", "head", "otherEpisode"];

/** Holds the state. The page makes one. */
export class View {
  readonly #listeners = new Set<Listener>();

  /** `remember` writes the link; "push" adds a step to the browser's history. */
  constructor(
    private state: ViewState,
    private readonly remember: (state: ViewState, how: "push" | "replace") => void,
  ) {}

  get(): ViewState {
    return this.state;
  }

  /** Change some fields; listeners are told when any differs. */
  update(partial: Partial<ViewState>, how?: "push" | "replace"): void {
    const before = this.state;
    const now = { ...before, ...partial };
    const changed = (Object.keys(partial) as (keyof ViewState)[]).filter((field) => now[field] !== before[field]);
    if (!changed.length) return;
    this.state = now;
    if (changed.some((field) => field !== "playing")) {
      this.remember(now, how ?? (changed.some((field) => STEPS.includes(field)) ? "push" : "replace"));
    }
    for (const listen of [...this.#listeners]) listen(now, before);
  }

  /** Take a state that the browser's history names, without writing it again. */
  restore(state: ViewState): void {
    const before = this.state;
    this.state = state;
    for (const listen of [...this.#listeners]) listen(state, before);
  }

  /** Be told of changes; returns a function that ends it. */
  subscribe(listen: Listener): () => void {
    this.#listeners.add(listen);
    return () => this.#listeners.delete(listen);
  }
}
