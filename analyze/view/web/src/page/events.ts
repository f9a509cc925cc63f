/** What happened in an episode: the first closing of the gripper, as analyze/time/alignment.py has it, and its end. */
import type { RootDocument } from "../store/documents";
import type { Episode, Series } from "../store/episode";

export interface EpisodeEvent {
  /** Replan at which it is shown. */
  replan: number;
  text: string;
}

/**
 * The first replan one of whose executed actions closes the gripper; null when none does.
 *
 * `starts`: environment step of each replan; `end`: the step after the last action. The last number of an action is the
 * gripper's command: above 0 closes it.
 */
export function closingReplan(actions: Series, starts: readonly number[], end: number): number | null {
  const [, horizon, size] = actions.shape as [number, number, number];
  for (let replan = 0; replan < actions.replans; replan++) {
    const count = Math.min(horizon, (starts[replan + 1] ?? end) - starts[replan]!);
    for (let step = 0; step < count; step++) if (actions.values[(replan * horizon + step + 1) * size - 1]! > 0) return replan;
  }
  return null;
}

const OTHER_LOOPS = ["recorded", "dataset"];

/** The events of an episode, in order. Which number drives the gripper is known of vla-capture's own suites only. */
export async function eventsOf(root: RootDocument, episode: Episode): Promise<EpisodeEvent[]> {
  const { document } = episode;
  const found: EpisodeEvent[] = [];
  const actions = OTHER_LOOPS.includes(root.protocol.name) ? null : await episode.series("actions");
  if (actions && actions.shape.length === 3 && document.env_step.length) {
    const replan = closingReplan(actions, document.env_step, root.protocol.wait_steps + document.num_steps);
    if (replan !== null) found.push({ replan, text: "gripper first closes" });
  }
  const { success } = document;
  const end = success === null ? "end, outcome not known" : success ? "solved" : "not solved";
  found.push({ replan: episode.numReplans - 1, text: end });
  return found;
}
