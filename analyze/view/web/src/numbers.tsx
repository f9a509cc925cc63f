/** Numbers of this replan: the ratio, the parts of the attention, and the own group of clicked patches and words. */
import { useState } from "preact/hooks";

import { Hint } from "./hint";
import {
  evenOf,
  groupOf,
  groups,
  layer,
  layerPlace,
  layout,
  main,
  massesOf,
  nameOf,
  picked,
  pickedKeys,
  replan,
  runs,
  type Side,
  sides,
  site,
  step,
  words,
  wordsOf,
} from "./state";
import { percent, range, shown, sumOf } from "./sums";

export function Ratio() {
  const numbers = groups.value.value;
  if (groups.value.error) return <p class="soft">{groups.value.error}</p>;
  if (!numbers) return null;
  const at = (grid: typeof numbers.ratio): number | null => grid?.[replan.value]?.[layerPlace(numbers)] ?? null;
  const parts = Object.entries(numbers.groups)
    .map(([name, of]) => ({
      name,
      color: of.color,
      fraction: at(of.fraction) ?? 0,
      mass: at(of.mass),
      keys: at(of.keys),
      lift: at(of.lift),
    }))
    .filter(({ keys }) => (keys ?? 0) > 0);
  const missing = [
    ["visual", "picture"],
    ["linguistic", "text"],
  ].flatMap(([name, said]) => (parts.some((one) => one.name === name) ? [] : [said!]));
  return (
    <section class="ratio" aria-label="Attention in this call">
      {numbers.sides ? null : (
        <p class="soft">
          No ratio at site {site.value}:{" "}
          {missing.length ? `there is no ${missing.join(" and no ")} among its tokens.` : "pictures and text are not both read here."}
        </p>
      )}
      {numbers.sides ? (
        <p>
          {nameOf(sides.value[0]!) ? `${nameOf(sides.value[0]!)}: ` : ""}
          <b class="figure" data-number="ratio" data-value={at(numbers.ratio)}>
            {shown(at(numbers.ratio))}
          </b>{" "}
          pictures / text{layer.value === "mean" ? ` (geometric mean of ${numbers.layers.length - 1} layers)` : ""}{" "}
          <span class="soft">
            an even spread gives{" "}
            <span data-number="uniform" data-value={at(numbers.uniform_ratio)}>
              {shown(at(numbers.uniform_ratio))}
            </span>
            : this is{" "}
            <span data-number="lift" data-value={at(numbers.ratio_lift)}>
              {shown(at(numbers.ratio_lift))}
            </span>{" "}
            times that
          </span>
          <Hint text="Where the attention of the action queries went. It does not show what the policy used, and not why it acted: the effect of a word does. Of several layers the ratio is the geometric mean of theirs, not the quotient of the mean parts below." />
        </p>
      ) : null}
      <div class="bar" role="img" aria-label={parts.map(({ name, fraction }) => `${name} ${percent(fraction)}`).join(", ")}>
        {parts.map(({ name, color, fraction }) => (
          <span key={name} class="part" style={{ flexGrow: String(fraction), background: color }} title={`${name}: ${percent(fraction)}`} />
        ))}
      </div>
      <table class="numbers">
        <thead>
          <tr>
            <td />
            <th>tokens</th>
            <th>attention</th>
            <th>times even</th>
          </tr>
        </thead>
        <tbody>
          {parts.map(({ name, color, mass, keys, lift }) => (
            <tr key={name} data-group={name}>
              <th>
                <span class="dot" style={{ background: color }} />
                {name}
              </th>
              <td>{shown(keys)}</td>
              <td data-number={`mass-${name}`} data-value={mass}>
                {percent(mass)}
              </td>
              <td>{shown(lift)}</td>
            </tr>
          ))}
        </tbody>
      </table>
    </section>
  );
}

/** What the own group gets in an episode, and its ratio. */
function OwnNumbers({ side }: { side: Side }) {
  const { scene, at } = side;
  const [mass, even] = [massesOf(scene, at), evenOf(scene, at)];
  if (scene.typed.value.error)
    return (
      <p class="error" role="alert">
        {scene.typed.value.error}
      </p>
    );
  if (!mass || !even) return <p class="soft">reading …</p>;
  const { seen, read } = pickedKeys(side);
  const ratio = seen.size && read.size ? [sumOf(mass, seen) / sumOf(mass, read), sumOf(even, seen) / sumOf(even, read)] : null;
  const told = picked.value.words.map((place) => wordsOf(side)[place]?.text).join(" ");
  return (
    <>
      <table class="numbers">
        <thead>
          <tr>
            <td>{nameOf(side)}</td>
            <th>tokens</th>
            <th>attention</th>
            <th>times even</th>
          </tr>
        </thead>
        <tbody>
          {(
            [
              ["patches", seen, ""],
              ["words", read, told],
            ] as const
          ).map(([name, keys, which]) =>
            keys.size ? (
              <tr key={name}>
                <th>
                  {name} <span class="soft">{which}</span>
                </th>
                <td>{keys.size}</td>
                <td data-number={`own-${name}`} data-value={sumOf(mass, keys)}>
                  {percent(sumOf(mass, keys))}
                </td>
                <td>{shown(sumOf(mass, keys) / sumOf(even, keys))}</td>
              </tr>
            ) : null,
          )}
        </tbody>
      </table>
      {ratio ? (
        <p>
          <b class="figure" data-number="own-ratio">
            {shown(ratio[0])}
          </b>{" "}
          patches / words (of the sums){" "}
          <span class="soft">
            an even spread gives {shown(ratio[1])}: this is {shown(ratio[0]! / ratio[1]!)} times that
          </span>
        </p>
      ) : null}
    </>
  );
}

/** Patches and words that were clicked, what they get, and their ratio. */
export function OwnGroup() {
  const isCopy = runs.value.value?.copy !== undefined;
  const [text, setText] = useState(picked.value.selector);
  const { seen, read } = pickedKeys({ scene: main, at: replan.value });
  const any = picked.value.selector || seen.size + read.size > 0;
  const allWords = range(words.value.length);
  const whole = Object.fromEntries(
    Object.entries(layout.value?.cameras ?? {}).map(([camera, { rows, columns }]) => [camera, range(rows * columns)]),
  );
  return (
    <section class="own" aria-label="Own group">
      <h2>Own group</h2>
      {any ? null : (
        <p class="soft">
          Click patches in the pictures and words in the title, or type a selector.
          <Hint text="camera:NAME, object:NAME, word:bowl, role:image, patch:CAMERA[r0:r1,c0:c1], joined by |, & and -" />
        </p>
      )}
      {any ? sides.value.map((side) => <OwnNumbers key={nameOf(side)} side={side} />) : null}
      {seen.size && !read.size && words.value.length ? (
        <p>
          <button onClick={() => step({ group: groupOf({ words: allWords }) })}>Ratio to the whole instruction</button>
        </p>
      ) : null}
      {read.size && !seen.size && Object.keys(whole).length ? (
        <p>
          <button onClick={() => step({ group: groupOf({ cells: whole }) })}>Ratio of all pictures to these words</button>
        </p>
      ) : null}
      <form
        onSubmit={(event) => {
          event.preventDefault();
          step({ group: groupOf({ selector: text.trim() }) });
        }}
      >
        <input
          aria-label="Selector"
          disabled={isCopy}
          placeholder={isCopy ? "a typed selector needs vla-attention view" : "object:red_cube | patch:…"}
          value={text}
          onInput={(event) => setText(event.currentTarget.value)}
        />
        <button disabled={isCopy}>Add</button>
        {any ? (
          <button
            type="button"
            onClick={() => {
              setText("");
              step({ group: "", without: "" });
            }}
          >
            Clear
          </button>
        ) : null}
      </form>
    </section>
  );
}
