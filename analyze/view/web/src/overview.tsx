/** The first page: what the run shows, and its episodes as pictures, task by task. */
import { computed, signal } from "@preact/signals";

import { address, type EpisodeLine, pictureAt, trouble } from "./answers";
import { openEpisode, part, run, runNumber, runNumbers, runs, setPart } from "./state";
import { shown } from "./sums";

const FAILED = ["failed", "fails", "failure", "unsolved", "unsuccessful"];

/** Whether an episode fits all words of a search; "failed", "not solved" and "solved" are outcomes. */
export function fits(line: EpisodeLine, search: string): boolean {
  const text = search
    .toLowerCase()
    .replace(/\b(task|scene) (?=\d)/g, "$1")
    .replace(/\bnot (solved|successful)\b/g, "failed");
  const known = [
    `task${line.task}`,
    line.scene == null ? "" : `scene${line.scene}`,
    line.name,
    line.instruction,
    line.told,
    line.verdict,
    line.failed,
  ]
    .join(" ")
    .toLowerCase();
  return text
    .split(/\s+/)
    .filter(Boolean)
    .every((word) => {
      if (FAILED.includes(word)) return line.outcome === false;
      if (["solved", "successful", "success"].includes(word)) return line.outcome === true;
      return known.includes(word);
    });
}

const chips: Record<string, { name: string; holds: (line: EpisodeLine, median: number) => boolean }> = {
  all: { name: "all", holds: () => true },
  failed: { name: "failed", holds: ({ outcome }) => outcome === false },
  other: { name: "wrong object or goal", holds: ({ did_other }) => did_other === true },
  long: { name: "long", holds: ({ num_steps }, median) => num_steps > 1.5 * median },
  told: { name: "told something else", holds: (line) => line.told_other },
  damaged: { name: "cannot be read", holds: ({ failed }) => failed !== undefined },
};

const medians = computed(() => {
  const of = new Map<number, number[]>();
  for (const line of run.value?.episodes ?? []) of.set(line.task, [...(of.get(line.task) ?? []), line.num_steps ?? 0]);
  return new Map([...of].map(([task, steps]) => [task, steps.sort((a, b) => a - b)[Math.floor(steps.length / 2)]!]));
});

/** In which order episodes stand, by a number of each; without one by task. Those without a number stand last. */
const orders: Record<string, { name: string; of: (line: EpisodeLine) => number | null | undefined }> = {
  task: { name: "by task", of: () => 0 },
  outcome: { name: "failed first", of: ({ outcome }) => (outcome === false ? 0 : outcome === true ? 1 : null) },
  shortest: { name: "fewest steps first", of: ({ num_steps }) => num_steps || null },
  longest: { name: "most steps first", of: ({ num_steps }) => (num_steps ? -num_steps : null) },
  lowest: { name: "lowest ratio first", of: ({ name }) => numbersOf.value.get(name)?.ratio },
  highest: { name: "highest ratio first", of: ({ name }) => minus(numbersOf.value.get(name)?.ratio) },
  moved: { name: "words move most first", of: ({ name }) => minus(runNumbers.value?.effects?.[name]) },
  unmoved: { name: "words move least first", of: ({ name }) => runNumbers.value?.effects?.[name] },
};
const minus = (one: number | null | undefined): number | null => (one == null ? null : -one);
const byEffect = computed(() => ["moved", "unmoved"].includes(part("sort")));
/** Those that the run has numbers for. */
const usedOrders = computed(() =>
  Object.entries(orders).filter(([name]) => !["moved", "unmoved"].includes(name) || runNumbers.value?.effects || part("sort") === name),
);
const numbersOf = computed(() => new Map((runNumbers.value?.episodes ?? []).map((one) => [one.name, one])));
/** What a link names, or what stands first where there is nothing of that name. */
const chosen = <T,>(all: Record<string, T>, name: string): T => (Object.keys(all).includes(name) ? all[name]! : Object.values(all)[0]!);

const listed = computed(() => {
  const chip = chosen(chips, part("show"));
  return (run.value?.episodes ?? []).filter(
    (line) =>
      (part("task") === "" || part("task") === String(line.task)) &&
      chip.holds(line, medians.value.get(line.task)!) &&
      fits(line, part("find")),
  );
});

const ids = computed(() => [...new Set(run.value?.episodes.map(({ task }) => task))]);

const tasks = computed(() => {
  const of = new Map<string, EpisodeLine[]>();
  const order = chosen(orders, part("sort"));
  if (order !== orders.task) {
    const key = (line: EpisodeLine): number => order.of(line) ?? Infinity;
    return listed.value.length ? [{ task: "", instruction: "", lines: [...listed.value].sort((a, b) => key(a) - key(b) || 0) }] : [];
  }
  for (const line of listed.value) {
    const title = line.failed === undefined ? `${line.task}\t${line.instruction}` : `${line.task}\t`;
    of.set(title, [...(of.get(title) ?? []), line]);
  }
  return [...of].map(([title, lines]) => ({ task: title.split("\t")[0]!, instruction: title.split("\t")[1]!, lines }));
});

export function kindOf(line: EpisodeLine): "solved" | "failed" | "unknown" {
  return line.outcome === true ? "solved" : line.outcome === false ? "failed" : "unknown";
}

export const mark = (line: EpisodeLine) => (line.outcome === true ? "✓" : line.outcome === false ? "✗" : "·");

function Card({ line }: { line: EpisodeLine }) {
  const [numbers, effect] = [numbersOf.value.get(line.name), runNumbers.value?.effects?.[line.name]];
  return (
    <button
      class={`card ${kindOf(line)}`}
      data-episode={line.name}
      title={line.failed ?? line.verdict}
      onClick={() => openEpisode(line.name)}
    >
      {line.picture ? (
        <img src={pictureAt(address.picture(runNumber.value, line.name, ...line.picture))} alt="" loading="lazy" />
      ) : (
        <span class="no-picture">{line.failed === undefined ? "no pictures" : "cannot be read"}</span>
      )}
      <span class="about">
        <b>
          {mark(line)} {chosen(orders, part("sort")) === orders.task ? "" : `task ${line.task}, `}
          {line.scene == null ? line.episode : `scene ${line.scene}`}
        </b>
        {line.num_steps ? <span>{line.num_steps} steps</span> : null}
        {byEffect.value && effect != null ? (
          <span class="soft ratio-of" title={runNumbers.value?.effect ?? ""}>
            words: {shown(effect)}
          </span>
        ) : numbers?.ratio != null ? (
          <span class="soft ratio-of" title={`ratio ${runNumbers.value?.ratio ?? ""}, and times what even attention gives`}>
            {shown(numbers.ratio)} ({shown(numbers.lift)} × even)
          </span>
        ) : null}
      </span>
    </button>
  );
}

/** An exchange: what was told, in whose scene. A cell opens its episode. */
function Matrix() {
  const lines = listed.value.filter(({ scene }) => scene != null);
  if (!lines.length || run.value?.rerun) return null; // a rerun executes nothing
  const scenes = [...new Set(lines.map(({ scene }) => scene!))].sort((a, b) => a - b);
  const told = new Map(lines.map(({ task, instruction }) => [task, instruction]));
  return (
    <section class="matrix" aria-label="Told and scene">
      <p class="soft">Told (rows) in the scene and initial state of task (columns); ✓ did what it was told. A cell opens its episode.</p>
      <table>
        <thead>
          <tr>
            <th />
            {scenes.map((scene) => (
              <th scope="col" key={scene} title={told.get(scene)}>
                {scene}
              </th>
            ))}
          </tr>
        </thead>
        <tbody>
          {[...told].map(([task, instruction]) => (
            <tr key={task}>
              <th scope="row">
                <bdi>{instruction}</bdi> <span class="soft">{task}</span>
              </th>
              {scenes.map((scene) => (
                <td key={scene} class={scene === task ? "own" : ""}>
                  {lines
                    .filter((line) => line.task === task && line.scene === scene)
                    .map((line) => (
                      <button
                        key={line.name}
                        class={kindOf(line)}
                        title={line.verdict}
                        aria-label={`task ${task} told in scene ${scene}: ${line.verdict}`}
                        onClick={() => openEpisode(line.name)}
                      >
                        {mark(line)}
                      </button>
                    ))}
                </td>
              ))}
            </tr>
          ))}
        </tbody>
      </table>
    </section>
  );
}

const FIRST_FINDINGS = 2;
const all = signal(false);

function Findings() {
  const numbers = runNumbers.value;
  if (numbers?.findings) {
    return (
      <section class="findings" aria-label="What the run shows">
        {numbers.findings.slice(0, all.value ? undefined : FIRST_FINDINGS).map(({ asks, sentence, limit }) => (
          <p key={sentence}>
            <b>{asks}</b> {sentence} {limit ? <span class="soft">{limit}</span> : null}
          </p>
        ))}
        {numbers.findings.length > FIRST_FINDINGS ? (
          <button onClick={() => (all.value = !all.value)}>
            {all.value ? "fewer" : `${numbers.findings.length - FIRST_FINDINGS} more`}
          </button>
        ) : null}
        {numbers.complete ? null : <span class="soft"> More is being computed …</span>}
      </section>
    );
  }
  if (trouble.value) return null; // nobody computes
  return <section class="findings soft">{numbers?.failed ?? "What the run shows is being computed …"}</section>;
}

export function Overview() {
  const shownRun = run.value;
  if (!shownRun) return null;
  const solved = shownRun.episodes.filter(({ outcome }) => outcome === true).length;
  const known = shownRun.episodes.filter(({ outcome }) => outcome === true || outcome === false).length;
  const used = Object.entries(chips).filter(
    ([name, { holds }]) => name === "all" || shownRun.episodes.some((line) => holds(line, medians.value.get(line.task)!)),
  );
  return (
    <div class="overview">
      <header>
        {(runs.value.value?.runs.length ?? 0) > 1 ? (
          <nav>
            {runs.value.value!.runs.map(({ name }, i) => (
              <button aria-pressed={i === runNumber.value} onClick={() => setPart({ run: i, show: "all", find: "", task: "" })}>
                {name}
              </button>
            ))}
          </nav>
        ) : null}
        <h1>{shownRun.name}</h1>
        <p>
          {shownRun.policy}
          {shownRun.untrained ? " (random weights)" : ""} in {shownRun.suite}:{" "}
          {shownRun.rerun
            ? "policy calls of another run, made again"
            : known
              ? `${solved} of ${known} episodes solved`
              : "outcomes not known"}
        </p>
        {shownRun.changed.map((line) => (
          <p class="banner" key={line}>
            {line}
          </p>
        ))}
        {shownRun.notes?.map((line) => (
          <p class="soft" key={line}>
            {line}
          </p>
        ))}
      </header>
      <Findings />
      <search class="filters">
        {used.map(([name, { name: text }]) => (
          <button class="chip" aria-pressed={part("show") === name} onClick={() => setPart({ show: name })}>
            {text}
          </button>
        ))}
        {ids.value.length > 1 ? (
          <select aria-label="Task" value={part("task")} onChange={(event) => setPart({ task: event.currentTarget.value })}>
            <option value="">all tasks</option>
            {ids.value.map((task) => (
              <option value={String(task)}>task {task}</option>
            ))}
          </select>
        ) : null}
        <select
          aria-label="Order"
          value={chosen(orders, part("sort")) === orders.task ? "task" : part("sort")}
          onChange={(event) => setPart({ sort: event.currentTarget.value })}
        >
          {usedOrders.value.map(([name, { name: text }]) => (
            <option value={name}>{text}</option>
          ))}
        </select>
        <input
          type="search"
          aria-label="Find episodes"
          placeholder="find: red, failed, not solved …"
          value={part("find")}
          onInput={(event) => setPart({ find: event.currentTarget.value })}
        />
        {byEffect.value && runNumbers.value?.effect ? <span class="soft">{runNumbers.value.effect}</span> : null}
        <span class="soft" role="status">
          {listed.value.length} of {shownRun.episodes.length} episodes
        </span>
      </search>
      <Matrix />
      <div class={`tasks of-${Math.max(0, ...tasks.value.map(({ lines }) => lines.length))}`}>
        {tasks.value.map(({ task, instruction, lines }) => (
          <section class="task" key={`${task} ${instruction}`}>
            {task ? (
              <h2>
                <span class="soft">task {task}</span> <bdi>{instruction}</bdi>
              </h2>
            ) : null}
            <div class="cards">
              {lines.map((line) => (
                <Card key={line.name} line={line} />
              ))}
            </div>
          </section>
        ))}
      </div>
      {!shownRun.episodes.length ? <p>The run has no episodes yet. Load the page again when it has.</p> : null}
      {shownRun.episodes.length && !listed.value.length ? (
        <p>
          No episode fits. <button onClick={() => setPart({ show: "all", find: "", task: "" })}>Show all</button>
        </p>
      ) : null}
    </div>
  );
}
