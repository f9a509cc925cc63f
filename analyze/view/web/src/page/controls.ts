/** What is averaged and how it is shown: one control for each field of the state. */
import { COLOUR_MAPS, type ColourMap } from "./colour_maps";
import { choice, element } from "./dom";
import type { Shown } from "./shown";
import type { Measure, OneOrMean, View, ViewState, WordShade } from "./state";

const MEASURE_NAMES: readonly (readonly [Measure, string])[] = [
  ["lift", "lift (over uniform attention)"],
  ["raw", "raw (share of all attention)"],
  ["rank", "rank (among the valid keys)"],
];

const SHADE_NAMES: readonly (readonly [WordShade, string])[] = [
  ["effect", "effect (episode)"],
  ["replan", "effect (replan)"],
  ["attention", "attention (lift)"],
];

const oneOrMean = (text: string): OneOrMean => (text === "mean" ? "mean" : Number(text));

export class Controls {
  readonly host = element("section", { class: "controls", "aria-label": "What is shown" });
  readonly #site = choice("Site", "site", (site) => this.view.update({ site, layer: "mean", head: "mean", denoise: "mean", query: "mean" }));
  readonly #axes: Readonly<Record<"layer" | "head" | "denoise" | "query", ReturnType<typeof choice>>>;
  readonly #measure = choice("Values", "measure", (measure) => this.view.update({ measure: measure as Measure }));
  readonly #words = choice("Words shaded by", "words", (words) => this.view.update({ words: words as WordShade }));
  readonly #colours = choice("Colours", "colours", (colours) => this.view.update({ colours: colours as ColourMap }));
  readonly #opacity = element("input", { type: "range", min: 0, max: 100, step: 5, name: "opacity" });
  readonly #smooth = element("input", { type: "checkbox", name: "smooth" });

  constructor(private readonly view: View) {
    const axis = (name: "layer" | "head" | "denoise" | "query", label: string): ReturnType<typeof choice> =>
      choice(label, name, (value) => this.view.update({ [name]: oneOrMean(value) } as Partial<ViewState>));
    this.#axes = {
      layer: axis("layer", "Layer"),
      head: axis("head", "Head"),
      denoise: axis("denoise", "Denoise step"),
      query: axis("query", "Action query"),
    };
    this.#opacity.addEventListener("input", () => this.view.update({ opacity: Number(this.#opacity.value) / 100 }));
    this.#smooth.addEventListener("change", () => this.view.update({ smooth: this.#smooth.checked }));
    this.host.append(
      this.#site.host,
      ...Object.values(this.#axes).map((one) => one.host),
      this.#measure.host,
      this.#words.host,
      this.#colours.host,
      element("label", { class: "choice" }, element("span", {}, "Opacity"), this.#opacity),
      element("label", { class: "choice check" }, this.#smooth, element("span", {}, "smooth between patches")),
    );
  }

  show({ state, site, episode, selection, effects }: Shown): void {
    this.#site.show(episode.sites.map((each) => [each.layout.name, each.layout.name]), site.layout.name);
    const axis = (name: "layer" | "head" | "denoise", numbers: readonly number[], at: readonly number[], all: string): void => {
      const mean: [string, string][] = numbers.length > 1 ? [["mean", all]] : [];
      const one = at.length === 1 && (state[name] !== "mean" || numbers.length === 1);
      const options = [...new Set(numbers)].map((number): [string, string] => [String(number), String(number)]);
      this.#axes[name].show([...mean, ...options], one ? String(numbers[at[0]!]) : "mean");
    };
    axis("layer", site.layers, selection.layers, `mean of ${site.layers.length}`);
    axis("head", site.heads, selection.heads, `mean of ${site.heads.length}`);
    axis("denoise", site.denoise, selection.denoise, `mean of ${site.denoise.length}`);
    const queries = Array.from({ length: site.numQueries }, (_, i): [string, string] => [String(i), String(i)]);
    if (site.numQueries > 1) this.#axes.query.show([["mean", `mean of ${site.numQueries}`], ...queries], String(selection.query));
    else this.#axes.query.show([["mean", "mean, as recorded"]], "mean");
    this.#measure.show(MEASURE_NAMES, state.measure);
    this.#words.host.hidden = !effects?.known;
    this.#words.show(SHADE_NAMES, state.words);
    this.#colours.show(COLOUR_MAPS.map((name) => [name, name]), state.colours);
    if (document.activeElement !== this.#opacity) this.#opacity.value = String(Math.round(100 * state.opacity));
    this.#opacity.setAttribute("aria-valuetext", `${Math.round(100 * state.opacity)} per cent`);
    this.#smooth.checked = state.smooth;
  }
}
