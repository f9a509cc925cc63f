/** One episode: what it came to, the instruction, the pictures, the timeline; and beside them the numbers. */
import { signal } from "@preact/signals";

import { Actions } from "./actions";
import { address, type EpisodeLine } from "./answers";
import { EffectTable } from "./effects";
import { figure } from "./figure";
import { HeadGrid } from "./heads";
import { OwnGroup, Ratio } from "./numbers";
import { kindOf } from "./overview";
import { Legend, Pictures } from "./pictures";
import {
  about,
  axes,
  beside,
  besideKnown,
  closeEpisode,
  denoise,
  episodeName,
  type groups,
  head,
  headsKnown,
  layer,
  layerPlace,
  main,
  nameInRun,
  nameOf,
  OTHER_SITE,
  onlyEpisode,
  part,
  replan,
  rows,
  run,
  runNumber,
  runs,
  type Scene,
  setPart,
  sides,
  site,
  step,
  swap,
} from "./state";
import { shown } from "./sums";
import { Timeline } from "./timeline";
import { AboutWords, ChooseShade, Title } from "./words";

const more = signal(false);

function Choose({
  name,
  title,
  known,
  value,
}: {
  name: "layer" | "head" | "denoise";
  title: string;
  known: readonly number[];
  value: number | "mean";
}) {
  return known.length < 2 ? null : (
    <label>
      {title}{" "}
      <select value={String(value)} onChange={(event) => setPart({ [name]: event.currentTarget.value })}>
        <option value="mean">mean of {known.length}</option>
        {known.map((one) => (
          <option value={String(one)}>{one}</option>
        ))}
      </select>
    </label>
  );
}

const options = signal(false);

function Controls() {
  const sites = run.value?.sites ?? [];
  return (
    <div class={options.value ? "controls open" : "controls"}>
      <ChooseShade />
      {sites.length > 1 ? (
        <label>
          site{" "}
          <select value={site.value} onChange={(event) => setPart({ ...OTHER_SITE, site: event.currentTarget.value })}>
            {sites.map(({ name }) => (
              <option value={name}>{name}</option>
            ))}
          </select>
        </label>
      ) : null}
      <Choose name="layer" title="layer" known={axes.value?.layers ?? []} value={layer.value} />
      <Choose name="head" title="head" known={headsKnown.value} value={head.value} />
      <Choose name="denoise" title="denoise step" known={axes.value?.denoise_steps ?? []} value={denoise.value} />
      <ChooseBeside />
      <button class="options" aria-expanded={options.value} onClick={() => (options.value = !options.value)}>
        options
      </button>
      <button aria-expanded={more.value} onClick={() => (more.value = !more.value)}>
        share
      </button>
    </div>
  );
}

/** In an exchange, whether two episodes began in the same state of one scene, told different sentences. */
const begunAlike = (one: EpisodeLine, other: EpisodeLine): boolean =>
  one.scene != null && one.scene === other.scene && one.episode === other.episode;

/** Episodes that may stand beside this one: the same one of another run first, then those of its task or beginning. */
function ChooseBeside() {
  const episode = about.value.value;
  if (!episode) return null;
  const known = (runs.value.value?.runs ?? []).flatMap(({ name: ofRun, episodes }, i) =>
    episodes
      .filter(
        (line) =>
          (i !== runNumber.value || line.name !== episode.name) &&
          (line.name === episode.name || line.task === episode.task || begunAlike(line, episode)),
      )
      .map((line) => ({
        line,
        run: i,
        title: `${i === runNumber.value ? "" : `${ofRun}, `}${nameInRun(line)}${line.outcome === false ? ", failed" : ""}`,
      })),
  );
  known.sort((a, b) => Number(b.line.name === episode.name) - Number(a.line.name === episode.name));
  return known.length ? (
    <>
      <label class="compare">
        compare with{" "}
        <select value={part("beside")} onChange={(event) => step({ beside: event.currentTarget.value })}>
          <option value="">nothing</option>
          {known.map(({ line, run: i, title }) => (
            <option value={`${i}:${line.name}`}>{title}</option>
          ))}
        </select>
      </label>
      {part("beside") && besideKnown.value ? <button onClick={swap}>⇄ swap</button> : null}
    </>
  ) : null;
}

/** What was changed in an episode; the words that it was told say most. */
function Banners({ scene }: { scene: Scene }) {
  const episode = scene.about.value.value!;
  if (episode.told_other)
    return (
      <p class="banner" role="alert">
        The policy was told '{episode.told}'; the task is '{episode.instruction}'.
      </p>
    );
  if (episode.scene != null && episode.scene !== episode.task)
    return <p class="soft">It began in the scene and initial state of task {episode.scene}.</p>;
  return (
    <>
      {runs.value.value?.runs[scene.run.value]?.changed.map((line) => (
        <p class="banner" key={line}>
          {line}
        </p>
      ))}
    </>
  );
}

/** Two episodes at the same step: pictures with the same lines, what they came to, and their ratios. */
function SideBySide() {
  const other = beside.about.value;
  if (runs.value.value && !besideKnown.value)
    return (
      <p class="error" role="alert">
        There is no other episode '{part("beside")}' to compare with.
      </p>
    );
  if (other.error)
    return (
      <p class="error" role="alert">
        {other.error}
      </p>
    );
  if (!other.value) return <p class="soft">Reading …</p>;
  const ratioOf = (numbers: typeof groups.value.value, at: number): string =>
    numbers?.ratio
      ? `ratio ${shown(numbers.ratio[at]?.[layerPlace(numbers)])}, ${shown(numbers.ratio_lift?.[at]?.[layerPlace(numbers)])} times even`
      : "";
  return (
    <div class="beside">
      {sides.value.map((side, i) => {
        const { scene, at } = side;
        const episode = scene.about.value.value!;
        return (
          <div key={i}>
            <h2>{nameOf(side)}</h2>
            <p class={`verdict ${kindOf(episode)}`}>{episode.verdict}</p>
            <Banners scene={scene} />
            <Pictures scene={scene} at={at} />
            <p class="soft">
              step {episode.starts[at]} of {episode.end}; {ratioOf(scene.groups.value.value, at)}
            </p>
            {scene.rows.value.error ? (
              <p class="error" role="alert">
                {scene.rows.value.error}
              </p>
            ) : null}
          </div>
        );
      })}
    </div>
  );
}

/** The command that prints what is seen, as it is typed. */
export function commandLine(): string {
  const episode = about.value.value;
  if (!run.value || !episode) return "";
  const parts = [
    "vla-attention overlay",
    run.value.path ?? `${run.value.name}`,
    `--task ${episode.task}`,
    `--episode ${episode.episode}`,
    `--replans ${replan.value}`,
  ];
  if (site.value !== run.value.sites[0]?.name) parts.push(`--site ${site.value}`);
  if (layer.value !== "mean") parts.push(`--layers ${layer.value}`);
  if (head.value !== "mean") parts.push(`--heads ${head.value}`);
  if (denoise.value !== "mean") parts.push(`--denoise ${denoise.value}`);
  return parts.join(" ");
}

async function savePictures(kind: "png" | "svg"): Promise<void> {
  const { text, width, height } = await figure();
  const link = document.createElement("a");
  link.href = `data:image/svg+xml,${encodeURIComponent(text)}`;
  if (kind === "png") {
    const image = new Image();
    image.src = link.href;
    await image.decode();
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [2 * width, 2 * height];
    canvas.getContext("2d")!.drawImage(image, 0, 0, 2 * width, 2 * height);
    link.href = canvas.toDataURL("image/png");
  }
  link.download = `${episodeName.value}_call${replan.value}.${kind}`;
  link.click();
}

const copied = signal("");

function Drawer() {
  const copy = (what: string, text: string): void => void navigator.clipboard.writeText(text).then(() => (copied.value = `${what} copied`));
  const command = commandLine();
  return (
    <section class="drawer" aria-label="More">
      <p>
        <button onClick={() => copy("link", location.href)}>Copy link</button>{" "}
        <button onClick={() => void savePictures("png")}>Save PNG</button>{" "}
        <button onClick={() => void savePictures("svg")}>Save SVG</button>{" "}
        {runs.value.value?.copy ? null : (
          <>
            <a
              class="button"
              href={`${address.episode(runNumber.value, episodeName.value)}/film.gif?${new URLSearchParams({ site: site.value, layer: `${layer.value}`, head: `${head.value}`, denoise: `${denoise.value}` })}`}
              download={`${episodeName.value}.gif`}
            >
              Save GIF
            </a>{" "}
          </>
        )}
        <button onClick={() => copy("command", command)}>Copy command</button> <span role="status">{copied}</span>
      </p>
      <p>
        <code>{command}</code> <span class="soft">draws this episode in a terminal.</span>
      </p>
      <p class="soft">Keys: ← → call, space plays, [ ] layer, , . head, - + denoise step, Esc overview.</p>
    </section>
  );
}

export function EpisodePage() {
  const { value: episode, error } = about.value;
  const back = onlyEpisode.value ? null : (
    <button class="back" onClick={closeEpisode}>
      ← {part("of") ? `layer ${layer.value}, head ${head.value}` : "episodes"}
    </button>
  );
  const isListed = run.value?.episodes.some(({ name }) => name === episodeName.value) ?? true;
  if (!isListed)
    return (
      <div class="episode">
        {back}
        <p class="error" role="alert">
          {run.value!.name} has no episode '{episodeName.value}'.
        </p>
      </div>
    );
  if (error)
    return (
      <div class="episode">
        {back}
        <p class="error" role="alert">
          {error}
        </p>
      </div>
    );
  if (!episode || !run.value)
    return (
      <div class="episode">
        {back}
        <p class="soft">Reading {part("episode")} …</p>
      </div>
    );
  const isBeside = part("beside") !== "";
  return (
    <div class="episode">
      <header>
        {back}
        {isBeside ? null : (
          <p class={`verdict ${kindOf(episode)}`} role="status">
            {episode.verdict}
          </p>
        )}
      </header>
      {isBeside ? null : <Banners scene={main} />}
      <div class="top">
        <Title />
        <Controls />
      </div>
      {more.value ? <Drawer /> : null}
      {isBeside ? (
        <>
          <SideBySide />
          <Legend />
        </>
      ) : null}
      <div class="columns">
        <div class="main">
          {isBeside ? null : (
            <>
              <Pictures scene={main} at={replan.value} />
              <Legend />
            </>
          )}
          <Timeline />
          {isBeside ? <EffectTable /> : null}
        </div>
        <aside>
          <AboutWords />
          <Ratio />
          {isBeside ? null : <EffectTable />}
          <Actions />
          <HeadGrid />
          <OwnGroup />
        </aside>
      </div>
      {rows.value.error && !isBeside ? (
        <p class="error" role="alert">
          {rows.value.error}
        </p>
      ) : null}
    </div>
  );
}
