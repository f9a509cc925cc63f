"""The task suites by name, and the environments of their tasks.

A new suite of an existing simulator is one line in `SUITES`. A new simulator is one more branch in `list_tasks` and
`make_environment`. Importing this module loads no simulator; `make_environment` does.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from vla_attention.capture.environments.base import Environment, EnvironmentSettings, Suite, Task, check_task_id
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS, list_cube_tasks
from vla_attention.capture.environments.robosuite_installation import find_robosuite
from vla_attention.schemas.errors import look_up

#: LIBERO's standard suites. The numbers of steps are openpi's (see `episode_protocol.py`); benchmarks/README.md has the
#: memory.
_STANDARD = (
    Suite("libero_spatial", "libero", num_tasks=10, max_steps=220, initial_states_per_task=50, simulator_bytes=2.7e9),
    Suite("libero_object", "libero", num_tasks=10, max_steps=280, initial_states_per_task=50, simulator_bytes=2.7e9),
    Suite("libero_goal", "libero", num_tasks=10, max_steps=300, initial_states_per_task=50, simulator_bytes=2.3e9),
    Suite("libero_10", "libero", num_tasks=10, max_steps=520, initial_states_per_task=50, simulator_bytes=3.3e9),
)
#: Every suite.
SUITES: tuple[Suite, ...] = (
    *_STANDARD,
    Suite("libero_90", "libero", num_tasks=90, max_steps=400, initial_states_per_task=50, simulator_bytes=3.3e9),
    Suite("robosuite", "robosuite", num_tasks=8, max_steps=200, initial_states_per_task=50, simulator_bytes=8.0e08),
    Suite("cubes", "cubes", num_tasks=17, max_steps=150, initial_states_per_task=50, simulator_bytes=8.0e08),
    # The same and six more tasks, which the policy that is shipped was trained on and solves too seldom.
    Suite("cubes_harder", "cubes", num_tasks=23, max_steps=150, initial_states_per_task=50, simulator_bytes=8.0e08),
    # For control policies (docs/validation.md): the first twelve tasks, with a mark in the picture.
    Suite("cubes_marked", "cubes", num_tasks=12, max_steps=150, initial_states_per_task=50, simulator_bytes=8.0e08),
    Suite("cubes_mark_only", "cubes", num_tasks=12, max_steps=150, initial_states_per_task=50, simulator_bytes=8.0e08),
    # LIBERO-PRO: another sentence, another object, other places, another task.
    *(
        replace(suite, name=f"{suite.name.replace('libero_', 'libero_pro_')}_{kind}", perturbs=suite.name)
        for suite in _STANDARD
        for kind in ("lan", "object", "swap", "task")
    ),
)
#: `--task-suite all` stands for these, in this order: the standard suites of LIBERO.
ALL_SUITES = "all"
STANDARD_SUITES = tuple(suite.name for suite in _STANDARD)


def find_suite(name: str) -> Suite:
    """Return the suite of that name, or of LIBERO-PRO's own name, or raise `UnknownName` with the names that exist."""
    named = {suite.name: suite for suite in SUITES}
    own = {suite.name.replace("libero_pro_", "libero_"): suite for suite in SUITES if suite.perturbs}
    return own.get(name) or look_up("task suite", name, named)


def list_tasks(suite: Suite) -> tuple[Task, ...]:
    """Return the suite's tasks in order. Reads names only: needs no simulator, no assets and no torch."""
    written = [""] * suite.num_tasks
    if suite.kind == "libero":
        from vla_attention.capture.environments.libero_installation import list_libero_tasks

        texts = list_libero_tasks(suite)
        if suite.perturbs:
            from vla_attention.capture.environments.libero_pro import pro_texts

            both = [pro_texts(suite, name, told) for name, told, _ in texts]
            texts, written = [its for its, _ in both], [says for _, says in both]
    elif suite.kind == "cubes":
        texts = list_cube_tasks(suite)
    else:
        from vla_attention.capture.environments.robosuite_tasks import list_robosuite_tasks

        texts = list_robosuite_tasks()
    return tuple(
        Task(suite.name, number, name, instruction, suite.initial_states_per_task, family, says)
        for number, ((name, instruction, family), says) in enumerate(zip(texts, written, strict=True))
    )


def tasks_by_scene(suite: Suite, settings: EnvironmentSettings) -> list[tuple[Task, ...]]:
    """Return the suite's tasks, those that share a scene together; runs no simulator.

    Raises:
        MissingDependency, LiberoAssetsMissing: LIBERO reads its task files itself, and is not there.
    """
    tasks = list_tasks(suite)
    if suite.kind == "libero":
        from vla_attention.capture.environments.libero import scene_of
        from vla_attention.capture.environments.libero_assets import find_assets
        from vla_attention.capture.environments.libero_installation import load_libero

        load_libero(find_assets(settings.libero_assets))
        scenes: list[object] = [scene_of(task) for task in tasks]
    elif suite.kind == "cubes":
        scenes = [CUBE_TASKS[task.task_id].num_cubes for task in tasks]
    else:
        scenes = [task.name for task in tasks]
    different = [scene for place, scene in enumerate(scenes) if scene not in scenes[:place]]
    return [tuple(task for task, its in zip(tasks, scenes, strict=True) if its == scene) for scene in different]


def check_installed(suite: Suite, libero_assets: Path | None) -> None:
    """Raise what the first episode would raise where the suite's simulator or its files are not there; loads neither.

    Raises:
        MissingDependency: robosuite or LIBERO is not installed.
        LiberoAssetsMissing: no folder has all of LIBERO's assets, or those of LIBERO-PRO.
    """
    find_robosuite()
    if suite.kind == "libero":
        from vla_attention.capture.environments.libero_assets import find_assets
        from vla_attention.capture.environments.libero_pro import check_pro_assets

        list_tasks(suite)
        check_pro_assets(suite.name, find_assets(libero_assets))


def make_environment(suite: Suite, task_id: int, settings: EnvironmentSettings) -> Environment:
    """Build the simulator of one task, which takes seconds. Close it after use.

    Raises:
        BadArgument: the task does not exist.
        MissingDependency: the simulator is not installed.
    """
    check_task_id(suite, task_id)
    tasks = list_tasks(suite)
    task = tasks[task_id]
    if suite.kind == "libero":
        from vla_attention.capture.environments.libero import LiberoEnvironment

        return LiberoEnvironment(task, settings, tasks)
    if suite.kind == "cubes":
        from vla_attention.capture.environments.cubes.environment import CubesEnvironment

        return CubesEnvironment(task, settings, tasks)
    from vla_attention.capture.environments.robosuite_tasks import RobosuiteEnvironment

    return RobosuiteEnvironment(task, settings)
