/** Which head looks at something: layers x heads, for an object, the pictures, a word, or what was picked. */
import { computed, signal } from "@preact/signals";
import { address, type HeadLifts, readJson } from "./answers";
import { LayerMaps, NAMED } from "./head";
import {
  answered,
  axes,
  beside,
  cellsOf,
  head,
  layer,
  main,
  nameOf,
  part,
  picked,
  replan,
  runs,
  type Scene,
  type Side,
  setPart,
  sides,
  site,
  step,
} from "./state";
import { shown } from "./sums";

interface Target {
  readonly id: string;
  readonly name: string;
  readonly path: string;
}

const asked = (selector: string): string => `grid.json?${new URLSearchParams({ selector })}`;

/** What heads of an episode may look at; `id` is the same in the one beside it. */
function targetsOf(scene: Scene): readonly Target[] {
  const known = (scene.layout.value?.targets ?? []).map(({ name, selector }, i) => ({ id: selector, name, path: `grid/${i}.json` }));
  const keys = Object.entries(scene.layout.value?.cameras ?? {}).flatMap(([camera, how]) =>
    how.keys.filter((_, i) => cellsOf(scene, camera).includes(how.cells[i]!)),
  );
  const patches = keys.map((key) => `keys:${key}-${key}`).join(" | ");
  const { selector } = picked.value;
  if (runs.value.value?.copy) return known; // it answers no questions
  return [
    ...known,
    ...(patches ? [{ id: "patches", name: "the clicked patches", path: asked(patches) }] : []),
    ...(selector ? [{ id: selector, name: selector, path: asked(selector) }] : []),
  ];
}

/** What the link names: one of them, or another selector; `NAMED` is the first one that the sentence names. */
const target = computed<Target | null>(() => {
  const [known, id] = [targetsOf(main), part("target")];
  const given = known.find((one) => one.id === id);
  if (given || ["", NAMED, "patches"].includes(id)) return given ?? known[0] ?? null;
  return runs.value.value?.copy ? (known[0] ?? null) : { id, name: id, path: asked(id) };
});

const liftsOf = (scene: Scene) =>
  answered<HeadLifts>(() => {
    const id = target.value?.id;
    if (id === undefined || scene.about.value.value?.name !== scene.name.value) return null;
    const path = targetsOf(scene).find((one) => one.id === id)?.path ?? asked(id);
    return readJson<HeadLifts>(`${address.episode(scene.run.value, scene.name.value)}/${site.value}/${path}`);
  });
const lifts = new Map([main, beside].map((scene) => [scene, liftsOf(scene)]));

const known = ({ scene, at }: Side): number[] =>
  (lifts.get(scene)!.value.value?.lift[at] ?? []).flat().filter((one): one is number => one !== null);

function Grid({ side, highest }: { side: Side; highest: number }) {
  const { value: numbers, error } = lifts.get(side.scene)!.value;
  const grid = numbers?.lift[side.at];
  if (error)
    return (
      <p class="soft">
        {nameOf(side)} {error}
      </p>
    );
  if (!grid || !numbers) return null;
  const best = Math.max(...known(side));
  const place = grid.flatMap((line, i) => line.flatMap((one, j) => (one === best ? [[i, j] as const] : [])))[0];
  const has = runs.value.value?.copy?.heads !== false;
  const toggle = (own: number, ofHead: number | "mean"): void => {
    const same = layer.value === own && head.value === ofHead;
    setPart({ layer: same ? "mean" : own, head: same ? "mean" : ofHead });
  };
  return (
    <div>
      <p>
        {nameOf(side) ? `${nameOf(side)}: ` : ""}
        {place
          ? `most: layer ${numbers.layers[place[0]]}, head ${numbers.heads[place[1]]}, ${shown(best)} times even${best > 1 ? "" : ": no head looks more than evenly"}`
          : "none, it is out of sight in this call"}
      </p>
      <table>
        <tbody>
          {grid.map((line, i) => (
            <tr key={i}>
              <th scope="row">
                <button
                  disabled={!has}
                  aria-pressed={layer.value === numbers.layers[i] && head.value === "mean"}
                  aria-label={`layer ${numbers.layers[i]}`}
                  onClick={() => toggle(numbers.layers[i]!, "mean")}
                >
                  {numbers.layers[i]}
                </button>
              </th>
              {line.map((one, j) => {
                const about = `layer ${numbers.layers[i]}, head ${numbers.heads[j]}: ${shown(one)} times even`;
                return (
                  <td key={j}>
                    <button
                      disabled={!has}
                      aria-pressed={layer.value === numbers.layers[i] && head.value === numbers.heads[j]}
                      aria-label={about}
                      title={about}
                      class={place?.[0] === i && place[1] === j ? "best" : ""}
                      style={{ "--strength": Math.min(1, Math.max(0, (one ?? 0) / highest)).toFixed(3) }}
                      onClick={() => toggle(numbers.layers[i]!, numbers.heads[j]!)}
                    />
                  </td>
                );
              })}
            </tr>
          ))}
        </tbody>
      </table>
    </div>
  );
}

export function HeadGrid() {
  if (!target.value) return null;
  const highest = Math.max(4, ...sides.value.flatMap(known));
  return (
    <section class="heads" aria-label="Heads">
      <label>
        Which head looks at{" "}
        <select value={target.value.id} onChange={(event) => setPart({ target: event.currentTarget.value })}>
          {(targetsOf(main).includes(target.value) ? targetsOf(main) : [target.value, ...targetsOf(main)]).map(({ id, name }) => (
            <option value={id}>{name}</option>
          ))}
        </select>{" "}
        in this call?
      </label>
      <div class="grids">
        {sides.value.map((side) => (
          <Grid key={nameOf(side)} side={side} highest={highest} />
        ))}
      </div>
      <p class="soft">
        rows: layers; columns: heads; full colour: {shown(highest)} times even.{" "}
        {runs.value.value?.copy?.heads === false ? "" : "A click shows that head alone, or that layer."}
      </p>
      {runs.value.value?.copy || layer.value === "mean" ? null : <OfLayer />}
    </section>
  );
}

const opened = signal(false);

/** Further looks at the chosen layer and head. */
function OfLayer() {
  const named = target.value?.name.endsWith("(named)") || target.value?.id === "patches";
  return (
    <>
      <p>
        {axes.value?.pictured ? (
          <button aria-expanded={opened.value} onClick={() => (opened.value = !opened.value)}>
            all heads of layer {layer.value} in this call
          </button>
        ) : null}{" "}
        {head.value === "mean" ? null : (
          <button
            onClick={() =>
              step({
                episode: "",
                beside: "",
                group: "",
                without: "",
                step: "",
                replan: 0,
                denoise: "mean",
                of: "head",
                target: named ? NAMED : target.value!.id,
              })
            }
          >
            layer {layer.value}, head {head.value} in all episodes →
          </button>
        )}
      </p>
      {opened.value && axes.value?.pictured ? <LayerMaps name={main.name.value} replan={replan.value} /> : null}
    </>
  );
}
