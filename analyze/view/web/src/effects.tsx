/** What moves the action when it is taken away or exchanged: words, parts of the prompt, pictures, objects. */
import { computed, signal } from "@preact/signals";

import { address, type Effect, type EffectPart, type Effects, readJson } from "./answers";
import { Hint } from "./hint";
import { answered, beside, main, nameOf, part, replan, type Scene, type Side, sides, step } from "./state";
import { meanOf, percent, shown, strengthOf } from "./sums";

const read = (scene: Scene) =>
  answered<Effects | null>(() => {
    const { value: about } = scene.about.value;
    if (!about?.effects || about.name !== scene.name.value) return null;
    const known = readJson<Effects | null>(`${address.episode(scene.run.value, scene.name.value)}/effects.json`);
    return known.then((all) => (triedOf(all).size ? all : null)); // a run of maps alone tried nothing by name
  });
export const effects = read(main);
const besideEffects = read(beside);
export const reading = computed(() => effects.value.pending || besideEffects.value.pending);

const CHANGES = ["without", "prompt", "image"];

/** What was taken away or exchanged, by name: read by nobody, or where that was not tried, not by the action queries. */
function triedOf(known: Effects | null): Map<string, Effect> {
  const found = new Map<string, Effect>();
  for (const reader of [null, "direct", "total"])
    for (const one of known?.items ?? []) if (one.reader === reader && CHANGES.includes(one.kind)) found.set(one.label, one);
  return found;
}

/** The same and another noise seed, which no item is. */
const listOf = (known: Effects | null): Map<string, Effect> => {
  const [found, seed] = [triedOf(known), known?.items.find(({ kind }) => kind === "noise")];
  return seed && found.size ? found.set(seed.label, seed) : found;
};
const tried = computed(() => triedOf(effects.value.value));
const seed = computed(() => effects.value.value?.items.find(({ kind }) => kind === "noise") ?? null);

/** What words are shaded by: attention, effect (of this replan), effects (over the episode); the effect where it was recorded. */
export const shade = computed<"attention" | "effect" | "effects">(() => {
  const given = part("words");
  if (given === "attention" || !effects.value.value?.items.length) return "attention";
  return given === "effects" ? "effects" : "effect";
});

/** How far the action moves, (part): at this replan, or over the episode where that is what words are shaded by. */
const sizesOf = (one: Effect): number[] =>
  (shade.value === "effects" ? one.mean : one.effect.map((line) => line[replan.value])).map((size) => size ?? NaN);

/** What is taken away: the changed actions are drawn beside the executed ones. */
export const taken = computed<Effect | null>(() => tried.value.get(part("without")) ?? null);

/** What the action does without a word, and with another one in its place: (part) each, empty where that was not tried. */
export interface OfWord {
  readonly removed: readonly number[];
  readonly exchanged: readonly number[];
  /** The others, as "'blue' or 'green'", of which it is the mean; and each by itself. */
  readonly others: string;
  readonly each: readonly { label: string; sizes: readonly number[] }[];
  /** What names the largest exchange, or its removal. */
  readonly label: string;
}

/** The effects of a word; they name words in lower case. Of several words in its place their mean. */
export function ofWord(text: string): OfWord {
  const own = [...tried.value.values()].filter(({ item }) => item === text.toLowerCase());
  const [without] = own.filter(({ kind, item_kind }) => kind === "without" && item_kind === "word");
  const exchanges = own.filter(({ kind, item_kind }) => kind === "prompt" && item_kind === "exchange");
  const each = exchanges.map((one) => ({ label: one.label, sizes: sizesOf(one) })).sort((a, b) => (b.sizes[0] || 0) - (a.sizes[0] || 0));
  const others = exchanges.map(({ instead }) => `'${instead}'`).join(" or ");
  const label = each[0]?.label ?? without?.label ?? "";
  return { removed: without ? sizesOf(without) : [], exchanged: meanOf(each.map(({ sizes }) => sizes)), others, each, label };
}

/** Whether words were exchanged: then that is what colours them. */
export const exchangesKnown = computed(() => [...tried.value.values()].some(({ item_kind }) => item_kind === "exchange"));

/** Another noise seed's, (part). */
export const noise = computed(() => (seed.value ? sizesOf(seed.value) : []));

/** What fills a word with colour, (part): of other units than centimetres, degrees and gripper the largest of the episode. */
const full = computed(() =>
  (effects.value.value?.parts ?? []).map((one, i) => {
    const sizes = [...tried.value.values()].flatMap(({ effect }) => effect[i]!.map((size) => size ?? 0));
    return one.full ?? Math.max(4 * (seed.value?.mean[i] || 0), ...sizes, 1e-9);
  }),
);

/** How strongly a word is coloured by what it does. */
export const strength = (sizes: readonly number[]): number => strengthOf(sizes, noise.value, full.value);

/** A size in words; below what Python takes for rounding (`ROUNDING` of analyze/core/action_changes.py) it is no number. */
const written = ({ share }: EffectPart, size: number | null | undefined): string =>
  share ? percent(size) : size != null && size < 0.001 ? "< 0.001" : shown(size);

/** What the action does, in words: "the hand ends 7.9 cm elsewhere, the hand is turned by 84 degrees". */
export const said = (sizes: readonly number[]): string =>
  (effects.value.value?.parts ?? [])
    .map((one, i) => (Number.isFinite(sizes[i]) ? one.said.replace("{}", written(one, sizes[i])) : ""))
    .filter(Boolean)
    .join(", ");

/** The effects of picked words beside another noise seed's, a row for each. */
export function EffectsOfWords({ texts }: { texts: readonly string[] }) {
  const parts = effects.value.value?.parts ?? [];
  const rows = [...new Set(texts)].flatMap((text) => {
    const { removed, each } = ofWord(text);
    const left = removed.length ? [[`'${text}' left out`, removed] as const] : [];
    return [...each.map(({ label, sizes }) => [label, sizes] as const), ...left];
  });
  if (!rows.length) return null;
  return (
    <table class="numbers">
      <thead>
        <tr>
          <th>{shade.value === "effects" ? "whole episode" : "this call"}</th>
          {parts.map(({ name, title }) => (
            <th key={name}>{title}</th>
          ))}
        </tr>
      </thead>
      <tbody>
        {[...rows, ...(seed.value ? [[seed.value.label, noise.value] as const] : [])].map(([name, sizes]) => (
          <tr key={name}>
            <th>{name}</th>
            {parts.map((one, i) => (
              <td key={one.name}>{written(one, sizes[i])}</td>
            ))}
          </tr>
        ))}
      </tbody>
    </table>
  );
}

/** As "without red cube", "'red' as 'blue'". */
export const described = (effect: Effect): string => `${effect.kind === "without" ? "without " : ""}${effect.label}`;

interface Told {
  readonly side: Side;
  readonly effects: Effects;
  readonly items: Map<string, Effect>;
}

const FIRST_ROWS = 8;
const all = signal(false);

/** All that was tried in one episode or both, the largest effect first, and another noise seed in its place. A click takes it
 * away: `Actions`. */
export function EffectTable() {
  const each = sides.value.flatMap((side): Told[] => {
    const known = (side.scene === main ? effects : besideEffects).value.value;
    return known?.items.length ? [{ side, effects: known, items: listOf(known) }] : [];
  });
  const first = each[0];
  if (!first) return null;
  const union = new Map(each.flatMap(({ items }) => [...items]).reverse());
  const sizeOf = (label: string): number => {
    const of = each.find(({ items }) => items.has(label))!;
    const one = of.items.get(label)!;
    return (shade.value === "effects" ? one.mean[0] : one.effect[0]![of.side.at]) ?? 0;
  };
  const rows = [...union.values()].sort((a, b) => sizeOf(b.label) - sizeOf(a.label));
  const place = rows.findIndex(({ kind }) => kind === "noise");
  const callsOf = ({ items }: Told): string => {
    const counts = [...items.values()].map(({ effect }) => effect[0]!.filter((value) => value !== null).length);
    const [fewest, most] = [Math.min(...counts), Math.max(...counts)];
    return `episode (${fewest < most ? `${fewest} to ` : ""}${most} ${most === 1 ? "call" : "calls"})`;
  };
  const further = each.length === 1 ? first.effects.parts.slice(1) : [];
  return (
    <section class="effects" aria-label="Effects">
      <h2>
        What moves the action
        <Hint text="How far the action moves when nobody reads it any more (where that was not tried: when the action queries do not), or with the other word or picture; in the episode, the mean over its policy calls with effects. What stands below another noise seed does not count. Effects do not add up." />
      </h2>
      <table class="numbers">
        <thead>
          <tr>
            <th rowSpan={2}>taken away or exchanged</th>
            {each.map(({ side, effects: { parts } }) => (
              <th key={nameOf(side)} colSpan={2}>
                {nameOf(side)} {parts[0]!.title}
              </th>
            ))}
            {further.map(({ name, title }) => (
              <th key={name}>{title}</th>
            ))}
          </tr>
          <tr>
            {each.flatMap((told) => [
              <th key={`now ${nameOf(told.side)}`}>this call</th>,
              <th key={`all ${nameOf(told.side)}`}>{callsOf(told)}</th>,
            ])}
            {further.map(({ name }) => (
              <th key={name}>{callsOf(first)}</th>
            ))}
          </tr>
        </thead>
        <tbody>
          {rows.map((one, i) =>
            all.value || i < FIRST_ROWS || one === taken.value ? (
              <tr key={one.number} class={place < 0 || i < place ? "" : "soft"}>
                <th>
                  {one.kind === "noise" || !tried.value.has(one.label) ? (
                    one.label
                  ) : (
                    <button aria-pressed={taken.value === one} onClick={() => step({ without: taken.value === one ? "" : one.label })}>
                      {one.label}
                    </button>
                  )}
                </th>
                {each.flatMap(({ side, items, effects: { parts } }) => {
                  const [own, of] = [items.get(one.label), parts[0]!];
                  const now = own?.effect[0]?.[side.at];
                  return [
                    <td key={`now ${nameOf(side)}`} data-number={side.scene === main ? `effect-${one.label}` : undefined} data-value={now}>
                      {written(of, now)}
                    </td>,
                    <td key={`all ${nameOf(side)}`}>{written(of, own?.mean[0])}</td>,
                  ];
                })}
                {further.map((of, k) => (
                  <td key={of.name}>{written(of, one.mean[k + 1])}</td>
                ))}
              </tr>
            ) : null,
          )}
        </tbody>
      </table>
      {rows.length > FIRST_ROWS ? (
        <button onClick={() => (all.value = !all.value)}>{all.value ? "fewer" : `${rows.length - FIRST_ROWS} more`}</button>
      ) : null}
      {[...new Set(each.flatMap(({ effects: { notes } }) => notes))].map((note) => (
        <p class="soft" key={note}>
          {note}
        </p>
      ))}
      {part("without") || !tried.value.size ? null : <span class="soft"> Click one: the actions of that call are drawn below.</span>}
    </section>
  );
}
