/** What uniform attention gives: stored from version 2 on, made from roles before. analyze/measures/baselines.py. */
import { storedPlaces, type UniformKeys } from "../grouping/key_counts";
import type { EpisodeTokens } from "../grouping/tokens";
import { uniformMasses } from "../measures/masses";
import type { RootDocument } from "../store/documents";
import type { Episode, Selection, SiteInfo } from "../store/episode";

/** What `checkpoint_format` says of policies of torch that vla-capture does not build. */
const CALLERS_MODULES = "torch modules of the caller";

/** What an episode's numbers are of: a site, and positions on its axes. */
export interface Place {
  readonly episode: Episode;
  readonly site: SiteInfo;
  readonly tokens: EpisodeTokens;
  readonly selection: Selection;
}

/** What uniform attention gives every key, mean over the selection: (key), of each replan or once. */
export async function uniformKeys({ episode, site, tokens, selection }: Place): Promise<UniformKeys> {
  return (await episode.uniformKeys(site.layout.name, selection)) ?? tokens.uniformOfVersion1;
}

/** What uniform attention gives groups and, as the last, all valid keys: (group + 1), of each replan or once. */
export type UniformMasses = readonly Float64Array[];

const kept = new WeakMap<readonly Float32Array[], Map<string, Promise<UniformMasses>>>();

/** The same of groups with `weights` (group + 1, key), see `withValid`. Kept with the weights: every replan asks again. */
export function uniformOfGroups(place: Place, weights: readonly Float32Array[]): Promise<UniformMasses> {
  const { site, selection } = place;
  let known = kept.get(weights);
  if (!known) kept.set(weights, (known = new Map()));
  // Layers and heads that are alike are read and added up once.
  const key = site.uniformShape ? JSON.stringify(storedPlaces(site.uniformShape, selection)) : "";
  let found = known.get(key);
  if (!found) {
    found = uniformKeys(place).then((uniform) => uniformMasses(uniform, weights, site.keys));
    known.set(key, found);
    const own = known;
    found.catch(() => own.delete(key));
  }
  return found;
}

/** Of each of the selection's layers. */
export function uniformOfLayers(place: Place, weights: readonly Float32Array[]): Promise<UniformMasses[]> {
  const { selection } = place;
  return Promise.all(
    selection.layers.map((layer) => uniformOfGroups({ ...place, selection: { ...selection, layers: [layer] } }, weights)),
  );
}

/** The sentence about a store of version 1 whose baseline may be that of too many keys; empty: it is none. `baseline_notes`. */
export function baselineNote({ store_version, policy }: RootDocument, name: string): string {
  if (store_version > 1 || policy.checkpoint_format !== CALLERS_MODULES) return "";
  return (
    `Baselines of ${name} (version 1) are of the keys that any query of any layer sees; where queries or layers see ` +
    "different keys, lifts are off. A new recording has baselines by query and layer."
  );
}
