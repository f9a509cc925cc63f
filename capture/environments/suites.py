"""The task suites by name. Nothing heavy is imported here; a simulator is loaded when an environment is made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vla_attention.capture.environments.base import Environment, EnvironmentSettings, Task
from vla_attention.schemas.errors import BadArgument, unknown_name


@dataclass(frozen=True)
class Suite:
    """A set of tasks and the protocol they are evaluated with.

    kind: "libero" suites need the LIBERO package and its assets; "robosuite" needs no download.
    max_steps: policy steps after waiting before an episode counts as failed; those of the published evaluations.
    """

    name: str
    kind: Literal["libero", "robosuite"]
    num_tasks: int
    max_steps: int
    initial_states_per_task: int


SUITES: tuple[Suite, ...] = (
    Suite("libero_spatial", "libero", num_tasks=10, max_steps=220, initial_states_per_task=50),
    Suite("libero_object", "libero", num_tasks=10, max_steps=280, initial_states_per_task=50),
    Suite("libero_goal", "libero", num_tasks=10, max_steps=300, initial_states_per_task=50),
    Suite("libero_10", "libero", num_tasks=10, max_steps=520, initial_states_per_task=50),
    Suite("libero_90", "libero", num_tasks=90, max_steps=400, initial_states_per_task=50),
    Suite("robosuite", "robosuite", num_tasks=8, max_steps=200, initial_states_per_task=50),
)


def find_suite(name: str) -> Suite:
    """Return the suite of that name, or raise `UnknownName` with the names that exist."""
    for suite in SUITES:
        if suite.name == name:
            return suite
    raise unknown_name("task suite", name, [suite.name for suite in SUITES])


def check_task_id(suite: Suite, task_id: int) -> None:
    """Raise `BadArgument` unless the suite has a task of that number."""
    if not 0 <= task_id < suite.num_tasks:
        raise BadArgument(f"Task {task_id} does not exist in {suite.name}; its tasks are 0 to {suite.num_tasks - 1}.")


def check_initial_state_index(task: Task, index: int) -> None:
    """Raise `BadArgument` unless the task has an initial state of that number."""
    if not 0 <= index < task.num_initial_states:
        raise BadArgument(
            f"Initial state {index} does not exist for task {task.task_id} of {task.suite}; "
            f"its initial states are 0 to {task.num_initial_states - 1}."
        )


def list_tasks(suite: Suite, settings: EnvironmentSettings) -> tuple[Task, ...]:
    """Return the suite's tasks in order. Reads names only: no simulator, no assets, no torch."""
    if suite.kind == "libero":
        from vla_attention.capture.environments.libero_installation import list_libero_tasks

        return list_libero_tasks(suite)
    from vla_attention.capture.environments.robosuite_tasks import list_robosuite_tasks

    return list_robosuite_tasks(suite)


def make_environment(suite: Suite, task_id: int, settings: EnvironmentSettings) -> Environment:
    """Build the simulator of one task (seconds). Close it when done."""
    check_task_id(suite, task_id)
    if settings.image_size < 1:
        raise BadArgument(f"The image size is {settings.image_size}; it must be at least 1 pixel (published: 256).")
    task = list_tasks(suite, settings)[task_id]
    if suite.kind == "libero":
        from vla_attention.capture.environments.libero import LiberoEnvironment

        return LiberoEnvironment(suite, task, settings)
    from vla_attention.capture.environments.robosuite_tasks import RobosuiteEnvironment

    return RobosuiteEnvironment(suite, task, settings)
