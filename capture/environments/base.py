"""The interface of a simulation environment, and the data that crosses it: suites, tasks, observations.

Code outside this folder needs neither MuJoCo nor robosuite. An environment draws pictures only on request: a policy
needs a picture about every fifth step, and drawing takes most of the time of a step.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

from vla_attention.capture.environments.episode_protocol import OPENPI, EvaluationProtocol
from vla_attention.schemas.errors import BadArgument, look_up

# Command lines read suites and settings from here, and print their help without waiting for a library.
if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from vla_attention.schemas.episode_steps import Displaced, TaskGoal
    from vla_attention.schemas.groupings.vocabulary import SceneObject

#: Name of the scene object that stands for the arm, its gripper and its mount.
ROBOT = "robot"
#: Name of the scene object that stands for everything without a name of its own: table, floor, walls, sky.
BACKGROUND = "background"


@dataclass(frozen=True)
class Suite:
    """A set of tasks and the limits of their evaluation. `suites.py` lists all suites.

    kind: the simulator. "libero" needs the LIBERO package and its assets; "robosuite" (its own tasks) and "cubes"
        (language-conditioned tasks on robosuite) need no download.
    max_steps: policy steps after which an episode counts as failed, as in openpi's evaluation. Other protocols may have
        other numbers (`episode_protocol.py`).
    perturbs: of a suite of LIBERO-PRO, the suite whose tasks it changes.
    simulator_bytes: memory of one simulator in a process of its own, the most of the tasks that were measured (LIBERO's
        with its original assets), rounded up.
    """

    name: str
    kind: Literal["libero", "robosuite", "cubes"]
    num_tasks: int
    max_steps: int
    initial_states_per_task: int
    simulator_bytes: float
    perturbs: str = ""


@dataclass(frozen=True)
class Task:
    """One task of a suite.

    instruction: the sentence that the policy gets.
    num_initial_states: number of stored initial states; an episode selects one by its index.
    task_family: the sentence template that it shares with other tasks (`task_families.py`); empty: none known.
    file_sentence: of a task of LIBERO-PRO, what its file says: not always what is told.
    """

    suite: str
    task_id: int
    name: str
    instruction: str
    num_initial_states: int
    task_family: str = ""
    file_sentence: str = ""


#: Name, instruction and family of a task.
TaskTexts = tuple[str, str, str]


@dataclass(frozen=True)
class EnvironmentSettings:
    """The choices of a user about an environment.

    protocol: the evaluation whose picture size and, in LIBERO, whose resets are used. The built-in suite has seeds of
        its own.
    libero_assets: the folder of LIBERO's assets; None searches the places that `libero_assets.find_assets` lists.
    """

    protocol: EvaluationProtocol = OPENPI
    libero_assets: Path | None = None


@dataclass(frozen=True)
class Observation:
    """What the robot perceives at one moment. Pictures and numbers come from the same physics substep.

    images: camera name -> (height, width, 3) uint8, as robosuite and LIBERO return it, which is OpenGL's order: row 0
        is the BOTTOM edge of the camera's view, column 0 its LEFT edge. Reversing the rows alone shows the scene as a
        person sees it. Policies trained on LIBERO reverse rows and columns (a rotation by 180 degrees): their input is
        upright with left and right exchanged.
    eef_pos: (3,) float64, position of the gripper site in metres, world frame.
    eef_quat: (4,) float64, orientation as a quaternion in the order x, y, z, w: of the body above the gripper, not of
        the gripper site. robosuite gives this one, and policies are trained with it.
    gripper_qpos: (2,) float64, positions of the two finger joints in metres.
    """

    images: Mapping[str, NDArray[np.uint8]]
    eef_pos: NDArray[np.float64]
    eef_quat: NDArray[np.float64]
    gripper_qpos: NDArray[np.float64]


@dataclass(frozen=True)
class StepResult:
    """The result of one step: whether the task is solved now, and the observation if it was requested."""

    success: bool
    observation: Observation | None


@dataclass(frozen=True)
class Moment:
    """Where things are at the end of a step, what the gripper touches, and which goals hold.

    poses: (body, 7) float32, position in metres and orientation as a quaternion (w, x, y, z), world frame: of the
        gripper's site, then of the root bodies of objects.
    gripper: (finger,) float32, positions of the finger joints in metres.
    touched: (body,) bool. A touch that begins and ends within a step is not seen.
    held: (goal,) bool.
    """

    poses: NDArray[np.float32]
    gripper: NDArray[np.float32]
    touched: NDArray[np.bool_]
    held: NDArray[np.bool_]


@dataclass(frozen=True)
class Departures:
    """How a scene is not that of the published evaluations; both as in `EpisodeSteps`."""

    lost_relations: tuple[str, ...] = ()
    displaced: tuple[Displaced, ...] = ()


#: None are known.
NO_DEPARTURES = Departures()


class Environment(Protocol):
    """One task in one simulator.

    An episode is one `reset`, the waiting steps of `episode_protocol.py`, and then the policy's steps. No observation
    exists before the first step: the first picture of the protocol is the one after the last waiting step, so request
    it there with `observe=True`.

    objects: the scene objects, in the order of the indices that `segmentation` returns.
    """

    objects: tuple[SceneObject, ...]

    def reset(self, initial_state_index: int, seed: int) -> None:
        """Begin an episode from a stored initial state. It is the same whatever ran before.

        An episode's index is that of its initial state. Where the published evaluation seeds once per task, the resets
        of the lower indices are part of the episode; those that this environment has not made yet are made first.
        """

    def missing_resets(self, initial_state_index: int, seed: int) -> int:
        """Return the number of other resets that `reset` with these arguments would make first."""

    @property
    def initial_state_digest(self) -> str:
        """SHA-256 (hex) of the float64 bytes (time, qpos, qvel) of the initial state of the current episode."""

    def step(self, action: NDArray[np.floating], observe: bool) -> StepResult:
        """Advance by one control step with an action of shape (7,): six pose deltas and the gripper.

        Pictures are drawn only with `observe=True`. They are bit-identical to the pictures that drawing at every step
        gives.
        """

    def segmentation(self, camera: str) -> NDArray[np.int32]:
        """Return (height, width) indices into `objects` for the LAST observed picture of `camera`, pixel by pixel."""

    def close(self) -> None:
        """Free the simulator and its drawing context. A second call does nothing."""


@runtime_checkable
class SharesResets(Protocol):
    """An `Environment` that can be told what another one of the same task found out about resets.

    Then it need not make the resets that `missing_resets` counts, and its episodes are the same.
    """

    def known_resets(self, seed: int) -> Sequence[Any]:
        """Return what is known of the resets with a seed of the run, as `learn_resets` takes it. It can be pickled."""

    def learn_resets(self, seed: int, resets: Sequence[Any]) -> None:
        """Take over what another environment knows, if it knows more."""


@runtime_checkable
class TellsMoments(Protocol):
    """An `Environment` that tells where things are after every step. Asking changes nothing: no picture, no state.

    bodies: whose poses a `Moment` has: `HAND`, then objects that have a body. goals: of all tasks that share the scene,
    the environment's own among them.
    """

    bodies: tuple[str, ...]
    goals: tuple[TaskGoal, ...]

    def moment(self) -> Moment:
        """Return what holds after the last step, or after the reset."""

    def departures(self) -> Departures:
        """Return how the scene after the waiting steps is not that of the published evaluations, as far as known."""


def initial_state_seed(scenes: str, index: int) -> int:
    """Return the seed of one initial state, the same on every machine; scenes: a task, or what the scenes are for."""
    return int.from_bytes(hashlib.sha256(f"{scenes}/{index}".encode()).digest()[:4], "little")


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


def camera_frame(observation: Observation, camera: str) -> NDArray[np.uint8]:
    """Return a camera's picture (height, width, 3); `UnknownName` lists the environment's cameras."""
    return look_up("environment camera", camera, observation.images)
