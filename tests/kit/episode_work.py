"""Functions for workers in other processes, which find them by name."""

from __future__ import annotations

import os
import signal
from dataclasses import fields
from pathlib import Path

from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import CorruptEpisode


def square(number: int) -> int:
    return number * number


def process_of(number: int) -> int:
    return os.getpid()


def seen(item: SelectedEpisode) -> tuple[SelectedEpisode, StoredEpisode, int, int]:
    """The episode, a part of it, how many episodes its store has here, and how much of it was read already."""
    read = vars(item.episode).keys() - {one.name for one in fields(item.episode)}
    return item, item.episode, len(item.store.episodes), len(read)


def damaged(number: int) -> int:
    if number >= 2:
        raise CorruptEpisode(f"Episode {number} is damaged.")
    return number


def defect(number: int) -> int:
    raise ZeroDivisionError(f"a defect at {number}")


def die_once(number: int, marker: Path) -> int:
    """End this process as the system does when memory lacks, the first time that number 3 comes."""
    if number == 3 and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die_always(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def refused(kind: type[UserError]) -> None:
    """Raise an error for users, caused by one that cannot travel."""
    try:
        raise ValueError(lambda: None)
    except ValueError as error:
        raise kind("one sentence") from error
