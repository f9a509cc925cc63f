"""What made-up policies did: rollouts that end, as real ones do, with the goal of their task."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import SimpleNamespace
from typing import Any

import polars as pl
from msgspec.structs import replace

from vla_attention.analyze.core.behaviour import SCHEMA, row_of
from vla_attention.schemas.episode_steps import HAND, EpisodeSteps, TaskGoal

STEPS = 40


def goals_of(sentences: Mapping[int, str], conditions: Mapping[int, tuple[str, ...]] | None = None) -> list[TaskGoal]:
    """A goal for each task, by itself unless its conditions are given."""
    given = conditions or {}
    return [
        TaskGoal(task, f"task_{task}", said, given.get(task, (f"goal_{task}",)), None)
        for task, said in sentences.items()
    ]


COLOURS = goals_of({0: "touch the red cube", 1: "touch the green cube", 2: "touch the blue cube"})


def did(
    rollouts: Iterable[tuple[int, Mapping[int, int]]],
    goals: Iterable[TaskGoal] = COLOURS,
    family: str | Mapping[int, str] = "touch the COLOUR cube",
    state: str | None = "s",
    suite: str = "made_up",
    told: str | None = None,
    same: bool = False,
    named: Mapping[int, int] | None = None,
    touches: Mapping[int, int] | None = None,
) -> pl.DataFrame:
    """The rows of `behaviour` of rollouts: the task, and when the goal of which task would hold.

    A moment after the task's own is not seen. `state`: of all rollouts; None: each has its own. `told`: the sentence
    that all are given in place of their task's; `same`: it means the same. Each goal has a thing, which is touched when
    the goal is reached; `named`: whose thing a task names, its own unless given; `touches`: further things that are
    touched, and when.
    """
    goals, rows = list(goals), []
    for number, (task, course) in enumerate(rollouts):
        last = course.get(task, STEPS)
        seen = {other: moment for other, moment in course.items() if moment <= last}
        held = tuple(replace(goal, first_held=seen.get(goal.task_id)) for goal in goals)
        bodies = (HAND, *(f"thing_{goal.task_id}" for goal in goals))
        moments = {goal.task_id: goal.first_held for goal in held} | dict(touches or {})
        steps = EpisodeSteps(bodies, (None, *moments.values()), held)
        sentence = next(goal.instruction for goal in goals if goal.task_id == task)
        attributes: Any = SimpleNamespace(
            task_id=task,
            episode_index=number,
            instruction=sentence,
            task_family=family if isinstance(family, str) else family[task],
            initial_state_digest=str(number) if state is None else state,
            success=task in seen,
            scene_task_id=None,
            num_steps=last,
            objects=(SimpleNamespace(name=f"thing_{(named or {}).get(task, task)}", of_interest=True),),
        )
        rows.append(row_of(suite, attributes, sentence if told is None else told, steps, same))
    return pl.DataFrame(rows, schema=SCHEMA)
