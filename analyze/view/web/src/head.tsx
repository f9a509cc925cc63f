/** One head over all episodes and policy calls of a run, beside its layer; and small maps of all heads of a layer. */
import { computed, effect, signal } from "@preact/signals";
import { useLayoutEffect, useState } from "preact/hooks";

import { address, type CallMaps, type HeadsOfRun, NEEDS_SERVER, pictureAt, readJson } from "./answers";
import { kindOf, mark } from "./overview";
import { coming, Strokes } from "./pictures";
import { axes, closeEpisode, head, layer, OTHER_SITE, part, run, runNumber, runs, setPart, site, step } from "./state";
import { meanOf, outline, shown } from "./sums";

/** Lines of small maps stand at so many times even attention, whatever the episode reaches. */
const LEVELS = { first: 2, second: 10 } as const;
/** What stands for the objects that each episode's own sentence names. */
export const NAMED = "named";
const FIRST_CALLS = 24;

interface Found {
  readonly heads: readonly number[];
  readonly episodes: HeadsOfRun["episodes"];
  readonly failed: readonly string[];
  /** Episodes that were asked for. */
  readonly read: number;
  readonly error: string | null;
}

const target = computed(() => part("target") || (axes.value?.pictured === false ? "role:instruction" : NAMED));
const found = signal<Found | null>(null);
effect(() => {
  found.value = null;
  if (part("of") !== "head" || part("episode") || !run.value || layer.value === "mean" || runs.value.value?.copy) return;
  const [ofRun, total] = [runNumber.value, run.value.episodes.length];
  const asked = { site: site.value, layer: `${layer.value}`, selector: target.value };
  let live = true;
  const read = async (): Promise<void> => {
    const episodes: HeadsOfRun["episodes"][number][] = [];
    const failed: string[] = [];
    for (let first: number | null = 0; live && first !== null; ) {
      const answer: HeadsOfRun = await readJson(`runs/${ofRun}/heads.json?${new URLSearchParams({ ...asked, first: `${first}` })}`);
      episodes.push(...answer.episodes);
      failed.push(...answer.failed);
      first = answer.next;
      if (live) found.value = { heads: answer.heads, episodes: [...episodes], failed, read: first ?? total, error: null };
    }
  };
  read().catch((error: Error) => {
    if (live) found.value = { heads: [], episodes: [], failed: [], read: 0, error: error.message };
  });
  return () => {
    live = false;
  };
});
export const headRead = computed(
  () =>
    part("of") !== "head" ||
    layer.value === "mean" ||
    runs.value.value?.copy !== undefined ||
    (found.value !== null && (found.value.error !== null || found.value.read === run.value?.episodes.length)),
);

interface Call {
  readonly episode: string;
  readonly replan: number;
  readonly lift: number;
  readonly layer: number;
}

const least = signal(false);
const place = computed(() => found.value?.heads.indexOf(head.value as number) ?? -1);
const calls = computed<readonly Call[]>(() => {
  const all = (found.value?.episodes ?? []).flatMap(({ name, lift, layer: ofLayer }) =>
    lift.flatMap((line, replan) => {
      const one = line[place.value];
      return one == null ? [] : [{ episode: name, replan, lift: one, layer: ofLayer[replan]! }];
    }),
  );
  return all.sort((a, b) => (least.value ? a.lift - b.lift : b.lift - a.lift));
});

/** Means over episodes of their means over calls, (head), and last the layer's. */
const averages = computed(() =>
  meanOf(
    (found.value?.episodes ?? []).map(({ lift, layer: ofLayer }) =>
      meanOf(lift.map((line, at) => [...line, ofLayer[at]!].map((one) => one ?? NaN))),
    ),
  ),
);

/** A picture with lines around what a head looks at, and around the named objects. */
function Thumbnail({
  name,
  replan,
  camera,
  maps,
  ofHead,
}: {
  name: string;
  replan: number;
  camera: string;
  maps: CallMaps;
  ofHead: number;
}) {
  const how = maps[camera]!;
  const lift = how.lift[ofHead]!;
  return (
    <span class="stack">
      {how.stored ? (
        <img src={pictureAt(address.picture(runNumber.value, name, camera, replan))} alt="" loading="lazy" />
      ) : (
        <span class="grey" />
      )}
      <svg viewBox={`0 0 ${how.columns} ${how.rows}`} preserveAspectRatio="none" aria-hidden="true">
        {(["first", "second"] as const).map((kind) => (
          <Strokes key={kind} kind={kind} path={outline(how, (cell) => (lift[cell] ?? 0) >= LEVELS[kind])} />
        ))}
        <Strokes kind="named" path={outline(how, (cell) => how.named.includes(cell))} />
      </svg>
    </span>
  );
}

/** The maps of a layer's heads in a call, once they are there. */
function useMaps(name: string, replan: number): CallMaps | string | null {
  const at = `${address.episode(runNumber.value, name)}/${site.value}/call/${layer.value}/${replan}.json`;
  const [maps, setMaps] = useState<readonly [string, CallMaps | string] | null>(null);
  useLayoutEffect(() => {
    coming.value++;
    const read = readJson<CallMaps>(at).then(
      (maps) => setMaps([at, maps]),
      (error: Error) => setMaps([at, error.message]),
    );
    void read.finally(() => coming.value--);
  }, [at]);
  return maps?.[0] === at ? maps[1] : null;
}

function CallCard({ call: { episode, replan, lift, layer: ofLayer } }: { call: Call }) {
  const maps = useMaps(episode, replan);
  const line = run.value!.episodes.find(({ name }) => name === episode)!;
  return (
    <button class={`card ${kindOf(line)}`} title={line.verdict} onClick={() => step({ episode, replan })}>
      <span class="thumbnails">
        {maps === null ? (
          <span class="no-picture">…</span>
        ) : typeof maps === "string" ? (
          maps
        ) : !Object.keys(maps).length && line.picture ? (
          <img src={pictureAt(address.picture(runNumber.value, episode, line.picture[0], replan))} alt="" loading="lazy" />
        ) : (
          Object.keys(maps).map((camera) => (
            <Thumbnail key={camera} name={episode} replan={replan} camera={camera} maps={maps} ofHead={place.value} />
          ))
        )}
      </span>
      <span class="about">
        <b>{shown(lift)} × even</b> <span class="soft">layer: {shown(ofLayer)}</span>
        <span>
          {mark(line)} task {line.task}, {line.scene == null ? `episode ${line.episode}` : `scene ${line.scene}`}, call {replan}
        </span>
      </span>
    </button>
  );
}

/** Named objects, pictures, the instruction, every word of the run's sentences, as far as the site has them; and what the link
 * has. */
const targets = computed<Record<string, string>>(() => {
  const { pictured, spelled } = axes.value ?? { pictured: true, spelled: true };
  const told = (run.value?.episodes ?? []).flatMap((line) => (line.told ?? "").toLowerCase().split(/[^\p{L}\p{M}\p{N}'’-]+/u));
  const words = [...new Set(told.filter(Boolean))].slice(0, 60).map((word) => [`word:"${word}"`, `'${word}'`] as const);
  const known = {
    ...(pictured ? { [NAMED]: "what the sentence names", "role:image": "all pictures" } : {}),
    ...(spelled ? { "role:instruction": "the instruction", ...Object.fromEntries(words) } : {}),
  };
  return { ...known, [target.value]: known[target.value as keyof typeof known] ?? target.value };
});

/** What was found of how many episodes. */
function foundIn({ episodes, failed, read }: Found): string {
  const total = run.value!.episodes.length;
  const left = failed.length ? ` ${failed.length} cannot be read.` : "";
  if (read < total) return `Read ${read} of ${total} episodes.${left}`;
  if (!episodes.length) return `No episode has any of ${targets.value[target.value]}.${left}`;
  return `There in ${episodes.length} of ${read} episodes, ${calls.value.length} policy calls.${left}`;
}

export function HeadPage() {
  const numbers = found.value;
  const [typed, setTyped] = useState("");
  const [many, setMany] = useState(FIRST_CALLS);
  const means = averages.value;
  const chosen = head.value === "mean" || layer.value === "mean";
  if (runs.value.value?.copy)
    return (
      <div class="head-page">
        <button class="back" onClick={closeEpisode}>
          ← episodes
        </button>
        <p>{NEEDS_SERVER}</p>
      </div>
    );
  return (
    <div class="head-page">
      <header>
        <button class="back" onClick={closeEpisode}>
          ← episodes
        </button>
        <h1>{chosen ? "One head over all episodes" : `Layer ${layer.value}, head ${head.value} in all episodes`}</h1>
        <p class="soft">of {run.value?.name}</p>
      </header>
      <div class="controls open">
        {(run.value?.sites.length ?? 0) > 1 ? (
          <label>
            site{" "}
            <select value={site.value} onChange={(event) => setPart({ ...OTHER_SITE, site: event.currentTarget.value })}>
              {run.value!.sites.map(({ name }) => (
                <option key={name} value={name}>
                  {name}
                </option>
              ))}
            </select>
          </label>
        ) : null}
        {(
          [
            ["layer", axes.value?.layers, layer.value],
            ["head", axes.value?.heads, head.value],
          ] as const
        ).map(([name, known, value]) => (
          <label key={name}>
            {name}{" "}
            <select value={String(value)} onChange={(event) => setPart({ [name]: event.currentTarget.value })}>
              {value === "mean" ? <option value="mean">choose</option> : null}
              {(known ?? []).map((one) => (
                <option key={one} value={String(one)}>
                  {one}
                </option>
              ))}
            </select>
          </label>
        ))}
        <label>
          looks at{" "}
          <select class="wide" value={target.value} onChange={(event) => setPart({ target: event.currentTarget.value })}>
            {Object.entries(targets.value).map(([id, name]) => (
              <option key={id} value={id}>
                {name}
              </option>
            ))}
          </select>
        </label>
        <form
          onSubmit={(event) => {
            event.preventDefault();
            if (typed.trim()) setPart({ target: typed.trim() });
          }}
        >
          <input
            aria-label="Selector"
            placeholder="or a selector: object:red_cube"
            value={typed}
            onInput={(event) => setTyped(event.currentTarget.value)}
          />{" "}
          <button>Show</button>
        </form>
      </div>
      {chosen ? (
        <p>Choose a layer and a head.</p>
      ) : numbers?.error ? (
        <p class="error" role="alert">
          {numbers.error}
        </p>
      ) : !numbers ? (
        <p class="soft">Reading …</p>
      ) : (
        <>
          <p role="status" class={headRead.value ? "soft" : ""}>
            {foundIn(numbers)}
          </p>
          {numbers.episodes.length ? (
            <>
              <table class="numbers">
                <thead>
                  <tr>
                    <th>times even, mean over episodes</th>
                    {numbers.heads.map((one) => (
                      <th key={one}>{one === head.value ? "this head" : `head ${one}`}</th>
                    ))}
                    <th>layer {layer.value}</th>
                  </tr>
                </thead>
                <tbody>
                  <tr>
                    <th />
                    {means.map((one, i) => (
                      <td key={i} data-number={i === place.value ? "head-lift" : undefined} data-value={one}>
                        {i === place.value ? <b>{shown(one)}</b> : shown(one)}
                      </td>
                    ))}
                  </tr>
                </tbody>
              </table>
              <p class="soft">
                A head that was picked for its best call gets less in the others: judge it by the mean. Lines stand at {LEVELS.first} and{" "}
                {LEVELS.second} times even attention, mean over denoise steps; dashed: what the sentence names.
              </p>
              <p>
                <button aria-pressed={!least.value} onClick={() => (least.value = false)}>
                  most first
                </button>{" "}
                <button aria-pressed={least.value} onClick={() => (least.value = true)}>
                  least first
                </button>
              </p>
              <div class="cards of-calls">
                {calls.value.slice(0, many).map((call) => (
                  <CallCard key={`${call.episode} ${call.replan}`} call={call} />
                ))}
              </div>
              {calls.value.length > many ? (
                <button onClick={() => setMany(many + FIRST_CALLS)}>{calls.value.length - many} more</button>
              ) : null}
            </>
          ) : null}
        </>
      )}
    </div>
  );
}

/** Small maps of all heads of the chosen layer in one call; a click shows that head. */
export function LayerMaps({ name, replan }: { name: string; replan: number }) {
  const maps = useMaps(name, replan);
  if (maps === null) return <p class="soft">Reading …</p>;
  if (typeof maps === "string") return <p class="soft">{maps}</p>;
  return (
    <div class="layer-maps">
      {(axes.value?.heads ?? []).map((one, i) => (
        <button key={one} aria-pressed={head.value === one} onClick={() => setPart({ head: head.value === one ? "mean" : one })}>
          <span class="thumbnails">
            {Object.keys(maps).map((camera) => (
              <Thumbnail key={camera} name={name} replan={replan} camera={camera} maps={maps} ofHead={i} />
            ))}
          </span>
          head {one}
        </button>
      ))}
    </div>
  );
}
