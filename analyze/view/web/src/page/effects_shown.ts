/** The effects that an episode recorded, in the units that Python computes of the whole store. */
import { episodeEffects, type EpisodeEffects, executedSteps } from "../measures/effects";
import type { Episode } from "../store/episode";
import { sentenceOf, StoreError } from "../store/errors";
import type { Store } from "../store/open";

export interface EffectsShown {
  /** null: there are no numbers, and `note` says why. */
  readonly known: EpisodeEffects | null;
  readonly note: string;
  /** Whether `known` will be there when the store's units are read. */
  readonly waiting: boolean;
}

const WAITING: EffectsShown = {
  known: null,
  note: "Effects are shown as soon as their unit is known, the spread of all actions of the store.",
  waiting: true,
};

const without = (why: string): EffectsShown => ({ known: null, note: `Effects are not shown: ${why}`, waiting: false });
const kept = new WeakMap<Episode, Promise<EffectsShown>>();

async function read(store: Store, episode: Episode): Promise<EffectsShown> {
  const { effects } = episode.document;
  const units = store.effectUnits!;
  if ("failed" in units) return without(units.failed);
  try {
    const change = await episode.effectChanges();
    if (!effects || !change) return without("none was measured in this episode.");
    const [, horizon, size] = change.shape as [number, number, number];
    if (units.spread.length !== size) throw new StoreError(`the store has units of ${units.spread.length} dimensions, its actions ${size}.`);
    const steps = episode.document.env_step;
    if (!steps.length) throw new StoreError("the episode does not say when its replans were.");
    return { known: episodeEffects(change, effects, units.spread, executedSteps(store.root, episode.document, horizon)), note: "", waiting: false };
  } catch (failure) {
    return without(sentenceOf(failure));
  }
}

/** The effects of an episode; null where none were recorded. */
export async function effectsOf(store: Store, episode: Episode): Promise<EffectsShown | null> {
  if (!episode.document.effects) return null;
  if (!store.effectUnits) return WAITING;
  let found = kept.get(episode);
  if (!found) kept.set(episode, (found = read(store, episode)));
  return found;
}

/** Act again when effects can be shown that could not be when this was loaded. */
export function whenEffectsAreKnown({ store, effects }: { store: Store; effects: EffectsShown | null }, act: () => void): void {
  if (effects?.waiting) void store.readEffectUnits().then(act);
}
