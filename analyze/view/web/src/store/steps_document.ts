/** What the arrays of an episode's steps are of: `EpisodeSteps` of schemas/episode_steps.py, checked as there. */
import { StoreError } from "./errors";
import { list, name, object, text, whole } from "./json_fields";
import * as limits from "./limits";

/** The goal of a task that shares the scene, and the moment at which it first held. */
export interface GoalDocument {
  task_id: number;
  instruction: string;
  first_held: number | null;
}

/** Moment 0 is the end of the waiting steps, moment i that of the step that executed action i. */
export interface StepsDocument {
  /** The hand, then objects. */
  bodies: string[];
  /** When the gripper first touched each body. */
  first_touch: (number | null)[];
  goals: GoalDocument[];
}

/** The attribute `steps` of an episode; null where no simulator told them. */
export function parseSteps(value: unknown, numSteps: number): StepsDocument | null {
  if (value == null) return null;
  const fields = object(value, "steps");
  const moment = (given: unknown, where: string): number | null => (given == null ? null : whole(given, where, numSteps));
  const bodies = list(fields.bodies, "steps.bodies", limits.BODIES).map((each, i) => name(each, `steps.bodies[${i}]`));
  const touches = list(fields.first_touch, "steps.first_touch", limits.BODIES);
  if (bodies.length !== touches.length) {
    throw new StoreError(`The store cannot be shown: it has ${touches.length} first touches of ${bodies.length} bodies.`);
  }
  return {
    bodies,
    first_touch: touches.map((each, i) => moment(each, `steps.first_touch[${i}]`)),
    goals: list(fields.goals, "steps.goals", limits.GOALS).map((each, i) => {
      const goal = object(each, `steps.goals[${i}]`);
      return {
        task_id: whole(goal.task_id, `steps.goals[${i}].task_id`, 1e12),
        instruction: text(goal.instruction, `steps.goals[${i}].instruction`),
        first_held: moment(goal.first_held, `steps.goals[${i}].first_held`),
      };
    }),
  };
}

/** What happened first, in words: what the gripper touched, and whose goal was reached where it was not the task's. */
export function happenings(steps: StepsDocument | null, task: number): string[] {
  if (!steps) return [];
  const touched = steps.first_touch.reduce<number>((best, each, i) => (each !== null && (best < 0 || each < steps.first_touch[best]!) ? i : best), -1);
  const reached = steps.goals.filter((goal) => goal.task_id !== task && goal.first_held);
  return [
    touched < 0 ? "touched nothing" : `touched ${steps.bodies[touched]} first (step ${steps.first_touch[touched]})`,
    ...reached.map((goal) => `did "${goal.instruction}" (step ${goal.first_held})`),
  ];
}
