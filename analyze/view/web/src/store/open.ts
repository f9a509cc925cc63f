/** Stores beside the page: what `stores.json` lists, their roots, and their episodes. */
import { type EpisodeDocument, type RootDocument, parseEpisode, parseRoot } from "./documents";
import { Episode } from "./episode";
import { sentenceOf, StoreError, visible } from "./errors";
import { type Fields, flag, list, name, object, parseDocument, text } from "./json_fields";
import { AXIS, DOCUMENT_BYTES, ROOT_BYTES } from "./limits";
import type { Place } from "./messages";
import { type Port, ReaderPool } from "./reader_pool";

export interface StoreEntry {
  name: string;
  /** Address of the store's root, relative to the page; ends in a slash. */
  root: string;
  episodes: { name: string }[];
  /** Address of what Python measured of every episode, relative to the page. */
  summary: string;
  /** Where the store is, as it was given to `vla-analyze view`; unknown on a site. */
  path?: string;
}

export interface EpisodeSummary {
  name: string;
  task: string;
  episode: number;
  instruction: string;
  success: boolean | null;
  replans: number;
  ratio: number | null;
  lift: number | null;
}

export interface Summary {
  complete: boolean;
  failed: string | null;
  ratio: string;
  grouping: string;
  site: string;
  /** null: not computed yet, or nothing was recorded. */
  effectUnits: EffectUnits | null;
  episodes: EpisodeSummary[];
}

/** The spread of the store's actions by dimension, null for those that are not compared; or why there is none. */
export type EffectUnits = { spread: readonly (number | null)[] } | { failed: string };

const MOST_STORES = 1000;
const MOST_EPISODES = 1_000_000;
const EPISODE_NAME = /^task[0-9]{3,12}_episode[0-9]{3,12}$/;
const EPISODES_KEPT = 8;
/** Milliseconds after which a summary that is not complete is asked for again. */
export const SUMMARY_AGAIN = 1500;

async function documentAt(address: string): Promise<Fields> {
  let response: Response;
  try {
    response = await fetch(address);
  } catch {
    throw new StoreError(`The web server does not answer, so ${address} cannot be read. Is vla-analyze view still running?`);
  }
  if (!response.ok) throw new StoreError(`The web server answers ${response.status} to ${address}.`);
  return object(parseDocument(new Uint8Array(await response.arrayBuffer()), address), address);
}

function checkedName(value: unknown): string {
  const given = name(value, "the name of an episode");
  if (!EPISODE_NAME.test(given)) throw new StoreError(`"${given}" is no name of an episode.`);
  return given;
}

/** What `stores.json` beside the page lists. */
export async function openStores(): Promise<StoreEntry[]> {
  const document = await documentAt("stores.json");
  return list(document.stores, "stores", MOST_STORES).map((each, i) => {
    const entry = object(each, `stores[${i}]`);
    return {
      name: text(entry.name, `stores[${i}].name`),
      root: text(entry.root, `stores[${i}].root`),
      ...(entry.path === undefined ? {} : { path: text(entry.path, `stores[${i}].path`) }),
      summary: text(entry.summary, `stores[${i}].summary`),
      episodes: list(entry.episodes, `stores[${i}].episodes`, MOST_EPISODES).map((one) => ({
        name: checkedName(object(one, "an episode").name),
      })),
    };
  });
}

const numberOrNull = (value: unknown): number | null => (typeof value === "number" ? value : null);

function effectUnits(value: unknown): EffectUnits | null {
  if (value == null) return null;
  const fields = object(value, "effect_units");
  if (fields.failed != null) return { failed: text(fields.failed, "effect_units.failed") };
  const spread = list(fields.spread, "effect_units.spread", AXIS).map((one) => numberOrNull(one));
  if (spread.some((one) => one !== null && !(one > 0))) throw new StoreError("The spread of the actions is not above 0.");
  return { spread };
}

/** What Python measured of a store's episodes, as far as it is done. */
export async function summaryOf(entry: StoreEntry): Promise<Summary> {
  const document = await documentAt(entry.summary);
  return {
    complete: flag(document.complete, "complete"),
    failed: document.failed == null ? null : text(document.failed, "failed"),
    ratio: text(document.ratio ?? "", "ratio"),
    grouping: text(document.grouping ?? "", "grouping"),
    site: text(document.site ?? "", "site"),
    effectUnits: effectUnits(document.effect_units),
    episodes: list(document.episodes, "episodes", MOST_EPISODES).map((each) => {
      const one = object(each, "an episode");
      return {
        name: checkedName(one.name),
        task: text(String(one.task ?? ""), "task"),
        episode: Number(one.episode ?? 0),
        instruction: text(one.instruction ?? "", "instruction"),
        success: typeof one.success === "boolean" ? one.success : null,
        replans: Number(one.replans ?? 0),
        ratio: numberOrNull(one.ratio),
        lift: numberOrNull(one.lift),
      };
    }),
  };
}

/** One store; episodes are opened when they are asked for. */
export class Store {
  readonly #episodes = new Map<string, Promise<Episode>>();
  #readingUnits: Promise<EffectUnits> | undefined;
  /** The units of recorded effects; null until `readEffectUnits` has them. */
  effectUnits: EffectUnits | null = null;

  constructor(
    readonly entry: StoreEntry,
    readonly root: RootDocument,
    private readonly url: string,
    private readonly pool: ReaderPool,
  ) {}

  get episodeNames(): string[] {
    return this.entry.episodes.map((episode) => episode.name);
  }

  /** Ask for the units of recorded effects until Python has computed them. */
  readEffectUnits(): Promise<EffectUnits> {
    return (this.#readingUnits ??= this.#unitsOfSummary().then((units) => (this.effectUnits = units)));
  }

  async #unitsOfSummary(): Promise<EffectUnits> {
    try {
      for (;;) {
        const { effectUnits, complete } = await summaryOf(this.entry);
        if (effectUnits) return effectUnits;
        if (complete) return { failed: `${this.entry.summary} has no units of effects: make the site or start the server anew.` };
        await new Promise((resolve) => setTimeout(resolve, SUMMARY_AGAIN));
      }
    } catch (failure) {
      return { failed: sentenceOf(failure) };
    }
  }

  async #open(episode: string): Promise<Episode> {
    if (!this.entry.episodes.some((each) => each.name === episode)) {
      throw new StoreError(`The store ${this.entry.name} has no episode ${visible(episode)}; choose one from the list.`);
    }
    const place: Place = { url: `${this.url}episodes/${encodeURIComponent(episode)}/` };
    const document: EpisodeDocument = parseEpisode(await this.pool.document(place, "zarr.json", DOCUMENT_BYTES), episode);
    return Episode.open(this.root, episode, document, place, this.pool);
  }

  /** An episode by its name. The last ones that were opened are kept. */
  openEpisode(episode: string): Promise<Episode> {
    let found = this.#episodes.get(episode);
    if (!found) {
      found = this.#open(episode);
      found.catch(() => this.#episodes.delete(episode));
    }
    this.#episodes.delete(episode);
    this.#episodes.set(episode, found);
    if (this.#episodes.size > EPISODES_KEPT) this.#episodes.delete(this.#episodes.keys().next().value!);
    return found;
  }
}

/** Opens stores with workers of its own. */
export class Library {
  readonly #pool: ReaderPool;
  readonly #stores = new Map<string, Promise<Store>>();

  /** `base`: the address of the page, to which those in `stores.json` are relative. */
  constructor(
    ports: readonly Port[],
    private readonly base: string,
  ) {
    this.#pool = new ReaderPool(ports);
  }

  openStore(entry: StoreEntry): Promise<Store> {
    let found = this.#stores.get(entry.root);
    if (!found) {
      const url = new URL(entry.root, this.base).href;
      found = this.#pool
        .document({ url }, "zarr.json", ROOT_BYTES)
        .then((document) => new Store(entry, parseRoot(document), url, this.#pool));
      this.#stores.set(entry.root, found);
      found.catch(() => this.#stores.delete(entry.root));
    }
    return found;
  }
}
