/** What moves the action when it is taken away or exchanged: words, parts of the prompt, pictures, objects. */
import { signal } from "@preact/signals";

import type { Effect } from "./answers";
import { Hint } from "./hint";
import { effects, part, ranked, replan, seed, step, taken } from "./state";
import { percent, shown } from "./sums";

/** As "without red cube", "'red' as 'blue'". */
export const described = (effect: Effect): string => `${effect.kind === "without" ? "without " : ""}${effect.label}`;

const FIRST_ROWS = 8;
const all = signal(false);

/** All that was tried, the largest effect first, and another noise seed in its place. A click takes it away: `Actions`. */
export function EffectTable() {
  const rows = ranked.value;
  if (!rows.length) return null;
  const [main, ...further] = effects.value.value!.parts;
  const place = seed.value ? rows.indexOf(seed.value) : rows.length;
  return (
    <section class="effects" aria-label="Effects">
      <h2>What moves the action<Hint text="How far the action moves when nobody reads it any more (where that was not tried: when the action queries do not), or with the other word or picture; means over the policy calls of this episode. What stands below another noise seed does not count. Effects do not add up." /></h2>
      <table class="numbers">
        <thead><tr><th>taken away or exchanged</th><th>this call: {main!.title}</th><th>episode: {main!.title}</th>{further.map(({ name, title }) => <th key={name}>{title}</th>)}<th>calls</th></tr></thead>
        <tbody>
          {rows.map((one, i) => all.value || i < FIRST_ROWS || one === taken.value ? (
            <tr key={one.number} class={i < place ? "" : "soft"}>
              <th>{one === seed.value ? one.label : <button aria-pressed={taken.value === one} onClick={() => step({ without: taken.value === one ? "" : one.label })}>{one.label}</button>}</th>
              <td data-number={`effect-${one.label}`} data-value={one.effect[replan.value]}>{shown(one.effect[replan.value])}</td><td>{shown(one.mean)}</td>{further.map(({ name, share: isShare }, k) => <td key={name}>{isShare ? percent(one.further[k]) : shown(one.further[k])}</td>)}<td>{one.effect.filter((value) => value !== null).length}</td>
            </tr>
          ) : null)}
        </tbody>
      </table>
      {rows.length > FIRST_ROWS ? <button onClick={() => (all.value = !all.value)}>{all.value ? "fewer" : `${rows.length - FIRST_ROWS} more`}</button> : null}
      {effects.value.value!.notes.map((note) => <p class="soft" key={note}>{note}</p>)}
      {part("without") ? null : <span class="soft"> Click one: the actions without it are drawn below.</span>}
    </section>
  );
}
