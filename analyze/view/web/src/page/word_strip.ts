/** The prompt as text: the instruction's words shaded by their effect or by the attention on their keys, the rest as it stands. */
import { characters } from "../grouping/text";
import type { Word } from "../grouping/words";
import { type EpisodeEffects, sizesOf } from "../measures/effects";
import { overUniform } from "../measures/ranks";
import type { SpanDocument } from "../store/documents";
import type { Episode } from "../store/episode";
import { button, element } from "./dom";
import { decidingWord, itemsOfWords, wordEffect } from "./effect_words";
import { formatNumber, formatPercent } from "./number_text";
import type { Shown } from "./shown";

export type WordListener = (place: number, word: Word) => void;

export interface WordMeasures {
  mass: number;
  /** Mass over what uniform attention gives; NaN for a word without keys that a query sees. */
  lift: number;
}

/** Mass and lift of keys in a row, as `vla-analyze words` has them. */
export function measuresOfKeys(keys: readonly number[], { row, valid, uniform }: Pick<Shown, "row" | "valid" | "uniform">): WordMeasures {
  let [mass, given] = [0, 0];
  for (const key of keys) {
    mass += row[key]!;
    given += uniform[key]!;
  }
  return { mass, lift: given > 0 ? mass / given / overUniform(row, valid, uniform) : NaN };
}

function attentionText({ mass, lift }: WordMeasures): string {
  return `${formatPercent(mass, 2)} of the attention, ${formatNumber(lift)} times uniform attention`;
}

/** The sites whose keys have spans of a kind, to choose from: a sentence, empty where there is none. */
export function otherSites(episode: Episode, has: (span: SpanDocument) => boolean): string {
  const names = episode.sites.filter((each) => each.layout.spans.some(has)).map((each) => each.layout.name);
  return names.length ? ` Choose site ${names.join(" or ")} for them.` : "";
}

/** A word's shade ends at this lift, or at the highest of the sentence. */
const LEAST_TOP = 4;
/** Opacity of a full shade in per cent: the word stays legible on it. */
const MOST_SHADE = 52;
/** Part of a full shade of an effect that is just above the noise floor. */
const LEAST_PART = 0.25;

export class WordStrip {
  readonly host = element("div", { class: "words" });
  readonly #clicked = new Set<WordListener>();
  readonly #hovered = new Set<(place: number | null) => void>();
  readonly #marks = new Map<string, { places: ReadonlySet<number>; colour: string }>();
  readonly #decides = element("p", { class: "decides", hidden: true });
  readonly #line = element("p", { class: "prompt" });
  readonly #note = element("p", { class: "soft" });
  #buttons: HTMLButtonElement[] = [];
  #built = "";

  constructor() {
    this.host.append(this.#decides, this.#line, this.#note);
  }

  onWord(listen: WordListener): () => void {
    this.#clicked.add(listen);
    return () => this.#clicked.delete(listen);
  }

  /** Be told which word the pointer or the focus is on; null: it left. */
  onHover(listen: (place: number | null) => void): () => void {
    this.#hovered.add(listen);
    return () => this.#hovered.delete(listen);
  }

  /** Underline words in a group's colour; an empty set removes the line. */
  mark(id: string, places: ReadonlySet<number>, colour: string): void {
    if (places.size) this.#marks.set(id, { places, colour });
    else this.#marks.delete(id);
    this.#drawMarks();
  }

  show(shown: Shown): void {
    const { words, prompt, episode, site } = shown;
    const built = prompt ? `${prompt.text}\n${words.map((word) => word.start).join()}` : episode.document.instruction;
    if (built !== this.#built) {
      this.#built = built;
      this.#build(shown);
    }
    const measures = words.map((word) => measuresOfKeys(word.keys, shown));
    measures.forEach(({ mass, lift }, i) => Object.assign(this.#buttons[i]!.dataset, { mass: String(mass), lift: String(lift) }));
    const { effects, state, replan } = shown;
    const at = state.words === "replan" ? replan : null;
    const sentence = effects?.known ? decidingWord(effects.known, at) : (effects?.note ?? "");
    this.#decides.hidden = !sentence;
    this.#decides.textContent = sentence;
    this.host.dataset.shade = effects?.known && state.words !== "attention" ? "effect" : "attention";
    const note = !words.length
      ? `The keys of site ${site.layout.name} spell no words.${otherSites(episode, (span) => span.kind === "text")}`
      : effects?.known && state.words !== "attention"
        ? this.#shadeByEffect(shown, effects.known, at, measures)
        : this.#shadeByLift(measures);
    this.#note.textContent = note;
  }

  #shade(place: number, part: number, number: string, said: string, title: string): void {
    const made = this.#buttons[place]!;
    made.style.setProperty("--part", `${Math.round(MOST_SHADE * (part > 0 ? Math.min(part, 1) : 0))}%`);
    made.title = title;
    const [, unseen, shownNumber] = made.children as unknown as [HTMLElement, HTMLElement, HTMLElement];
    unseen.textContent = `: ${said}`;
    shownNumber.textContent = number;
  }

  #shadeByLift(measures: readonly WordMeasures[]): string {
    const finite = measures.map(({ lift }) => lift).filter(Number.isFinite);
    const top = Math.max(LEAST_TOP, ...finite);
    measures.forEach((measure, i) => {
      const { lift } = measure;
      this.#shade(i, lift / top, Number.isFinite(lift) ? `×${formatNumber(lift)}` : "-", attentionText(measure), "");
      this.#buttons[i]!.classList.remove("below");
    });
    return `Shade and number of a word: its lift (×1 is uniform, full shade ×${formatNumber(top)}).`;
  }

  #shadeByEffect({ words }: Shown, effects: EpisodeEffects, replan: number | null, measures: readonly WordMeasures[]): string {
    const items = itemsOfWords(effects, words);
    const found = items.map((item) => wordEffect(item, effects, replan));
    const top = Math.max(...found.filter(({ below }) => !below).map(({ size }) => size.mean || 0), 0);
    const from = sizesOf(effects.noise, replan).mean;
    // By factors above the floor: a single huge effect would leave the others without a shade.
    const part = (mean: number): number =>
      from > 0 && top > from ? LEAST_PART + (1 - LEAST_PART) * (Math.log(mean / from) / Math.log(top / from)) : mean / top;
    found.forEach(({ size, below, said }, i) => {
      const together = items[i] && items.indexOf(items[i]) !== items.lastIndexOf(items[i]) ? ", all its places together" : "";
      const attention = attentionText(measures[i]!);
      this.#shade(i, below ? 0 : part(size.mean), formatNumber(size.mean), `${said}${together}`, `${said}${together}. ${attention}.`);
      this.#buttons[i]!.classList.toggle("below", below);
      this.#buttons[i]!.dataset.effect = String(size.mean);
    });
    const full = top > 0 ? ` (full shade ${formatNumber(top)})` : "";
    const floor = formatNumber(sizesOf(effects.noise, replan).mean);
    const below = found.some((one) => one.below) ? ` Dashed and without a shade: below the noise floor, ${floor}.` : "";
    return `Shade and number of a word: how far the action changes without it, in units of its spread in the store${full}; shades go by factors.${below}`;
  }

  #build({ prompt, words, episode }: Shown): void {
    this.#buttons = [];
    this.#line.replaceChildren();
    if (!prompt) {
      this.#line.append(episode.document.instruction);
      return;
    }
    const text = characters(prompt.text);
    let at = 0;
    const rest = (until: number): void => {
      if (until > at) this.#line.append(element("span", { class: "soft" }, text.slice(at, until).join("").replace(/\s+/g, " ")));
    };
    words.forEach((word, place) => {
      rest(word.start);
      at = word.stop;
      const click = (): void => {
        this.#hovered.forEach((listen) => listen(place)); // a finger that is lifted has left, and gives no focus everywhere
        this.#clicked.forEach((listen) => listen(place, word));
      };
      const made = button("", click, { "data-word": place, class: "word" });
      made.append(element("span", {}, word.text), element("span", { class: "unseen" }), element("small", { "aria-hidden": "true" }));
      const over = (on: boolean) => (): void => this.#hovered.forEach((listen) => listen(on ? place : null));
      made.addEventListener("pointerenter", over(true));
      made.addEventListener("pointerleave", over(false));
      made.addEventListener("focus", over(true));
      made.addEventListener("blur", over(false));
      this.#buttons.push(made);
      this.#line.append(made);
    });
    rest(text.length);
    this.#drawMarks();
  }

  #drawMarks(): void {
    this.#buttons.forEach((made, place) => {
      const colours = [...this.#marks.values()].filter((mark) => mark.places.has(place)).map((mark) => mark.colour);
      made.style.borderBottomColor = colours[0] ?? "";
    });
  }
}
