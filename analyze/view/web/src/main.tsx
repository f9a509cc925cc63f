/** The page: the overview of a run, or one of its episodes. */
import { computed, effect } from "@preact/signals";
import { render } from "preact";

import "./page.css";
import { trouble } from "./answers";
import { reading } from "./effects";
import { EpisodePage } from "./episode";
import { HeadPage, headRead } from "./head";
import { Overview } from "./overview";
import { coming } from "./pictures";
import {
  axes,
  beside,
  closeEpisode,
  denoise,
  episodeName,
  head,
  layer,
  main,
  mended,
  part,
  playing,
  run,
  runs,
  setPart,
  walk,
} from "./state";

function App() {
  return (
    <>
      {trouble.value ? (
        <p class="banner" role="alert">
          {trouble}
        </p>
      ) : null}
      {mended.value ? (
        <p class="banner" role="status">
          {mended.value}
        </p>
      ) : null}
      <Shown />
    </>
  );
}

function Shown() {
  if (runs.value.error)
    return (
      <p class="error" role="alert">
        {runs.value.error}
      </p>
    );
  if (!runs.value.value) return <p class="soft">Reading …</p>;
  if (episodeName.value) return <EpisodePage />;
  return part("of") === "head" ? <HeadPage /> : <Overview />;
}

/** The choice before or after this one, the mean before the first. */
function next(known: readonly number[] | undefined, now: number | "mean", by: number): number | "mean" {
  const all = ["mean" as const, ...(known ?? [])];
  return all[Math.max(0, Math.min(all.length - 1, all.indexOf(now) + by))]!;
}

addEventListener("keydown", (event) => {
  const on = event.target as HTMLElement;
  if (event.ctrlKey || event.metaKey || event.altKey || on.matches("input:not([type=range]), select, textarea")) return;
  if (!episodeName.value && !(part("of") && event.key === "Escape")) return; // a head's page is left, too
  const acts: Record<string, () => void> = {
    ArrowLeft: () => walk(-1),
    ArrowRight: () => walk(1),
    "[": () => setPart({ layer: next(axes.value?.layers, layer.value, -1) }),
    "]": () => setPart({ layer: next(axes.value?.layers, layer.value, 1) }),
    ",": () => setPart({ head: next(axes.value?.heads, head.value, -1) }),
    ".": () => setPart({ head: next(axes.value?.heads, head.value, 1) }),
    "-": () => setPart({ denoise: next(axes.value?.denoise_steps, denoise.value, -1) }),
    "+": () => setPart({ denoise: next(axes.value?.denoise_steps, denoise.value, 1) }),
    " ": () => (playing.value = !playing.value),
    Escape: closeEpisode,
  };
  const act = acts[event.key];
  if (!act || (event.key === " " && on.matches("button")) || (event.key.startsWith("Arrow") && on.matches("input[type=range]"))) return;
  event.preventDefault();
  act();
});

const page = document.getElementById("page")!;
render(<App />, page);
effect(() => {
  const line = run.value?.episodes.find(({ name }) => name === episodeName.value);
  const one = layer.value === "mean" || head.value === "mean" ? "one head" : `layer ${layer.value}, head ${head.value}`;
  const ofHead = part("of") === "head" ? `${one} · ${run.value?.name}` : run.value?.name;
  const shown = line ? `task ${line.task}, episode ${line.episode} · ${run.value!.name}` : ofHead;
  document.title = shown ? `${shown} · Attention` : "Attention";
});
// Who walks by keyboard goes on at the beginning of an episode, and behind it at the card that it was opened from; the list is
// where it was.
const shownNow = computed(() => episodeName.value || part("of"));
let [last, scrolled] = [shownNow.peek(), 0];
effect(() => {
  const [now, before] = [shownNow.value, last];
  last = now;
  if (now === before) return;
  if (!before) scrolled = scrollY;
  const top = now ? 0 : scrolled;
  requestAnimationFrame(() => {
    const card = now ? null : document.querySelector<HTMLElement>(`[data-episode="${CSS.escape(before)}"]`);
    (card ?? page).focus({ preventScroll: true });
    scrollTo(0, top);
  });
});

// For who waits until all is drawn: taken back at once, given when the browser has drawn.
const ready = computed(
  () =>
    !runs.value.pending &&
    (episodeName.value === "" ? headRead.value : main.ready.value && beside.ready.value && !reading.value && coming.value === 0),
);
const mark = (): void => {
  page.dataset.ready = ready.peek() ? "1" : "";
};
effect(() => void (ready.value ? requestAnimationFrame(mark) : mark()));
