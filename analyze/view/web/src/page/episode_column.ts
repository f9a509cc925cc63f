/** Pictures, words and numbers of one episode at one replan: the page's own, and that of an episode beside it. */
import { visible } from "../store/errors";
import { happenings } from "../store/steps_document";
import { element } from "./dom";
import { EffectTable } from "./effect_table";
import { Headline } from "./headline";
import { Inspector } from "./inspector";
import { Legend } from "./legend";
import { outcomeWord, plural } from "./number_text";
import { orientationNote, viewOf } from "./overlay";
import { PictureBoard } from "./picture_board";
import type { Shown } from "./shown";
import { otherSites, WordStrip } from "./word_strip";

export interface EpisodeColumn {
  readonly host: HTMLElement;
  readonly pictures: PictureBoard;
  readonly words: WordStrip;
  /** What is below the pictures: the page puts its timeline before it. */
  readonly below: HTMLElement;
  show(shown: Shown): void;
  destroy(): void;
}

/** What was averaged, in words. */
export function averagedOver({ site, selection, numbers: _, state }: Shown): string {
  const one = (name: string, numbers: readonly number[], at: readonly number[]): string =>
    at.length === 1 ? `${name} ${numbers[at[0]!]}` : `mean of ${plural(at.length, name)}`;
  const query = site.numQueries === 1 || state.query === "mean" ? "mean of the action queries" : `query ${state.query}`;
  return [
    `site ${site.layout.name}`,
    one("layer", site.layers, selection.layers),
    one("head", site.heads, selection.heads),
    one("denoise step", site.denoise, selection.denoise),
    query,
  ].join(", ");
}

/** Make a column in a host. `explain` opens what the numbers mean. */
export function episodeColumn(host: HTMLElement, explain: () => void, level: "h1" | "h2" = "h2"): EpisodeColumn {
  const title = element(level, { class: "title" });
  const about = element("p", { class: "soft about" });
  const pictures = new PictureBoard();
  const words = new WordStrip();
  const effects = new EffectTable();
  const legend = new Legend();
  const inspector = new Inspector(pictures, words);
  const headline = new Headline(explain);
  const note = element("p", { class: "soft" });
  const corrections = element("p", { class: "warning", role: "status", hidden: true });
  host.classList.add("column");
  host.append(title, about, corrections, headline.figures, words.host, effects.host, pictures.host, legend.host, inspector.host, note, headline.masses);
  return {
    host,
    pictures,
    words,
    below: note,
    show(shown) {
      const { episode, store, replan } = shown;
      const { document } = episode;
      title.textContent = visible(document.instruction) || episode.name;
      const step = document.env_step[replan];
      about.textContent = [
        episode.name,
        document.task_name,
        outcomeWord(document.success),
        ...happenings(document.steps, document.task_id).map(visible),
        `replan ${replan} (last: ${episode.numReplans - 1})${step === undefined ? "" : `, step ${step}`}`,
        averagedOver(shown),
        store.root.policy.untrained ? "untrained weights" : "",
        store.root.interventions.name ? `with the intervention ${store.root.interventions.name}` : "",
      ]
        .filter(Boolean)
        .join(" · ");
      corrections.hidden = !shown.corrections;
      corrections.textContent = shown.corrections;
      pictures.onScale = (scale) => legend.show(scale, shown.state);
      pictures.show(shown);
      words.show(shown);
      effects.show(shown);
      headline.show(shown);
      inspector.show(shown);
      const cameras = [...shown.frames.keys()];
      const missing = cameras.filter((camera) => !shown.frames.get(camera));
      note.textContent = cameras.length
        ? orientationNote(cameras.map((camera) => viewOf(store.root.policy.cameras, camera)), missing)
        : `The keys of site ${shown.site.layout.name} are no patches of pictures.` +
          otherSites(episode, (span) => span.camera !== null && span.grid !== null);
    },
    destroy() {
      host.replaceChildren();
    },
  };
}
