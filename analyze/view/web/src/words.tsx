/** The instruction as a title: its words shaded by attention or by effect, and what is known of the picked one. */
import { computed } from "@preact/signals";

import { about, effectOfWord, effects, groupOf, massesAt, picked, replan, seed, setPart, shade, sizeOf, step, toggled, uniformAt, words } from "./state";
import { percent, shown, sumOf } from "./sums";

const once = (keys: readonly number[]): [number, number][] => keys.map((key) => [key, 1]);

/** Attention to a word for its number of tokens: times what even attention gives. */
function liftOf(keys: readonly number[], at: number): number {
  const [mass, even] = [massesAt(at), uniformAt(at)];
  return mass && even ? sumOf(mass, once(keys)) / sumOf(even, once(keys)) : NaN;
}

interface Shaded {
  readonly strength: number;
  /** Not more than another noise seed. */
  readonly none: boolean;
  readonly title: string;
}

const shades = computed<readonly Shaded[]>(() => {
  const values = words.value.map(({ text, keys }) => {
    const effect = effectOfWord(text);
    return { lift: liftOf(keys, replan.value), effect: sizeOf(effect), noise: sizeOf(seed.value) };
  });
  const of = (one: (typeof values)[0]): number => (shade.value === "attention" ? one.lift : one.effect);
  const highest = Math.max(shade.value === "attention" ? 4 : 0, ...values.map(of).filter(Number.isFinite));
  return values.map((one) => {
    const none = shade.value !== "attention" && !(of(one) > one.noise);
    const read = `attention per token: ${shown(one.lift)} times even`;
    const moved = Number.isFinite(one.effect) ? `; without it ${effects.value.value?.said.replace("{}", shown(one.effect))} (another noise seed: ${shown(one.noise)})` : "";
    return { strength: none || !Number.isFinite(of(one)) ? 0 : Math.max(0, of(one) / highest), none, title: `${read}${moved}` };
  });
});

/** Puts a word into the own group and takes it away, or undoes both. */
function toggle(place: number): void {
  const chosen = toggled(picked.value.words, place);
  const last = chosen.includes(place) ? place : chosen.at(-1);
  step({ group: groupOf({ words: chosen }), without: last === undefined ? "" : (effectOfWord(words.value[last]!.text)?.label ?? "") });
}

export function Title() {
  const episode = about.value.value;
  if (!episode) return null;
  const chosen = picked.value.words;
  return (
    <div class="title">
      <h1>
        {words.value.length ? words.value.map(({ text }, i) => (
          <button
            key={i} class={`word${shades.value[i]!.none ? " none" : ""}`} aria-pressed={chosen.includes(i)} title={shades.value[i]!.title}
            style={{ "--strength": shades.value[i]!.strength.toFixed(3) }} onClick={() => toggle(i)}
          >{text}</button>
        )) : episode.told}
      </h1>
      {shades.value.length && shades.value.every(({ none }) => none) ? <span class="soft">no word moves the action more than another noise seed does</span> : null}
      {effects.value.error ? <span class="soft">{effects.value.error}</span> : null}
    </div>
  );
}

const SHADES = { effect: "effect now", effects: "effect, whole episode", attention: "attention" } as const;

/** What the words are shaded by. */
export function ChooseShade() {
  if (!effects.value.value?.items.length) return <span class="soft">words shaded by attention per token</span>;
  return (
    <span class="shades" role="group" aria-label="Words shaded by">words by{" "}
      {Object.entries(SHADES).map(([name, title]) => <button key={name} class="chip" aria-pressed={shade.value === name} onClick={() => setPart({ words: name })}>{title}</button>)}
    </span>
  );
}

/** What the picked words get. */
export function AboutWords() {
  const chosen = picked.value.words.filter((i) => words.value[i]);
  const mass = massesAt(replan.value);
  if (!chosen.length) return null;
  return (
    <table class="numbers">
      <thead><tr><th>word</th><th>attention</th><th>per token</th></tr></thead>
      <tbody>
        {chosen.map((i) => {
          const { text, keys } = words.value[i]!;
          return <tr key={i}><th>{text}</th><td>{percent(mass && sumOf(mass, once(keys)))}</td><td>{shown(liftOf(keys, replan.value))} times even</td></tr>;
        })}
      </tbody>
    </table>
  );
}
