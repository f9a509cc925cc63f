/** The page: its parts, and what happens when the state changes. */
import "./theme.css";
import "./parts.css";
import "./viewer.css";
import "../panels";
import { sentenceOf, StoreError, visible } from "../store/errors";
import { Library, openStores, type Store, type StoreEntry, type Summary, SUMMARY_AGAIN, summaryOf } from "../store/open";
import { workerPort } from "../store/reader_pool";
import { Controls } from "./controls";
import { button, element } from "./dom";
import { episodeColumn } from "./episode_column";
import { whenEffectsAreKnown } from "./effects_shown";
import { EpisodeList } from "./episode_list";
import { eventsOf } from "./events";
import { HeadGrid } from "./head_grid";
import { Help } from "./help";
import { type PageContext, type PanelInstance, panels } from "./panels";
import { Player } from "./player";
import { rowsOfTimeline } from "./series";
import { listenForKeys } from "./shortcuts";
import { loadShown, type Shown } from "./shown";
import { linkOfState, stateOfLink, View, type ViewState } from "./state";
import { themeButton } from "./theme";
import { Timeline } from "./timeline";

const WORKERS = 2;

interface Timing {
  name: string;
  ms: number;
}

export class App {
  readonly #view: View;
  readonly #library: Library;
  readonly #list: EpisodeList;
  readonly #column;
  readonly #controls: Controls;
  readonly #player: Player;
  readonly #timeline: Timeline;
  readonly #grid: HeadGrid;
  readonly #help = new Help();
  readonly #live = element("div", { class: "unseen", role: "status", "aria-live": "polite" });
  readonly #failure = element("p", { class: "failure", role: "alert", hidden: true });
  readonly #episodePart = element("div", { class: "episode" });
  readonly #panels: PanelInstance[] = [];
  readonly #timings: Timing[] = [];
  #stores: readonly StoreEntry[] = [];
  readonly #summaries = new Map<number, Summary>();
  #shown: Shown | null = null;
  #asked = 0;
  #timelineOf: unknown = null;

  constructor(private readonly page: HTMLElement) {
    this.#view = new View(stateOfLink(location.search), (state, how) => {
      const link = `${location.pathname}${linkOfState(state)}`;
      if (how === "push") history.pushState(null, "", link);
      else history.replaceState(null, "", link);
    });
    const ports = Array.from({ length: WORKERS }, () => workerPort(import.meta.url));
    this.#library = new Library(ports, document.baseURI);
    this.#list = new EpisodeList(this.#view);
    const main = element("section", { class: "main", "aria-label": "Episode" });
    this.#column = episodeColumn(main, () => this.#help.open(true), "h1");
    this.#controls = new Controls(this.#view);
    this.#player = new Player(this.#view);
    this.#timeline = new Timeline((replan) => this.#view.update({ replan, playing: false }));
    this.#grid = new HeadGrid(this.#view);
    this.#column.below.before(this.#player.host, this.#timeline.host);
    this.#build(main);
    listenForKeys({ view: this.#view, player: this.#player, list: this.#list, help: this.#help, shown: () => this.#shown });
    this.#view.subscribe((now, before) => this.#changed(now, before));
    window.addEventListener("popstate", () => this.#view.restore({ ...stateOfLink(location.search), playing: false }));
    Object.assign(window, { viewer: { view: this.#view, shown: () => this.#shown, timings: this.#timings } });
    void this.#start();
  }

  #build(main: HTMLElement): void {
    const list = element("details", { class: "list", open: true }, element("summary", {}, "Episodes"), this.#list.host);
    if (matchMedia("(max-width: 760px)").matches) list.open = false;
    const folded = (title: string, open: boolean, ...children: Node[]): HTMLDetailsElement =>
      element("details", { class: "panel", open }, element("summary", {}, title), ...children);
    const side = element(
      "aside",
      { class: "side", "aria-label": "Controls and panels" },
      folded("View", true, this.#controls.host),
      folded("Layers and heads", true, this.#grid.host),
    );
    this.#episodePart.append(main, side);
    this.page.classList.add("page");
    this.page.append(
      element(
        "header",
        {},
        element("strong", {}, "Attention viewer"),
        element("span", { class: "soft store-name" }),
        themeButton(),
        button("Help", () => this.#help.open()),
      ),
      this.#failure,
      element("div", { class: "body" }, list, this.#episodePart),
      this.#live,
      this.#help.dialog,
    );
    this.#mountPanels(side);
  }

  #mountPanels(side: HTMLElement): void {
    for (const panel of panels()) {
      const host = element("div", { "data-panel": panel.id });
      const folded = element("details", { class: "panel", open: panel.open ?? false }, element("summary", {}, panel.title), host);
      if (panel.wide) {
        folded.classList.add("wide");
        this.#episodePart.append(folded);
      } else side.append(folded);
      const context: PageContext = {
        view: this.#view,
        stores: this.#stores,
        openStore: (which) => this.#openStore(which),
        announce: (text) => this.#announce(text),
        explain: () => this.#help.open(true),
        pictures: this.#column.pictures,
        words: this.#column.words,
        timeline: this.#timeline,
      };
      Object.defineProperty(context, "stores", { get: () => this.#stores });
      this.#panels.push(panel.mount(host, context));
    }
  }

  #announce(text: string): void {
    this.#live.textContent = text;
  }

  #openStore(which: number): Promise<Store> {
    const entry = this.#stores[which];
    if (!entry) return Promise.reject(new StoreError(`There is no store ${which}; there are ${this.#stores.length}.`));
    return this.#library.openStore(entry);
  }

  async #start(): Promise<void> {
    try {
      this.#stores = await openStores();
      if (!this.#stores.length) throw new StoreError("stores.json lists no store.");
      if (!this.#stores[this.#view.get().store]) this.#view.update({ store: 0, episode: null }, "replace");
      this.#showStore();
      await this.#load();
    } catch (failure) {
      this.#fail(failure);
    }
  }

  #showStore(): void {
    const { store } = this.#view.get();
    const entry = this.#stores[store];
    if (!entry) return;
    this.page.querySelector(".store-name")!.textContent = entry.name;
    this.#list.showStores(this.#stores, store);
    this.#list.showEpisodes(entry, this.#summaries.get(store) ?? null);
    if (!this.#summaries.get(store)?.complete) void this.#readSummary(store);
  }

  async #readSummary(store: number): Promise<void> {
    try {
      const summary = await summaryOf(this.#stores[store]!);
      this.#summaries.set(store, summary);
      if (this.#view.get().store !== store) return;
      this.#list.showEpisodes(this.#stores[store]!, summary);
      if (!summary.complete && !summary.failed) setTimeout(() => void this.#readSummary(store), SUMMARY_AGAIN);
    } catch {
      // Without a summary the list has names only; what is wrong with the server shows where an episode is read.
    }
  }

  #changed(now: ViewState, before: ViewState): void {
    if (now.store !== before.store) this.#showStore();
    if (now.episode !== before.episode) this.#list.markShown();
    const unread: readonly (keyof ViewState)[] = ["playing"];
    if ((Object.keys(now) as (keyof ViewState)[]).every((field) => unread.includes(field) || now[field] === before[field])) return;
    void this.#load();
  }

  #fail(failure: unknown): void {
    this.#failure.hidden = false;
    this.#failure.textContent = sentenceOf(failure);
    this.#episodePart.hidden = this.#shown === null;
    this.page.dataset.failed = "1";
    this.page.dataset.ready = "1";
  }

  /** Read and draw the present state; what was asked for before and comes later is dropped. */
  async #load(): Promise<void> {
    const asked = ++this.#asked;
    const begun = performance.now();
    delete this.page.dataset.ready;
    const state = this.#view.get();
    try {
      const store = await this.#openStore(state.store);
      const name = state.episode ?? store.episodeNames[0];
      if (name === undefined) throw new StoreError(`The store ${store.entry.name} has no episodes yet.`);
      if (state.episode === null) {
        this.#view.update({ episode: name }, "replace");
        return;
      }
      const shown = await loadShown(store, await store.openEpisode(name), state);
      if (asked !== this.#asked) return;
      this.#failure.hidden = true;
      delete this.page.dataset.failed;
      await this.#draw(shown);
      if (asked !== this.#asked) return;
      this.page.dataset.shown = linkOfState(state);
      this.page.dataset.ready = "1";
      this.#timings.push({ name: linkOfState(state), ms: performance.now() - begun });
      if (this.#timings.length > 1000) this.#timings.shift();
      this.#prefetch(shown);
      whenEffectsAreKnown(shown, () => asked === this.#asked && void this.#load());
    } catch (failure) {
      if (asked === this.#asked) this.#fail(failure);
    }
  }

  async #draw(shown: Shown): Promise<void> {
    const before = this.#shown;
    this.#shown = shown;
    this.#episodePart.hidden = false;
    this.#column.show(shown);
    this.#controls.show(shown);
    this.#grid.show(shown);
    this.#player.show(shown);
    if (this.#timelineOf !== shown.numbers) {
      this.#timelineOf = shown.numbers;
      const steps = shown.episode.document.env_step;
      const all = steps.length ? steps : shown.numbers.replans.map((_, i) => i);
      this.#timeline.setEpisode(all, await eventsOf(shown.store.root, shown.episode), rowsOfTimeline(shown.numbers));
    }
    this.#timeline.setReplan(shown.replan);
    for (const panel of this.#panels) panel.update(shown);
    if (before?.episode !== shown.episode) document.title = `${shown.episode.name}: ${visible(shown.episode.document.instruction).slice(0, 80)}`;
    if (!shown.state.playing) {
      const ratio = shown.numbers.replans[shown.replan]!.ratio;
      this.#announce(`Replan ${shown.replan}${ratio ? `, ratio ${ratio.value.toPrecision(3)}` : ""}`);
    }
  }

  /** Read what is likely to be asked for next: the layers and the picture beside what is shown. */
  #prefetch({ episode, site, selection, replan, allRows, frames }: Shown): void {
    const idle = window.requestIdleCallback ?? ((act: () => void) => setTimeout(act, 200));
    const asked = this.#asked;
    idle(() => {
      if (asked !== this.#asked) return;
      const quietly = (reading: Promise<unknown>): void => void reading.catch(() => undefined);
      for (const camera of frames.keys()) if (replan + 1 < episode.numReplans) quietly(episode.frame(camera, replan + 1));
      if (!allRows) return;
      const beside = (axis: "layers" | "denoise", count: number): void => {
        if (selection[axis].length > 1) return;
        for (const place of [selection[axis][0]! + 1, selection[axis][0]! - 1]) {
          if (place < 0 || place >= count) continue;
          quietly(episode.meanRows(site.layout.name, { ...selection, [axis]: [place] }));
        }
      };
      beside("layers", site.layers.length);
      // With a mean over layers this would read half of the episode.
      if (selection.layers.length === 1) beside("denoise", site.denoise.length);
    });
  }
}
