/** What is on the page at one moment: everything that its parts draw, read for one state. */
import type { UniformKeys } from "../grouping/key_counts";
import { ofReplan } from "../grouping/resolve";
import { EpisodeTokens, patchKeys, picturedCameras } from "../grouping/tokens";
import type { Word } from "../grouping/words";
import { wordsOf } from "../grouping/words";
import type { PromptDocument } from "../store/documents";
import type { Coverage, Episode, Picture, Selection, SiteInfo } from "../store/episode";
import { StoreError } from "../store/errors";
import type { Store } from "../store/open";
import { uniformKeys } from "./baselines";
import { type EffectsShown, effectsOf } from "./effects_shown";
import { type EpisodeNumbers, episodeNumbers } from "./episode_numbers";
import type { OneOrMean, ViewState } from "./state";

export interface Shown {
  readonly state: ViewState;
  readonly store: Store;
  readonly episode: Episode;
  readonly site: SiteInfo;
  /** One that exists. */
  readonly replan: number;
  /** Positions on the axes that `row` is the mean over. */
  readonly selection: Selection;
  /** Probability of every key, (key). */
  readonly row: Float64Array;
  /** The mean rows of all replans, (replan, key); null where an episode is too large to read for one picture. */
  readonly allRows: Float64Array | null;
  /** What uniform attention gives every key, mean as `row`: at this replan, (key), and at all replans. */
  readonly uniform: Float64Array;
  readonly allUniform: UniformKeys;
  readonly tokens: EpisodeTokens;
  /** Keys that can hold information at this replan, (key). */
  readonly valid: Uint8Array;
  readonly prompt: PromptDocument | null;
  readonly words: readonly Word[];
  /** By camera that the policy sees at this site. */
  readonly frames: ReadonlyMap<string, Picture | null>;
  readonly coverage: ReadonlyMap<string, Coverage>;
  readonly numbers: EpisodeNumbers;
  /** null: the episode recorded none. */
  readonly effects: EffectsShown | null;
  /** What of the state does not exist here, in a sentence; empty: nothing. */
  readonly corrections: string;
  /** What to know of the lifts' baseline, in a sentence; empty: nothing. */
}

/** Numbers of layers, denoise steps and heads. */
export interface CellNumbers {
  readonly layers: readonly number[];
  readonly denoise: readonly number[];
  readonly heads: readonly number[];
}

/** Decoded bytes up to which the rows of a whole episode are read for one selection. */
const WHOLE_EPISODE_BYTES = 128_000_000;

function positions(
  wanted: OneOrMean,
  recorded: readonly number[],
  meanOf: readonly number[],
  what: string,
  missing: string[],
): number[] {
  // A block that two numbers name counts once in a mean.
  if (wanted === "mean") return recorded.flatMap((number, i) => (recorded.indexOf(number) === i && meanOf.includes(number) ? [i] : []));
  let nearest = 0;
  recorded.forEach((number, i) => {
    if (Math.abs(number - wanted) < Math.abs(recorded[nearest]! - wanted)) nearest = i;
  });
  if (recorded[nearest] !== wanted) missing.push(`${what} ${wanted} was not recorded: ${recorded[nearest]} is shown`);
  return [nearest];
}

/**
 * The positions that a state names at a site, and what of it does not exist there. `meanOf`: what means are over; some of
 * it is recorded.
 */
export function selectionAt(
  site: SiteInfo,
  state: ViewState,
  meanOf: CellNumbers = site,
): { selection: Selection; missing: string[] } {
  const missing: string[] = [];
  let query = state.query;
  if (query !== "mean" && query >= site.numQueries) {
    missing.push(`query ${query} was not recorded: the mean is shown`);
    query = "mean";
  }
  const selection = {
    layers: positions(state.layer, site.layers, meanOf.layers, "layer", missing),
    denoise: positions(state.denoise, site.denoise, meanOf.denoise, "denoise step", missing),
    heads: positions(state.head, site.heads, meanOf.heads, "head", missing),
    query: site.numQueries === 1 ? ("mean" as const) : query,
  };
  return { selection, missing };
}

/** The site that a state names in an episode. */
export function siteOf(episode: Episode, state: ViewState): SiteInfo {
  return episode.sites.find((site) => site.layout.name === state.site) ?? episode.firstSite;
}

const tokensOfEpisodes = new WeakMap<Episode, Map<string, Promise<EpisodeTokens>>>();

async function readTokens(episode: Episode, site: SiteInfo): Promise<EpisodeTokens> {
  const { layout } = site;
  const coverage = new Map<string, Coverage>();
  const cameras = picturedCameras(layout);
  const [keyRole] = await Promise.all([
    episode.keyRole(layout.name),
    ...cameras.map(async (camera) => {
      const found = await episode.coverage(camera);
      if (found && found.patches !== patchKeys(layout, camera).length) {
        throw new StoreError(`The array objects/${camera} has ${found.patches} patches; expected those of the camera's grids.`);
      }
      if (found) coverage.set(camera, found);
    }),
  ]);
  const { document } = episode;
  const hasText = layout.spans.some((span) => span.kind === "text");
  return new EpisodeTokens({
    layout,
    keyRole,
    numReplans: episode.numReplans,
    prompts: hasText ? document.prompts.map((prompt) => episode.promptOf(layout, prompt)) : [],
    promptIndex: document.prompt_index,
    objects: document.objects,
    coverage: new Map([...coverage].sort(([a], [b]) => cameras.indexOf(a) - cameras.indexOf(b))),
  });
}

/** What selectors need of an episode's keys at a site; read once. */
export function tokensOf(episode: Episode, site: SiteInfo): Promise<EpisodeTokens> {
  let of = tokensOfEpisodes.get(episode);
  if (!of) tokensOfEpisodes.set(episode, (of = new Map()));
  let found = of.get(site.layout.name);
  if (!found) {
    found = readTokens(episode, site);
    of.set(site.layout.name, found);
    const kept = of;
    found.catch(() => kept.delete(site.layout.name));
  }
  return found;
}

/** Cameras of a site whose patches are not all masked, in the order of the keys. */
export function seenCameras(tokens: EpisodeTokens): string[] {
  const { codes, keys, replans } = tokens.keyRole;
  return picturedCameras(tokens.layout).filter((camera) => {
    const own = patchKeys(tokens.layout, camera);
    for (let replan = 0; replan < replans; replan++) if (own.some((key) => codes[replan * keys + key] === 1)) return true;
    return false;
  });
}

/** Whether all replans of a selection are read at once: chunks mostly hold many of them. */
async function readsWhole(episode: Episode, site: SiteInfo, selection: Selection): Promise<boolean> {
  const cells = selection.layers.length * selection.denoise.length;
  const bytes = 4 * episode.numReplans * cells * site.heads.length * site.numQueries * site.keys;
  return bytes <= WHOLE_EPISODE_BYTES || episode.numReplans <= 3 * (await episode.replansPerChunk(site.layout.name));
}

async function picturesOf(episode: Episode, site: SiteInfo, replan: number): Promise<Map<string, Picture | null>> {
  const cameras = picturedCameras(site.layout);
  return new Map(await Promise.all(cameras.map(async (camera) => [camera, await episode.frame(camera, replan)] as const)));
}

/** Read all that a state shows of an episode. `meanOf`: what means are over, where that is not all that was recorded. */
export async function loadShown(store: Store, episode: Episode, state: ViewState, meanOf?: CellNumbers): Promise<Shown> {
  const missing: string[] = [];
  if (state.site !== null && !episode.sites.some((site) => site.layout.name === state.site)) {
    missing.push(`the episode has no site ${state.site}: ${episode.firstSite.layout.name} is shown`);
  }
  const site = siteOf(episode, state);
  const name = site.layout.name;
  const { selection, missing: axes } = selectionAt(site, state, meanOf);
  missing.push(...axes);
  const replan = Math.min(state.replan, episode.numReplans - 1);
  if (replan !== state.replan) missing.push(`the episode has no replan ${state.replan}: its last is ${replan}`);
  // Everything is asked for at once: a server elsewhere takes its time for each answer.
  const reading = tokensOf(episode, site);
  const pictures = picturesOf(episode, site, replan);
  const rows = readsWhole(episode, site, selection).then(async (whole) => {
    if (!whole) return { all: null, own: await episode.meanRow(name, selection, replan) };
    const all = (await episode.meanRows(name, selection)).values;
    return { all, own: all.subarray(replan * site.keys, (replan + 1) * site.keys) };
  });
  const place = reading.then((known) => ({ episode, site, tokens: known, selection }));
  const [tokens, { all, own }, taken, allUniform, numbers, effects] = await Promise.all([
    reading,
    rows,
    pictures,
    place.then(uniformKeys),
    place.then(episodeNumbers),
    effectsOf(store, episode),
  ]);
  const frames = new Map(seenCameras(tokens).map((camera) => [camera, taken.get(camera) ?? null]));
  const first = tokens.keyRole.replans === 1 ? 0 : replan * site.keys;
  const hasText = tokens.prompts.length > 0;
  const prompt = hasText ? (tokens.prompts[tokens.promptIndex.length ? tokens.promptIndex[replan]! : 0] ?? null) : null;
  return {
    state,
    store,
    episode,
    site,
    replan,
    selection,
    row: own,
    allRows: all,
    uniform: ofReplan(allUniform, replan),
    allUniform,
    tokens,
    valid: tokens.valid.subarray(first, first + site.keys),
    prompt,
    words: prompt ? wordsOf(prompt) : [],
    frames,
    coverage: tokens.coverage,
    numbers,
    effects,
    corrections: missing.length ? `${missing.join("; ")}.` : "",
  };
}
