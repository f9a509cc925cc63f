/** Buttons and a slider that go through the replans, and play them. */
import { button, element } from "./dom";
import type { Shown } from "./shown";
import type { View } from "./state";

/** Milliseconds a replan stays; longer where somebody asked for less motion. */
const STAYS = 250;
const STAYS_REDUCED = 1000;

export class Player {
  readonly host = element("div", { class: "player" });
  readonly #play = button("▶", () => this.toggle(), { class: "play", "aria-label": "Play" });
  readonly #slider = element("input", { type: "range", min: 0, step: 1, name: "replan", "aria-label": "Replan" });
  readonly #text = element("output", { "data-number": "replan" });
  #timer = 0;
  #count = 1;

  constructor(private readonly view: View) {
    const step = (label: string, name: string, by: number): HTMLButtonElement => button(label, () => this.step(by), { "aria-label": name });
    this.#slider.addEventListener("input", () => this.view.update({ replan: Number(this.#slider.value) }));
    this.host.append(this.#play, step("‹", "replan before", -1), step("›", "next replan", 1), this.#slider, this.#text);
    view.subscribe((now, before) => {
      if (now.playing === before.playing) return;
      this.#play.textContent = now.playing ? "❚❚" : "▶";
      this.#play.setAttribute("aria-label", now.playing ? "Stop" : "Play");
    });
  }

  toggle(): void {
    const { playing, replan } = this.view.get();
    const atEnd = replan >= this.#count - 1;
    this.view.update({ playing: !playing, ...(!playing && atEnd ? { replan: 0 } : {}) });
    if (!playing) this.#next();
    else clearTimeout(this.#timer);
  }

  step(by: number): void {
    const replan = Math.min(Math.max(this.view.get().replan + by, 0), this.#count - 1);
    this.view.update({ replan, playing: false });
  }

  /** Called when a replan is drawn: the next one comes after a while. */
  show({ replan, episode }: Shown): void {
    this.#count = episode.numReplans;
    this.#slider.max = String(this.#count - 1);
    this.#slider.value = String(replan);
    const step = episode.document.env_step[replan];
    this.#text.textContent = `${replan} / ${this.#count - 1}`;
    this.#slider.setAttribute("aria-valuetext", `replan ${replan}${step === undefined ? "" : `, step ${step}`}`);
    if (this.view.get().playing) this.#next();
  }

  #next(): void {
    clearTimeout(this.#timer);
    const stays = matchMedia("(prefers-reduced-motion: reduce)").matches ? STAYS_REDUCED : STAYS;
    this.#timer = setTimeout(() => {
      const { playing, replan } = this.view.get();
      if (!playing) return;
      if (replan >= this.#count - 1) this.view.update({ playing: false });
      else this.view.update({ replan: replan + 1 });
    }, stays) as unknown as number;
  }
}
