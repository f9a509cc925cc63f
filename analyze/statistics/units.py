"""The units of intervals: tasks and the families they belong to, and what an interval over several tasks is about."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import ArrayLike, NDArray

#: Tasks of fewer families show nothing about tasks like these: an interval with two degrees of freedom is as long as
#: the scale, and how far families differ is not known from three of them.
FEWEST_FAMILIES = 4


class Estimand(StrEnum):
    """What an interval over several tasks is about; see `intervals`."""

    TASKS_LIKE_THESE = "tasks-like-these"
    THESE_TASKS = "these-tasks"

    @property
    def words(self) -> str:
        """The name in running text."""
        return self.value.replace("-", " ")

    @property
    def of_other_tasks(self) -> bool:
        """Whether the interval is about tasks that are not there, so that tasks or their families are the units."""
        return self != Estimand.THESE_TASKS


@dataclass(frozen=True)
class Units:
    """The task of every episode, the family of every task, and what an interval over them is about.

    Attributes:
        tasks: number of each episode's task from 0, (episode,); none is left out.
        families: number of each task's family, (task,), negative for a task of which none is known and that is one of
            its own; None where none is known of any, or where the interval is not about tasks like these.
        estimand: what the interval is about.
    """

    tasks: NDArray[np.intp]
    families: NDArray[np.intp] | None = None
    estimand: Estimand = Estimand.TASKS_LIKE_THESE

    @classmethod
    def of(
        cls,
        tasks: ArrayLike,
        estimand: Estimand = Estimand.TASKS_LIKE_THESE,
        families: ArrayLike | None = None,
    ) -> Units:
        """Units from labels: the task and the family of every episode, (episode,) each.

        Episodes of a task have one family; an empty one is not known, and such a task is a family of its own. Where
        none is known, tasks are the units.
        """
        _, first, numbers = np.unique(np.asarray(tasks), return_index=True, return_inverse=True)
        if families is None or estimand != Estimand.TASKS_LIKE_THESE:
            return cls(numbers, None, estimand)
        names = np.asarray(families, dtype=str)[first]
        places = np.unique(names, return_inverse=True)[1]
        return cls(numbers, np.where(names == "", -1 - np.arange(len(names)), places), estimand).of_tasks(numbers)

    def part(self, chosen: NDArray[np.bool_]) -> Units:
        """The units of some of the episodes, (episode,) bool."""
        return self.of_tasks(self.tasks[chosen])

    def of_tasks(self, tasks: NDArray[np.intp]) -> Units:
        """The units of other episodes of the same tasks, numbers as in `tasks`; tasks without an episode drop out."""
        task_ids, numbers = np.unique(tasks, return_inverse=True)
        families = None if self.families is None else self.families[task_ids]
        known = families is not None and bool((families >= 0).any())
        return replace(self, tasks=numbers, families=families if known else None)

    @property
    def num_tasks(self) -> int:
        """Number of tasks of these episodes."""
        return int(self.tasks.max(initial=-1)) + 1

    @property
    def num_families(self) -> int | None:
        """Number of families of these episodes' tasks; None where none is known."""
        return None if self.families is None else len(np.unique(self.families))

    def decided(self, *classes: NDArray[np.bool_]) -> Units:
        """What can be said: about tasks like these from `FEWEST_FAMILIES` families on, else about these tasks.

        classes: (episode,) bool each, classes of episodes that are compared; each needs as many families.
        """
        parts = [self.part(chosen) for chosen in classes] or [self]
        if all(part.has_enough_families for part in parts):
            return self
        return replace(self, estimand=Estimand.THESE_TASKS, families=None)

    @property
    def about(self) -> dict[str, Any]:
        """Columns of a row: of how many families its tasks are (None: none known), and what its intervals are about."""
        estimand = self.decided().estimand if self.num_tasks > 1 else Estimand.THESE_TASKS
        return {"num_families": self.num_families, "intervals": estimand.value}

    @property
    def words(self) -> str:
        """What the interval is about, in running text."""
        by = "" if self.families is None else f", by {self.num_families} families"
        return f"{self.estimand.words}{by}"

    @property
    def has_enough_families(self) -> bool:
        """Whether the families show something about tasks like these; also where tasks are the units."""
        return self.num_families is None or self.num_families >= FEWEST_FAMILIES

    @property
    def clusters(self) -> NDArray[np.intp]:
        """The unit of every task, (task,): its family, or the task itself."""
        return np.arange(self.num_tasks) if self.families is None else np.unique(self.families, return_inverse=True)[1]

    @property
    def fewest_clusters(self) -> int:
        """With fewer of them there is no interval about other tasks."""
        return 2 if self.families is None else FEWEST_FAMILIES


@dataclass(frozen=True)
class Sampling:
    """What intervals over several tasks are about, and which tasks are related.

    Attributes:
        estimand: what was asked for.
        families: by suite and number those of the tasks that have a known one; tasks of one family may be of different
            suites.
    """

    estimand: Estimand = Estimand.TASKS_LIKE_THESE
    families: Mapping[tuple[str, int], str] = field(default_factory=dict)

    def units(self, table: pl.DataFrame) -> Units:
        """The units of the rows of a table with `suite` and `task_id`, not decided (`Units.decided`)."""
        # Task ids repeat between suites, so a task is a pair of both.
        numbers = table.select(pl.struct("suite", "task_id").rank("dense")).to_series().to_numpy()
        names = table.select("suite", "task_id").unique().sort("suite", "task_id").rows()
        units = Units.of(np.arange(len(names)), self.estimand, [self.families.get(name, "") for name in names])
        return units.of_tasks(numbers.astype(np.intp) - 1)
