"""LIBERO tasks, simulated as in the published evaluations of pi0, pi0.5 and Cosmos Policy."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.environments.base import NO_DEPARTURES, Departures, EnvironmentSettings, Task
from vla_attention.capture.environments.libero_assets import find_assets
from vla_attention.capture.environments.libero_beginnings import beginning_of
from vla_attention.capture.environments.libero_installation import load_libero, package_folder
from vla_attention.capture.environments.libero_pro import (
    check_pro_assets,
    own_name,
    pro_initial_states,
    pro_task_file,
    register_objects,
)
from vla_attention.capture.environments.simulator import SimulatedEnvironment, goal_of
from vla_attention.schemas.checked_files import check_regular
from vla_attention.schemas.episode_steps import Displaced, TaskGoal
from vla_attention.schemas.errors import BadArgument, UserError, look_up
from vla_attention.schemas.groupings.vocabulary import SceneObject


def load_initial_states(path: Path) -> NDArray[np.float64]:
    """Read the stored initial states of a task, (state, 1 + position + velocity) float64: flattened MuJoCo states.

    The files are numpy arrays, written by torch.save with numpy 1. torch's restricted reader opens them if the few
    functions that rebuild an array are allowed. No other code in a file can run.

    Raises:
        UnusableTask: the file is missing, damaged, or holds anything else.
    """
    from vla_attention.capture.torch_files import load_torch

    rebuild = np.empty(0).__reduce__()[0]
    array_types = [
        (rebuild, "numpy.core.multiarray._reconstruct"),
        rebuild,
        np.ndarray,
        np.dtype,
        type(np.dtype(np.float64)),
    ]
    install_again = "install LIBERO again with 'make setup'"
    try:
        states = np.asarray(load_torch(path, UnusableTask, array_types), dtype=np.float64)
    except FileNotFoundError:
        raise UnusableTask(f"There are no initial states at '{path}'; {install_again}.") from None
    except (TypeError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UnusableTask(f"'{path}' holds no initial states ({error}); {install_again}.") from error
    return _checked_states(states, f"'{path}'", install_again)


def _checked_states(states: NDArray[np.float64], origin: str, install_again: str) -> NDArray[np.float64]:
    if states.ndim != 2 or not np.isfinite(states).all():
        raise UnusableTask(
            f"{origin} holds numbers of shape {states.shape}, or NaN; expected (state, number), all finite: "
            f"{install_again}."
        )
    return states


def parent_of_region(name: str, known: Sequence[str]) -> str | None:
    """Return the object or fixture to which `name` belongs, None for the table.

    `name` is a name in `known`, or that of a region (`wine_rack_1_top_region` belongs to `wine_rack_1`).
    """
    owners = [candidate for candidate in known if name == candidate or name.startswith(f"{candidate}_")]
    return max(owners, key=len, default=None)


def _subjects(of_interest: Iterable[str], names: Sequence[str]) -> list[str]:
    """The objects and fixtures, of those names, that a task's file names as its objects of interest."""
    subjects = dict.fromkeys(parent_of_region(name, names) for name in of_interest)
    return [name for name in subjects if name is not None]


@dataclass(frozen=True)
class ResetStart:
    """With what a reset begins: the state of numpy's global generator, and the number of samplers of joints."""

    random_state: Any
    num_joint_samplers: int


class LiberoEnvironment(SimulatedEnvironment):
    """One LIBERO task. An initial state is one of the 50 that are stored with the task.

    What a reset draws: a stored state holds joint positions and velocities, but cabinets, stoves and racks have no
    joint. Every reset places them at random in small regions of the table (measured: up to 18 mm and 3 degrees apart),
    with numbers of numpy's global generator; no step draws any. Two things decide these numbers:

    - The state of the generator. The published loop of openpi seeds it once per task, so the furniture of episode i
      depends on the i resets before it. This class keeps the state that each reset begins with. Episodes in order cost
      nothing; one that is further ahead needs the resets in between once, without drawing.
    - The number of earlier resets. Each one appends further samplers of the joints that the task begins with open or
      switched on (28 of the 130 tasks) to a list of the environment, and every reset draws from all of them.

    So every episode is the published one, alone, in a job array, or after others (`Seeding` has the evaluations).
    """

    def __init__(self, task: Task, settings: EnvironmentSettings, suite_tasks: Sequence[Task] = ()) -> None:
        self._assets = check_pro_assets(task.suite, find_assets(settings.libero_assets))
        self._initial_states = _states_of(task)
        if len(self._initial_states) != task.num_initial_states:
            raise BadArgument(
                f"The installed LIBERO stores {len(self._initial_states)} initial states for '{task.name}' "
                f"instead of {task.num_initial_states}; run 'make setup'."
            )
        self._protocol = settings.protocol
        super().__init__(task, settings, suite_tasks)
        #: The samplers that one reset appends; the environment's construction has appended the first ones.
        self._joint_samplers = tuple(self._simulator.object_property_initializers)
        #: By the run's seed, with what the resets of episodes 0, 1, ... begin, as far as known.
        self._reset_starts: dict[int, list[ResetStart]] = {}

    def _build(self, options: dict[str, Any]) -> Any:
        classes = load_libero(self._assets)
        if own_name(self.task.suite):
            register_objects()
        path = task_file(self.task)
        environment = look_up("problem of LIBERO", str(read_task_file(path).get("problem_name")), classes)
        # The stored state sets the robot's joints, so they need no noise.
        try:
            return self._construct(environment, str(path), initialization_noise=None, **options)
        except UserError:
            raise
        except Exception as error:  # MuJoCo's and LIBERO's own, for a scene that their files do not make
            raise UnusableTask(
                f"The scene of '{self.task.name}' cannot be built from '{path}' and the assets in '{self._assets}' "
                f"({type(error).__name__}: {error})."
            ) from error

    def _reset_seed(self, initial_state_index: int, seed: int) -> int:
        return {"once per task": seed, "per episode": seed + initial_state_index, "always 0": 0}[self._protocol.seeding]

    def missing_resets(self, initial_state_index: int, seed: int) -> int:
        """Return how many resets the episode needs before its own; see `Environment.missing_resets`."""
        if self._protocol.seeding != "once per task":
            return 0
        known = len(self._reset_starts.get(seed, ())) or 1
        return max(0, initial_state_index - (known - 1))

    def known_resets(self, seed: int) -> Sequence[ResetStart]:
        """Return with what the resets of episodes 0, 1, ... begin, as far as known; see `SharesResets`."""
        return tuple(self._reset_starts.get(seed, ()))

    def learn_resets(self, seed: int, resets: Sequence[ResetStart]) -> None:
        """Take over what another environment of this task knows; see `SharesResets`."""
        if len(resets) > len(self._reset_starts.get(seed, ())):
            self._reset_starts[seed] = list(resets)

    def _reset_simulator(self, initial_state_index: int, seed: int) -> None:
        if self._protocol.seeding != "once per task":
            resets = self._protocol.earlier_resets + initial_state_index
            self._reset_from(ResetStart(np.random.get_state(), (1 + resets) * len(self._joint_samplers)))  # noqa: NPY002
            return
        starts = self._reset_starts.setdefault(seed, [])
        if not starts:
            starts.append(ResetStart(np.random.get_state(), len(self._joint_samplers)))  # noqa: NPY002
        while len(starts) <= initial_state_index:
            starts.append(self._reset_from(starts[-1], can_draw=False))
        following = self._reset_from(starts[initial_state_index])
        if len(starts) == initial_state_index + 1:
            starts.append(following)

    def _reset_from(self, start: ResetStart, can_draw: bool = True) -> ResetStart:
        """Reset with the random numbers of `start`; return with what the next reset begins."""
        samplers = self._simulator.object_property_initializers
        samplers[:] = itertools.islice(itertools.cycle(self._joint_samplers), start.num_joint_samplers)
        np.random.set_state(start.random_state)  # noqa: NPY002
        self._reset_once(can_draw)
        return ResetStart(np.random.get_state(), len(samplers))  # noqa: NPY002

    def _set_initial_state(self, initial_state_index: int) -> None:
        self._initial_state_index = initial_state_index
        simulation = self._simulator.sim
        state = self._initial_states[initial_state_index]
        expected = 1 + simulation.model.nq + simulation.model.nv
        if state.size != expected:
            raise BadArgument(
                f"The stored initial states of '{self.task.name}' have {state.size} numbers, but its scene has "
                f"{expected}; the LIBERO package and the assets in '{self._assets}' do not belong together."
            )
        simulation.set_state_from_flattened(state)
        simulation.forward()
        # These three calls are the protocol's: objects adopt the new state (a stove that is on turns red), and the
        # forced update of the observables advances the cameras' timer.
        self._simulator._check_success()
        self._simulator._post_process()
        self._simulator._update_observables(force=True)

    def _scene_goals(self) -> Sequence[TaskGoal]:
        self._conditions_of = goals_of_scene(self.task, self._suite_tasks)
        names, goals = [*self._simulator.objects_dict, *self._simulator.fixtures_dict], []
        for task, conditions in self._conditions_of.items():
            of_interest = read_task_file(task_file(task))["obj_of_interest"]
            goals.append(goal_of(task, map(" ".join, conditions), _subjects(of_interest, names)))
        return goals

    def departures(self) -> Departures:
        """Return how the scene is not that of the published evaluations after the waiting steps."""
        expected = beginning_of(self.task.suite, self.task.task_id, self._initial_state_index)
        if expected is None:
            return NO_DEPARTURES
        lost = [words for words in expected.relations if not self._simulator._eval_predicate(list(words))]
        displaced = expected.displaced(dict(zip(self.bodies, self.moment().poses[:, :3], strict=True)))
        return Departures(
            tuple(f"{first} {predicate} {second}" for predicate, first, second in lost),
            tuple(Displaced(name, round(distance, 3)) for name, distance in displaced.items()),
        )

    def _held(self) -> Sequence[bool]:
        simulator = self._simulator
        things = [simulator.get_object(name).object_properties for name in simulator.visualization_sites_list]
        # LIBERO's predicates of a stove write whether its burner is seen, which the next picture would show.
        shown = [dict(properties["vis_site_names"]) for properties in things]
        conditions = {one: None for of_task in self._conditions_of.values() for one in of_task}
        holds = {one: bool(simulator._eval_predicate(list(one))) for one in conditions}
        for properties, before in zip(things, shown, strict=True):
            properties["vis_site_names"].update(before)
        return [all(holds[one] for one in of_task) for of_task in self._conditions_of.values()]

    def _describe_objects(self) -> tuple[Iterable[SceneObject], Mapping[str, Sequence[str]]]:
        movable, fixed = self._simulator.objects_dict, self._simulator.fixtures_dict
        names = [*movable, *fixed]
        subjects = _subjects(self._simulator.obj_of_interest, names)
        described = [
            *(SceneObject(name, "object", name in subjects) for name in movable),
            *(SceneObject(name, "fixture", name in subjects) for name in fixed),
        ]
        return described, {name: [thing.root_body] for name, thing in (movable | fixed).items()}


def _states_of(task: Task) -> NDArray[np.float64]:
    if own_name(task.suite):
        return _checked_states(
            pro_initial_states(task), f"'{task.name}' of {task.suite}", "install vla-attention again"
        )
    return load_initial_states(package_folder() / "init_files" / task.suite / f"{task.name}.pruned_init")


def task_file(task: Task) -> Path:
    """Return the path of the file that says what is in a task's scene, and its goal."""
    if own_name(task.suite):
        return pro_task_file(task)
    return package_folder() / "bddl_files" / task.suite / f"{task.name}.bddl"


def read_task_file(path: Path) -> dict[str, Any]:
    """Return what LIBERO's parser reads of a task file; `UnusableTask` for one that it must not or cannot read."""
    from libero.libero.envs.bddl_utils import robosuite_parse_problem

    check_task_file(path)
    try:
        parsed: dict[str, Any] = robosuite_parse_problem(str(path))
    except Exception as error:  # whatever the parser's own code meets
        raise UnusableTask(
            f"The task file '{path}' cannot be read ({type(error).__name__}: {error}); install LIBERO again with "
            "'make setup'."
        ) from error
    return parsed


#: What of a task's file is its scene. The sentence, the goal and the objects of interest are the task's own.
_SCENE = ("problem_name", "fixtures", "objects", "regions", "scene_properties", "initial_state")


def goals_of_scene(task: Task, tasks: Sequence[Task]) -> dict[Task, tuple[tuple[str, ...], ...]]:
    """Return the tasks that share a task's scene, itself among them, with the conditions of their goals.

    A condition is a predicate with its objects. The initial states of such tasks are drawn from one distribution; which
    ones are stored with a task is the task's own. LIBERO must have been loaded.
    """
    scene = scene_of(task)
    return {
        one: tuple(tuple(condition) for condition in read_task_file(task_file(one))["goal_state"])
        for one in tasks
        if scene_of(one) == scene
    }


def scene_of(task: Task) -> list[Any]:
    """Return what tasks of one scene share, of a task's file; LIBERO must have been loaded."""
    parsed = read_task_file(task_file(task))
    return [parsed[part] for part in _SCENE]


#: Bytes of a task file; LIBERO's have up to 3,300.
_MAX_TASK_FILE_BYTES = 1_000_000
#: Parentheses in one another; LIBERO's have eight. Its parser compares and prints what it reads by recursion.
_MAX_TASK_FILE_DEPTH = 64
#: The attribute that is evaluated. Nothing but numbers may stand beside it.
_EVALUATED = ":yaw_rotation"
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?")


class UnusableTask(UserError, ValueError):
    """A task's files in LIBERO, or its assets, make no scene."""


def check_task_file(path: Path) -> None:
    """Raise `UnusableTask` unless a task file is small, balanced, and evaluates numbers only."""
    try:
        size = check_regular(path, UnusableTask)
        if size > _MAX_TASK_FILE_BYTES:
            raise UnusableTask(f"'{path}' has {size} bytes; a task file of {_MAX_TASK_FILE_BYTES} at most is read.")
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise UnusableTask(f"There is no task file at '{path}'; install LIBERO again with 'make setup'.") from None
    except (OSError, UnicodeError) as error:
        raise UnusableTask(f"The task file '{path}' cannot be read ({error}).") from error
    # As the parser does it: comments, case, words.
    words = re.findall(r"[()]|[^\s()]+", re.sub(r";.*$", "", text, flags=re.MULTILINE).lower())
    # For each open parenthesis whether it, or one around it, has the attribute.
    evaluated = [False]
    for word in words:
        if word == "(":
            evaluated.append(evaluated[-1])
        elif word == ")":
            evaluated.pop()
        elif word == _EVALUATED:
            evaluated[-1] = True
        elif evaluated[-1] and not _NUMBER.fullmatch(word):
            raise UnusableTask(
                f"The task file '{path}' has '{word}' as an angle ({_EVALUATED}), which LIBERO would execute; expected "
                "numbers. Nothing of it was executed."
            )
        if not 1 <= len(evaluated) <= _MAX_TASK_FILE_DEPTH:
            raise UnusableTask(
                f"The task file '{path}' has unbalanced parentheses, or more than {_MAX_TASK_FILE_DEPTH} deep."
            )
