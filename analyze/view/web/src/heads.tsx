/** Which head looks at something: layers x heads, for an object, the pictures, a word, or what was picked. */
import { computed, signal } from "@preact/signals";

import { address, type HeadLifts, readJson } from "./answers";
import { about, answered, episodeName, head, layer, layout, picked, replan, runNumber, runs, setPart, site } from "./state";
import { shown } from "./sums";

const chosen = signal<string | null>(null);

const targets = computed(() => {
  const known = (layout.value?.targets ?? []).map((one, i) => ({ ...one, path: `grid/${i}.json` }));
  const asked = (name: string, selector: string) => ({ name, selector, path: `grid.json?${new URLSearchParams({ selector })}` });
  const { cells, selector } = picked.value;
  const keys = Object.entries(cells).flatMap(([camera, some]) => {
    const how = layout.value?.cameras[camera];
    return (how?.keys ?? []).filter((_, i) => some.includes(how!.cells[i]!));
  });
  const patches = keys.map((key) => `keys:${key}-${key}`).join(" | ");
  return [...known, ...(patches ? [asked("the clicked patches", patches)] : []), ...(selector ? [asked(selector, selector)] : [])];
});
const target = computed(() => targets.value.find(({ selector }) => selector === chosen.value) ?? targets.value[0] ?? null);

const lifts = answered<HeadLifts>(() => {
  const wanted = target.value;
  if (!wanted || about.value.value?.name !== episodeName.value) return null;
  return readJson<HeadLifts>(`${address.episode(runNumber.value, episodeName.value)}/${site.value}/${wanted.path}`);
});

export function HeadGrid() {
  const numbers = lifts.value.value;
  const grid = numbers?.lift[replan.value];
  if (!targets.value.length) return null;
  const known = (grid ?? []).flat().filter((one): one is number => one !== null);
  const highest = Math.max(4, ...known);
  const best = Math.max(...known);
  const place = grid?.flatMap((line, i) => line.flatMap((one, j) => (one === best ? [[i, j] as const] : [])))[0];
  const has = runs.value.value?.copy?.heads !== false;
  const toggle = (own: number, ofHead: number): void => {
    if (!has) return;
    const same = layer.value === own && head.value === ofHead;
    setPart({ layer: same ? "mean" : own, head: same ? "mean" : ofHead });
  };
  return (
    <section class="heads" aria-label="Heads">
      <label>Which head looks at{" "}
        <select value={target.value?.selector} onChange={(event) => (chosen.value = event.currentTarget.value)}>
          {targets.value.map(({ name, selector }) => <option value={selector}>{name}</option>)}
        </select>{" "}in this call?
      </label>
      {lifts.value.error ? <p class="soft">{lifts.value.error}</p> : null}
      {grid && numbers ? (
        <>
          {place ? <p>Most: layer {numbers.layers[place[0]]}, head {numbers.heads[place[1]]}, {shown(best)} times even.</p> : <p>None: it is out of sight in this call.</p>}
          <table>
            <tbody>
              {grid.map((line, i) => (
                <tr key={i}>
                  <th scope="row">{numbers.layers[i]}</th>
                  {line.map((one, j) => (
                    <td key={j}>
                      <button
                        disabled={!has} aria-pressed={layer.value === numbers.layers[i] && head.value === numbers.heads[j]} aria-label={`layer ${numbers.layers[i]}, head ${numbers.heads[j]}: ${shown(one)} times even`}
                        title={`layer ${numbers.layers[i]}, head ${numbers.heads[j]}: ${shown(one)} times even`} class={place?.[0] === i && place[1] === j ? "best" : ""}
                        style={{ "--strength": Math.min(1, Math.max(0, (one ?? 0) / highest)).toFixed(3) }} onClick={() => toggle(numbers.layers[i]!, numbers.heads[j]!)}
                      />
                    </td>
                  ))}
                </tr>
              ))}
            </tbody>
          </table>
          <p class="soft">rows: layers; columns: heads; strongest: {shown(highest)} times even. {has ? "A click shows that head alone." : ""}</p>
        </>
      ) : null}
    </section>
  );
}
