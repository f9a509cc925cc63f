/** The colours of the pictures with their numbers. */
import { colourTable } from "./colour_maps";
import { element } from "./dom";
import { formatNumber } from "./number_text";
import type { Scale } from "./overlay";
import type { ViewState } from "./state";

const GREY = 128;
const WIDTH = 256;
const NEAREST = 0.15;

export class Legend {
  readonly host = element("div", { class: "legend" });
  readonly #bar = element("canvas", { width: WIDTH, height: 1, "aria-hidden": "true" });
  readonly #ticks = element("div", { class: "ticks" });
  readonly #label = element("p", { class: "soft" });

  constructor() {
    this.host.append(this.#bar, this.#ticks, this.#label);
  }

  show(scale: Scale | null, { colours, opacity }: ViewState): void {
    this.host.hidden = scale === null;
    if (!scale) return;
    const table = colourTable(colours);
    const pixels = new ImageData(WIDTH, 1);
    for (let x = 0; x < WIDTH; x++) {
      const place = (x + 0.5) / WIDTH;
      const over = opacity * place;
      for (let c = 0; c < 3; c++) pixels.data[4 * x + c] = (1 - over) * GREY + over * table[3 * x + c]!;
      pixels.data[4 * x + 3] = 255;
    }
    this.#bar.getContext("2d")!.putImageData(pixels, 0, 0);
    const ticks: [number, string][] = [[1, `${formatNumber(scale.high)}${scale.unit}${scale.high === 100 ? "" : " or more"}`]];
    const uniform = scale.uniform === null ? 0 : scale.uniform / scale.high;
    if (scale.uniform !== null) ticks.unshift([uniform, `uniform ${formatNumber(scale.uniform)}${scale.unit}`]);
    // Labels that are nearer than this would touch.
    if (scale.uniform === null || uniform > NEAREST) ticks.unshift([0, "0"]);
    this.#ticks.replaceChildren(
      ...ticks.map(([place, text]) => {
        const tick = element("span", { class: place === 1 ? "last" : place <= NEAREST ? "first" : "" }, text);
        tick.style.left = `${100 * place}%`;
        return tick;
      }),
    );
    this.#label.textContent = scale.label;
  }
}
