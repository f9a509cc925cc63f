/** Keys of the page; `help.ts` lists them. */
import { COLOUR_MAPS } from "./colour_maps";
import type { EpisodeList } from "./episode_list";
import type { Help } from "./help";
import type { Player } from "./player";
import type { Shown } from "./shown";
import { MEASURES, type OneOrMean, type View, type ViewState, WORD_SHADES } from "./state";

const next = <T>(values: readonly T[], value: T): T => values[(values.indexOf(value) + 1) % values.length]!;

/** The number before or after one on an axis: the mean is before the first. */
function stepped(numbers: readonly number[], now: OneOrMean, by: number): OneOrMean {
  const places: OneOrMean[] = numbers.length > 1 ? ["mean", ...numbers] : [...numbers];
  const at = Math.max(0, places.indexOf(now)) + by;
  return places[Math.min(Math.max(at, 0), places.length - 1)]!;
}

export interface Parts {
  view: View;
  player: Player;
  list: EpisodeList;
  help: Help;
  shown(): Shown | null;
}

function act(event: KeyboardEvent, { view, player, list, help, shown }: Parts): boolean {
  const state = view.get();
  const now = shown();
  const axis = (name: "layer" | "head" | "denoise", by: number): void => {
    if (!now) return;
    const numbers = { layer: now.site.layers, head: now.site.heads, denoise: now.site.denoise }[name];
    view.update({ [name]: stepped(numbers, state[name], by) } as Partial<ViewState>);
  };
  const episode = (by: number): void => {
    const name = list.neighbour(by);
    if (name) view.update({ episode: name, replan: 0, playing: false });
  };
  const keys: Record<string, () => void> = {
    ArrowLeft: () => player.step(event.shiftKey ? -10 : -1),
    ArrowRight: () => player.step(event.shiftKey ? 10 : 1),
    Home: () => player.step(-Infinity),
    End: () => player.step(Infinity),
    " ": () => player.toggle(),
    "[": () => axis("layer", -1),
    "]": () => axis("layer", 1),
    ",": () => axis("head", -1),
    ".": () => axis("head", 1),
    "-": () => axis("denoise", -1),
    "+": () => axis("denoise", 1),
    "=": () => axis("denoise", 1),
    "0": () => view.update({ layer: "mean", head: "mean", denoise: "mean", query: "mean" }),
    v: () => view.update({ measure: next(MEASURES, state.measure) }),
    w: () => {
      if (now?.effects?.known) view.update({ words: next(WORD_SHADES, state.words) });
    },
    c: () => view.update({ colours: next(COLOUR_MAPS, state.colours) }),
    s: () => view.update({ smooth: !state.smooth }),
    n: () => episode(1),
    p: () => episode(-1),
    "/": () => list.focusSearch(),
    "?": () => help.open(),
  };
  const found = Object.hasOwn(keys, event.key) ? keys[event.key] : undefined;
  found?.();
  return found !== undefined;
}

/** Listen for keys, but not where somebody types or a control takes them. */
export function listenForKeys(parts: Parts): void {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    const target = event.target as HTMLElement;
    if (target.closest("input:not([type=checkbox]), select, textarea, dialog, [contenteditable]")) return;
    if (event.key === " " && target.closest("button, summary, input, a")) return;
    if (act(event, parts)) event.preventDefault();
  });
}
