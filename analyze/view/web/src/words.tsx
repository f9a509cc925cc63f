/** The instruction as a title: its words shaded by what they do or by attention, and what is known of the picked ones. */
import { computed } from "@preact/signals";

import type { SiteLayout } from "./answers";
import { EffectsOfWords, effects, exchangesKnown, noise, ofWord, said, shade, strength } from "./effects";
import { Hint } from "./hint";
import { about, groupOf, layout, massesAt, OTHER_SITE, picked, replan, setPart, site, step, toggled, uniformAt, words } from "./state";
import { percent, shown, sumOf } from "./sums";

const once = (keys: readonly number[]): [number, number][] => keys.map((key) => [key, 1]);

/** Attention to a word for its number of tokens: times what even attention gives. */
function liftOf(keys: readonly number[], at: number): number {
  const [mass, even] = [massesAt(at), uniformAt(at)];
  return mass && even ? sumOf(mass, once(keys)) / sumOf(even, once(keys)) : NaN;
}

interface Shaded {
  /** Of the colour, and of the line below, 0 to 1. */
  readonly colour: number;
  readonly line: number;
  /** Tried, and not more than another noise seed. */
  readonly none: boolean;
  readonly title: string;
}

/** Words are coloured by what another word in their place does, and a line says what leaving them out does; where none was
 * exchanged, that is the colour. */
const shades = computed<readonly Shaded[]>(() => {
  const lifts = words.value.map(({ keys }) => liftOf(keys, replan.value));
  const highest = Math.max(4, ...lifts.filter(Number.isFinite));
  return words.value.map(({ text }, i) => {
    const { removed, exchanged, others } = ofWord(text);
    const lift = lifts[i]!;
    const title = [
      `attention per token: ${shown(lift)} times even`,
      said(exchanged) && `as ${others}: ${said(exchanged)}`,
      said(removed) && `left out: ${said(removed)}`,
      said([...exchanged, ...removed]) && said(noise.value) && `another noise seed: ${said(noise.value)}`,
    ];
    const own = { title: title.filter(Boolean).join("; "), none: false, line: 0 };
    if (shade.value === "attention") return { ...own, colour: Math.max(0, (lift || 0) / highest) };
    const line = exchangesKnown.value ? strength(removed) : 0;
    const colour = strength(exchangesKnown.value ? exchanged : removed);
    return { ...own, line, colour, none: !colour && !line && [...removed, ...exchanged].some(Number.isFinite) };
  });
});

/** Puts a word into the own group and takes it away, or undoes both. */
function toggle(place: number): void {
  const chosen = toggled(picked.value.words, place);
  const last = chosen.includes(place) ? place : chosen.at(-1);
  step({ group: groupOf({ words: chosen }), without: last === undefined ? "" : ofWord(words.value[last]!.text).label });
}

/** A sentence in pieces: its words with their places, and what stands between them (signs, emoji). Where it does not hold all
 * of the words in their order, the words alone. */
export function piecesOf(sentence: string, texts: readonly string[]): readonly { text: string; place: number | null }[] {
  const pieces: { text: string; place: number | null }[] = [];
  let at = 0;
  for (const [place, text] of texts.entries()) {
    const begin = at + sentence.slice(at).search(new RegExp(text.replace(/[\\^$.*+?()[\]{}|/]/g, "\\$&"), "iu"));
    if (begin < at) return texts.map((word, i) => ({ text: word, place: i }));
    if (sentence.slice(at, begin).trim()) pieces.push({ text: sentence.slice(at, begin).trim(), place: null });
    pieces.push({ text: sentence.slice(begin, begin + text.length), place });
    at = begin + text.length;
  }
  if (sentence.slice(at).trim()) pieces.push({ text: sentence.slice(at).trim(), place: null });
  return pieces;
}

/** The site that has words, where the shown one has none. */
const spelled = computed(() => {
  const sites = Object.entries(about.value.value?.sites ?? {});
  const has = ({ prompts }: SiteLayout): boolean => prompts.some(({ words: some }) => some.length > 0);
  return layout.value && !has(layout.value) ? (sites.find(([, of]) => has(of))?.[0] ?? "") : null;
});

export function Title() {
  const episode = about.value.value;
  if (!episode) return null;
  const chosen = picked.value.words;
  return (
    <div class="title">
      <h1 dir="auto">
        {words.value.length
          ? piecesOf(
              episode.told,
              words.value.map(({ text }) => text),
            ).map(({ text, place }, at) => {
              if (place === null) return <span key={`${at}`}>{text} </span>;
              const { colour, line, none, title } = shades.value[place]!;
              return (
                <button
                  key={`${at}`}
                  class={`word${none ? " none" : ""}`}
                  aria-pressed={chosen.includes(place)}
                  title={title}
                  style={{ "--strength": colour.toFixed(3), "--line": line.toFixed(3) }}
                  onClick={() => toggle(place)}
                >
                  {text}
                </button>
              );
            })
          : episode.told}
      </h1>
      {spelled.value === null ? null : (
        <span class="soft">
          site {site.value} reads no words{" "}
          {spelled.value ? (
            <button onClick={() => setPart({ ...OTHER_SITE, site: spelled.value! })}>show site {spelled.value}</button>
          ) : null}
        </span>
      )}
      {shades.value.length && shades.value.every(({ none }) => none) ? (
        <span class="soft">no word moves the action more than another noise seed does</span>
      ) : null}
      {shade.value === "effect" && noise.value.length && !noise.value.some(Number.isFinite) ? (
        <span class="soft">no effects were recorded at this call</span>
      ) : null}
      {effects.value.error ? <span class="soft">{effects.value.error}</span> : null}
    </div>
  );
}

const SHADES = { effect: "effect now", effects: "effect, whole episode", attention: "attention" } as const;
const HINTS = {
  exchanged:
    "Colour: how far the action moves with another word in its place. Line below: with the word left out, an input that the policy never saw. Dotted: tried, and no more than another noise seed.",
  removed:
    "Colour: how far the action moves with the word left out, an input that the policy never saw; no exchange was recorded. Dotted: tried, and no more than another noise seed.",
};

/** What the words are shaded by. */
export function ChooseShade() {
  const known = effects.value.value;
  if (!known?.items.length) return <span class="soft">words coloured by attention per token</span>;
  const full = known.parts.flatMap((one) =>
    one.full === null ? [] : [one.said.replace("{}", one.share ? percent(one.full) : shown(one.full))],
  );
  const scale = full.length ? ` Full: ${full.join(", or ")}.` : "";
  return (
    <fieldset class="shades" aria-label="Words coloured by">
      words coloured by{" "}
      {Object.entries(SHADES).map(([name, title]) => (
        <button key={name} class="chip" aria-pressed={shade.value === name} onClick={() => setPart({ words: name })}>
          {title}
        </button>
      ))}
      <Hint text={`${exchangesKnown.value ? HINTS.exchanged : HINTS.removed}${scale}`} />
    </fieldset>
  );
}

/** What the picked words get, and what they do. */
export function AboutWords() {
  const chosen = picked.value.words.filter((i) => words.value[i]);
  const mass = massesAt(replan.value);
  if (!chosen.length) return null;
  return (
    <section class="about-words" aria-label="Picked words">
      <table class="numbers">
        <thead>
          <tr>
            <th>word</th>
            <th>attention</th>
            <th>per token</th>
          </tr>
        </thead>
        <tbody>
          {chosen.map((i) => {
            const { text, keys } = words.value[i]!;
            return (
              <tr key={i}>
                <th>
                  <bdi>{text}</bdi>
                </th>
                <td>{percent(mass && sumOf(mass, once(keys)))}</td>
                <td>{shown(liftOf(keys, replan.value))} times even</td>
              </tr>
            );
          })}
        </tbody>
      </table>
      <EffectsOfWords texts={chosen.map((i) => words.value[i]!.text)} />
    </section>
  );
}
