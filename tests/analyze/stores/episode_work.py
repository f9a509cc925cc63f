"""Functions for workers in other processes, which find them by name."""

from __future__ import annotations

import os
import signal
import time

from vla_attention.schemas.stores.store_format import CorruptEpisode


def square(number: int) -> int:
    return number * number


def slow_square(number: int) -> int:
    time.sleep(0.05)
    return number * number


def process_of(number: int) -> int:
    return os.getpid()


def damaged(number: int) -> int:
    if number >= 2:
        raise CorruptEpisode(f"Episode {number} is damaged.")
    return number


def defect(number: int) -> int:
    raise ZeroDivisionError(f"a defect at {number}")


def killed_at_two(number: int) -> int:
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number
