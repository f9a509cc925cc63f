"""Which episodes of a data set a command line names."""

from __future__ import annotations

import re
from collections.abc import Sequence

from vla_attention.capture.replay.lerobot_dataset import LeRobotDataset
from vla_attention.schemas.errors import BadArgument


def chosen_episodes(data: LeRobotDataset, words: Sequence[str] | None, limit: int | None) -> tuple[int, ...]:
    """Return the numbers of episodes, in their order.

    Args:
        data: the data set.
        words: numbers and ranges (`3-7`, both ends included); None for all.
        limit: so many at most, the first ones; None for all.

    Raises:
        UnknownName: an episode does not exist.
        BadArgument: a word is no number and no range, or nothing is left.
    """
    chosen: set[int] = set()
    for word in words if words is not None else ():
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", word)
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise BadArgument(f"Cannot use --episodes {word}; expected a number, or a range as 3-7.")
        first, last = int(match[1]), int(match[2] or match[1])
        data.entry(first)
        data.entry(last)  # before a long range is counted
        chosen.update(range(first, last + 1))
    if words is None:
        chosen = set(data.info.episodes)
    if limit is not None and limit < 1:
        raise BadArgument(f"Cannot use --num-episodes {limit}; expected at least 1.")
    numbers = tuple(data.entry(index).index for index in sorted(chosen)[:limit])
    if not numbers:
        raise BadArgument(f"The data set '{data.name}' has no episodes.")
    return numbers
