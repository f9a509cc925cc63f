/** The panel in which two episodes, or a run and its intervention, stand side by side at the same moment. */
import "./compare.css";
import { button, choice, element } from "../page/dom";
import { type EpisodeColumn, episodeColumn } from "../page/episode_column";
import { type PageContext, type PanelInstance, registerPanel } from "../page/panels";
import { whenEffectsAreKnown } from "../page/effects_shown";
import { loadShown, selectionAt, type Shown, siteOf } from "../page/shown";
import { sentenceOf, StoreError } from "../store/errors";
import { commonCells } from "./common_cells";
import { differenceRows } from "./difference_table";
import { alignedValues, matchingReplan } from "./matching";

const NONE = "";
const SERIES = "compare";
const SERIES_COLOUR = "var(--warning)";

class ComparePanel implements PanelInstance {
  readonly #store = choice("Store", "other-store", (value) => this.#chooseStore(Number(value)));
  readonly #episode = choice("Episode", "other-episode", (value) => this.#chooseEpisode(value));
  readonly #same = button("the same episode there", () => this.#chooseSame());
  readonly #note = element("p", { class: "soft", role: "status" });
  readonly #failure = element("p", { class: "warning", role: "alert", hidden: true });
  readonly #place = element("output", {});
  readonly #pair = element("div", { hidden: true });
  readonly #left: EpisodeColumn;
  readonly #right: EpisodeColumn;
  readonly #rows = element("tbody");
  #asked = 0;
  #shown: Shown | null = null;
  #seriesOf: readonly [unknown, unknown] | null = null;

  constructor(
    private readonly host: HTMLElement,
    private readonly page: PageContext,
  ) {
    const columns = [element("section", { "aria-label": "This episode" }), element("section", { "aria-label": "The other episode" })];
    const explain = (): void => this.page.explain();
    this.#left = episodeColumn(columns[0]!, explain);
    this.#right = episodeColumn(columns[1]!, explain);
    this.#left.pictures.shareScale(this.#right.pictures);
    this.#right.pictures.shareScale(this.#left.pictures);
    const head = ["", "this", "other", "other against this"].map((name) => element("th", { scope: "col" }, name));
    const step = (by: number): void => {
      const { replan } = this.#shown ?? {};
      if (replan !== undefined) this.page.view.update({ replan: Math.max(0, replan + by), playing: false });
    };
    this.#pair.append(
      element(
        "div",
        { class: "compare-steps" },
        button("‹", () => step(-1), { "aria-label": "Replan before" }),
        button("›", () => this.#shown && this.#shown.replan + 1 < this.#shown.episode.numReplans && step(1), {
          "aria-label": "Next replan",
        }),
        this.#place,
      ),
      element(
        "table",
        { class: "numbers compare-table" },
        element("thead", {}, element("tr", {}, ...head)),
        this.#rows,
      ),
      element("div", { class: "compare-columns" }, ...columns),
    );
    this.host.append(
      element("div", { class: "compare-choice" }, this.#store.host, this.#episode.host, this.#same),
      this.#note,
      this.#failure,
      this.#pair,
    );
  }

  update(shown: Shown): void {
    this.#shown = shown;
    this.#showChoices(shown);
    void this.#compare(shown);
  }

  destroy(): void {
    this.#asked++;
    this.page.timeline.setSeries(SERIES, null);
    this.host.replaceChildren();
  }

  #chooseStore(store: number): void {
    const { episode } = this.page.view.get();
    const names = this.page.stores[store]?.episodes.map(({ name }) => name) ?? [];
    const same = store !== this.page.view.get().store && names.includes(episode ?? "") ? episode : null;
    this.page.view.update({ otherStore: store, otherEpisode: same });
  }

  #chooseEpisode(name: string): void {
    const { otherStore, store } = this.page.view.get();
    this.page.view.update({ otherStore: otherStore ?? store, otherEpisode: name === NONE ? null : name });
  }

  #chooseSame(): void {
    const { episode, otherStore, store } = this.page.view.get();
    if (episode !== null) this.page.view.update({ otherStore: otherStore ?? store, otherEpisode: episode });
  }

  #showChoices({ state, episode }: Shown): void {
    const which = state.otherStore ?? state.store;
    const { stores } = this.page;
    this.#store.show(stores.map(({ name }, i) => [String(i), i === state.store ? `${name} (this one)` : name]), String(which));
    const names = stores[which]?.episodes.map(({ name }) => name) ?? [];
    this.#episode.show(
      [[NONE, "none"], ...names.map((name): [string, string] => [name, name])],
      state.otherEpisode !== null && names.includes(state.otherEpisode) ? state.otherEpisode : NONE,
    );
    this.#same.hidden = which === state.store || state.otherEpisode === episode.name || !names.includes(episode.name);
  }

  async #compare(shown: Shown): Promise<void> {
    const asked = ++this.#asked;
    const { state } = shown;
    if (state.otherEpisode === null) {
      this.#end("Choose an episode to see it beside this one, at the same environment step.");
      return;
    }
    try {
      const store = await this.page.openStore(state.otherStore ?? state.store);
      if (!store.episodeNames.includes(state.otherEpisode)) {
        throw new StoreError(`${store.entry.name} has no episode ${state.otherEpisode}.`);
      }
      const episode = await store.openEpisode(state.otherEpisode);
      const steps = shown.episode.document.env_step;
      const others = episode.document.env_step;
      const replan = matchingReplan(steps, shown.replan, others, episode.numReplans);
      const there = { ...state, replan, site: shown.site.layout.name };
      const { meanOf, said } = commonCells(
        { name: shown.store.entry.name, root: shown.store.root, site: shown.site },
        { name: store.entry.name, root: store.root, site: siteOf(episode, there) },
        state,
      );
      // Of fewer layers, denoise steps and heads than the page shows, this episode is read again.
      const { selection } = selectionAt(shown.site, state, meanOf);
      const isShown = JSON.stringify(selection) === JSON.stringify(shown.selection);
      const [here, other] = await Promise.all([
        isShown ? shown : loadShown(shown.store, shown.episode, state, meanOf),
        loadShown(store, episode, there, meanOf),
      ]);
      if (asked !== this.#asked) return;
      this.#draw(here, other, said);
      this.#drawSeries(isShown ? here : null, other);
      whenEffectsAreKnown(other, () => asked === this.#asked && void this.#compare(shown));
      this.host.dataset.ready = "1";
      this.host.dataset.shown = `${other.store.entry.name}:${other.episode.name}:${other.replan}`;
    } catch (failure) {
      if (asked !== this.#asked) return;
      this.#end("");
      this.#failure.hidden = false;
      this.#failure.textContent = sentenceOf(failure);
      this.host.dataset.ready = "1";
    }
  }

  #draw(shown: Shown, other: Shown, said: string): void {
    this.#failure.hidden = true;
    this.#pair.hidden = false;
    this.#left.show(shown);
    this.#right.show(other);
    // The scale is that of both; the first was drawn before the second was known.
    this.#left.pictures.shareScale(this.#right.pictures);
    this.#rows.replaceChildren(...differenceRows(shown, other));
    const [a, b] = [shown, other].map(({ episode, replan }) => episode.document.env_step[replan]);
    const far = a !== undefined && b !== undefined && a !== b;
    this.#place.textContent = `replan ${shown.replan} beside replan ${other.replan}`;
    const pairs =
      a === undefined || b === undefined
        ? "Replans of equal number stand side by side: environment steps are not known."
        : `Replans at the nearest environment step stand side by side${far ? ` (here ${a} and ${b})` : ""}.`;
    this.#note.textContent = `${said} ${pairs} Both pictures have one colour scale.`.trim();
  }

  /** The other's ratio as a line of the timeline; `shown` is null where that is of other layers, denoise steps or heads. */
  #drawSeries(shown: Shown | null, other: Shown): void {
    if (!shown) {
      this.#endSeries();
      return;
    }
    if (this.#seriesOf?.[0] === shown.numbers && this.#seriesOf[1] === other.numbers) return;
    this.#seriesOf = [shown.numbers, other.numbers];
    const { env_step: steps } = shown.episode.document;
    const ratios = other.numbers.replans.map(({ ratio }) => ratio?.value ?? null);
    const values = alignedValues(steps, shown.episode.numReplans, other.episode.document.env_step, ratios);
    const has = values.some((value) => value !== null);
    const name = `ratio of ${other.store.entry.name === shown.store.entry.name ? "" : `${other.store.entry.name} `}${other.episode.name}`;
    this.page.timeline.setSeries(SERIES, has ? { name, colour: SERIES_COLOUR, values, unit: "" } : null);
  }

  #end(note: string): void {
    this.#pair.hidden = true;
    this.#failure.hidden = true;
    this.#note.textContent = note;
    this.#endSeries();
    delete this.host.dataset.ready;
    delete this.host.dataset.shown;
  }

  #endSeries(): void {
    if (this.#seriesOf) this.page.timeline.setSeries(SERIES, null);
    this.#seriesOf = null;
  }
}

registerPanel({
  id: "compare",
  title: "Side by side",
  order: 40,
  wide: true,
  open: true,
  mount: (host, page) => new ComparePanel(host, page),
});
