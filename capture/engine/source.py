"""Where the policy calls of episodes come from: simulators, a store, or the frames of a data set.

`loop.py` begins episodes of a source, makes their policy calls, and stores them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.engine.call import Caller, PolicyCall
from vla_attention.capture.engine.progress import say
from vla_attention.capture.environments.base import Task
from vla_attention.capture.store.replan_records import EpisodeStart, RecordedSteps
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.stores.store_format import episode_name
from vla_attention.schemas.stores.store_place import bytes_below


@dataclass(frozen=True)
class EpisodeJob:
    """An episode that is to be recorded.

    size: most units of it, for the progress; title: its name there. scene, state: in an exchange, the task that it
    begins like, and the number of the initial state; else its own task and index.
    """

    task: Task
    episode_index: int
    size: int
    title: str
    scene: Task | None = None
    state: int | None = None

    @property
    def name(self) -> str:
        """The episode's name in the store."""
        return episode_name(self.task.task_id, self.episode_index)

    @property
    def begins_as(self) -> tuple[int, int]:
        """The task in whose scene it begins, and the number of the initial state."""
        task = self.task if self.scene is None else self.scene
        return task.task_id, self.episode_index if self.state is None else self.state


def episode_start(
    job: EpisodeJob,
    machine: Mapping[str, str],
    *,
    state_digest: str,
    objects: tuple[SceneObject, ...] = (),
    state_index: int | None = None,
    scene_task_id: int | None = None,
) -> EpisodeStart:
    """Return what is known of an episode before its first replan.

    machine: provenance of this process. state_digest, state_index: of the initial state, whose index is the job's
    where none is given. scene_task_id: of an exchanged episode that is run again; else the job's.
    """
    task = job.task
    return EpisodeStart(
        task_id=task.task_id,
        task_name=task.name,
        instruction=task.instruction,
        episode_index=job.episode_index,
        initial_state_index=job.begins_as[1] if state_index is None else state_index,
        initial_state_digest=state_digest,
        objects=objects,
        provenance={**machine, **({"task file says": task.file_sentence} if task.file_sentence else {})},
        task_family=task.task_family,
        scene_task_id=scene_task_id if job.scene is None else job.scene.task_id,
    )


@dataclass(frozen=True)
class Outcome:
    """How an episode ended. success: None where it is not known. steps: None where no simulator told them."""

    success: bool | None
    num_steps: int
    steps: RecordedSteps | None = None


@dataclass(frozen=True)
class Committed:
    """An episode that is in the store, with so many replans. A source without a `Caller` commits episodes itself."""

    outcome: Outcome
    num_replans: int
    folder: Path

    @property
    def num_bytes(self) -> int:
        """Bytes of its files."""
        return bytes_below(self.folder)


class Episode(ABC):
    """An episode that is under way.

    Attributes:
        start: what the store says of it; known with its first policy call.
        done: steps or calls so far.
        connection: where it hears of what it waits for; None for one that never waits.
    """

    start: EpisodeStart
    done: int = 0
    connection: Connection | None = None

    @abstractmethod
    def poll(self) -> PolicyCall | Outcome | Committed | None:
        """Go on, and return the next policy call, or how the episode ended; None: neither is there yet.

        Raises:
            SourceLost: what it runs in has ended; it may be begun again.
            SimulationFailed, and other faults of this episode alone (`faults.py`).
        """

    def advance(self, actions: NDArray[np.float64]) -> None:
        """Take what the last policy call gave, (horizon, action dim); where nothing is executed, it is only counted."""
        self.done += 1

    def overdue(self) -> str | None:
        """Return how it hangs, in the words of `SourceLost`; None while it does not."""
        return None

    def close(self, error: Exception | None = None) -> None:  # noqa: B027
        """Give back what it runs in. error: the fault with which it ended."""


class Source(ABC):
    """Begins episodes.

    Attributes:
        caller: makes their policy calls; None where the source makes them itself.
        capacity: episodes that run at a time, at most.
        say: prints a line for the person at the terminal.
    """

    caller: Caller | None
    capacity: int = 1
    say: Callable[[str], None] = staticmethod(say)

    def choose(self, left: Sequence[EpisodeJob]) -> int | None:
        """Return the place of the episode to begin next; None: none now."""
        return 0

    @abstractmethod
    def open(self, job: EpisodeJob) -> Episode:
        """Begin an episode."""

    def close(self) -> None:  # noqa: B027
        """Free what was made ready."""


class SourceLost(Exception):
    """What an episode ran in has ended, or was ended because it hung; the text says how."""
