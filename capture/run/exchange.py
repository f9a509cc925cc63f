"""The scene of one task, the sentence of another: which rollouts `vla-attention capture exchange` makes."""

from __future__ import annotations

from collections.abc import Sequence

from vla_attention.capture.engine.source import EpisodeJob
from vla_attention.capture.environments.base import Suite, Task
from vla_attention.schemas.errors import BadArgument, listing, plural


def exchanged_jobs(
    suite: Suite, scenes: Sequence[Sequence[Task]], states: int, max_steps: int, most: int
) -> list[EpisodeJob]:
    """Return a rollout for every told task, every task of its scene, and each of so many initial states of that one.

    An episode is one of the told task. Its index has the other task and the state in it, so that further tasks and
    states of a later run have indices of their own.

    scenes: the chosen tasks, those that share a scene together. most: rollouts that were allowed.

    Raises:
        BadArgument: no two of the tasks share a scene, or there are more rollouts than allowed.
    """
    shared = [scene for scene in scenes if len(scene) > 1]
    if not shared:
        chosen = listing([task.task_id for scene in scenes for task in scene], 8)
        raise BadArgument(
            f"No two of the tasks {chosen} of {suite.name} share a scene, so none can be told another one's sentence; "
            "take more of its tasks (--task), or a suite whose tasks share scenes: libero_goal, libero_90, cubes."
        )
    many = suite.initial_states_per_task

    def states_of(scene: Task) -> list[int]:
        # Tasks with cubes have the same initial states: those of another number, so that no two scenes are the same.
        first, step = (scene.task_id, suite.num_tasks) if suite.kind == "cubes" else (0, 1)
        return [(first + step * state) % many for state in range(states)]

    jobs = [
        EpisodeJob(
            told,
            scene.task_id * many + state,
            max_steps,
            f"told task {told.task_id}, scene of task {scene.task_id}, state {state}",
            scene,
            state,
        )
        for tasks in shared
        for scene in tasks  # a simulator stays with its scene
        for state in states_of(scene)
        for told in tasks
    ]
    if len(jobs) > most:
        raise BadArgument(
            f"The exchange takes {len(jobs)} rollouts of at most {max_steps} steps ({_sizes(shared, states)}), and "
            f"{most} are allowed; choose fewer tasks with --task, or allow them: --rollouts {len(jobs)}."
        )
    return jobs


def describe_exchange(scenes: Sequence[Sequence[Task]], states: int, jobs: Sequence[EpisodeJob]) -> str:
    """Return the line that is printed before the run."""
    shared = [scene for scene in scenes if len(scene) > 1]
    alone = sum(len(scene) == 1 for scene in scenes)
    left = f" {plural(alone, 'task')} left out, whose scene no other one has." if alone else ""
    return (
        f"Exchange: every task is told in the scene of every task that shares it: {len(jobs)} rollouts of at most "
        f"{jobs[0].size} steps ({_sizes(shared, states)}).{left}"
    )


def _sizes(shared: Sequence[Sequence[Task]], states: int) -> str:
    sizes = listing([f"{len(scene)} x {len(scene)}" for scene in shared], 4)
    return f"{sizes} tasks, {plural(states, 'initial state')} each"
