"""The simulator's part of an episode: reset, waiting steps, and the steps between two policy calls.

It needs no torch, so that processes that only simulate start fast and stay small.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from vla_attention.capture.environments.base import (
    NO_DEPARTURES,
    Departures,
    Environment,
    Moment,
    Observation,
    TellsMoments,
    camera_frame,
)
from vla_attention.capture.environments.coverage import camera_coverage
from vla_attention.capture.environments.episode_protocol import WAIT_ACTION
from vla_attention.capture.environments.robosuite_installation import first_exception
from vla_attention.schemas.episode_steps import TaskGoal
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.layout import PatchGrid
from vla_attention.schemas.stores.store_format import PolicyCameraView, Protocol

#: Raises an exception when the process shall stop.
StopCheck = Callable[[], None]


class SimulationFailed(UserError, RuntimeError):
    """A simulator raised an error, or gave what cannot be. Its episode is lost; a new simulator may do better.

    reason: what went wrong, the same in every episode that meets it; empty where the class says it.
    """

    def __init__(self, sentence: str, reason: str = "") -> None:
        super().__init__(sentence)
        self.reason = reason


@contextmanager
def naming_the_simulator(title: str) -> Iterator[None]:
    """Turn an error of a simulator into `SimulationFailed`, with the episode's title; mistakes of users stay."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise failure(title, error) from error


def failure(title: str, error: Exception) -> SimulationFailed:
    """Return an error of a simulator with the episode's title, the first exception that led to it, and its line."""
    first = first_exception(error)
    at = (traceback.extract_tb(first.__traceback__) or traceback.extract_tb(error.__traceback__))[-1]
    text = " ".join(str(first).split()).rstrip(".")
    reason = f"{type(first).__name__}, {Path(at.filename).name}:{at.lineno}"
    return SimulationFailed(
        f"The simulator of {title} failed: {text} ({reason}). Nothing of this episode was kept.", reason
    )


@dataclass(frozen=True)
class CameraPatches:
    """A camera of the policy, and the grids of patches that tile its model image, in key order."""

    view: PolicyCameraView
    grids: tuple[PatchGrid, ...]


@dataclass(frozen=True)
class Seen:
    """What a policy call gets from the simulator.

    coverage: policy camera -> (patch, object) float32, how much of each patch each object covers.
    """

    observation: Observation
    coverage: dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Begun:
    """The beginning of an episode; `initial_state_digest` and `objects` as in `Environment`.

    bodies, goals: as in `TellsMoments`; None where the environment tells none.
    """

    initial_state_digest: str
    objects: tuple[SceneObject, ...]
    bodies: tuple[str, ...] | None = None
    goals: tuple[TaskGoal, ...] = ()


@dataclass(frozen=True)
class Advanced:
    """What some steps gave: their number, whether the task is solved, and what the next policy call gets, if any.

    moments: after each of the steps, or after the waiting steps; none where the environment tells none.
    departures: after the waiting steps, as in `TellsMoments`.
    """

    steps: int
    success: bool
    seen: Seen | None
    moments: tuple[Moment, ...] = ()
    departures: Departures = NO_DEPARTURES


@dataclass
class Simulation:
    """One environment and the episode that runs in it.

    cameras: those of the policy. check: called before every environment step; an exception that it raises ends the
    episode.
    """

    environment: Environment
    protocol: Protocol
    cameras: Sequence[CameraPatches]
    check: StopCheck = lambda: None

    def begin(self, state: int, what: str, told: int | None = None) -> Begun:
        """Reset to the stored initial state of that number; what: the episode's title in messages.

        told: the task of the scene whose goal ends the episode; None: the environment's own.

        Raises:
            SimulationFailed: the simulator raised an error; `wait` and `advance` do the same.
        """
        self._what, self._step, self._replan = what, 0, 0
        self._told: int | None = None
        with naming_the_simulator(what):
            environment = self.environment
            environment.reset(state, self.protocol.seed)
            begun = Begun(environment.initial_state_digest, tuple(environment.objects))
            if not isinstance(environment, TellsMoments):
                return begun
            goals = environment.goals
            if told is not None:
                self._told = [goal.task_id for goal in goals].index(told)
                things = goals[self._told].things
                named = (structs.replace(thing, of_interest=thing.name in things) for thing in begun.objects)
                begun = replace(begun, objects=tuple(named))
            return replace(begun, bodies=environment.bodies, goals=goals)

    def wait(self) -> Advanced:
        """Make the waiting steps, in which objects come to rest; only the last one is observed."""
        if self.protocol.wait_steps < 1:
            raise ValueError(
                "an episode needs at least one waiting step: the first picture is the one after the last of them"
            )
        action = np.array(WAIT_ACTION)
        with naming_the_simulator(self._what):
            for i in range(self.protocol.wait_steps):
                self.check()
                observation = self.environment.step(action, observe=i == self.protocol.wait_steps - 1).observation
            seen = None if observation is None else self._seen(observation)
            departures = self.environment.departures() if isinstance(self.environment, TellsMoments) else NO_DEPARTURES
            return Advanced(0, False, seen, self._moment(), departures)

    def advance(self, actions: NDArray[np.float64], observe: bool) -> Advanced:
        """Execute actions (step, 7) until the task is solved; with `observe` the last one is observed.

        Only the picture before the next replan is drawn, because the policy sees no other.
        """
        observation, moments = None, list[Moment]()
        with naming_the_simulator(self._what):
            for i, action in enumerate(actions):
                self.check()
                result = self.environment.step(action, observe=observe and i == len(actions) - 1)
                self._step += 1
                observation = result.observation
                moments += self._moment()
                if result.success if self._told is None else moments[-1].held[self._told]:
                    return Advanced(i + 1, True, None, tuple(moments))
            self._replan += 1
            seen = None if observation is None else self._seen(observation)
            return Advanced(len(actions), False, seen, tuple(moments))

    def _moment(self) -> tuple[Moment, ...]:
        return (self.environment.moment(),) if isinstance(self.environment, TellsMoments) else ()

    def _seen(self, observation: Observation) -> Seen:
        return Seen(observation, {camera.view.name: self._coverage(camera, observation) for camera in self.cameras})

    def _coverage(self, camera: CameraPatches, observation: Observation) -> NDArray[np.float32]:
        view = camera.view
        expected = camera_frame(observation, view.source).shape[:2]
        segmentation = self.environment.segmentation(view.source)
        try:
            if segmentation.shape != expected or segmentation.dtype.kind not in "iu":
                raise BadArgument(
                    f"The segmentation has the shape {segmentation.shape} and type {segmentation.dtype}; expected "
                    f"whole numbers for the picture's {expected} pixels."
                )
            return camera_coverage(
                segmentation,
                len(self.environment.objects),
                camera.grids,
                flip_rows=view.upright,
                flip_columns=view.mirrored,
                visible=view.visible,
            )
        except BadArgument as error:
            where = f"replan {self._replan} (environment step {self.protocol.wait_steps + self._step}) of {self._what}"
            raise BadArgument(f"Cannot store {where}, camera '{view.source}': {error}") from None
