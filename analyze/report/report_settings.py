"""How much a report contains."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from vla_attention.schemas.errors import BadArgument


@dataclass(frozen=True)
class ReportSettings:
    """How much a report contains.

    Attributes:
        episodes: number of episodes with overlays.
        replans: number of replans of each, at most.
        rows: include sinks, words and objects, which need every row to be read.
        reruns: reruns of the store, or folders of them (`effects.reruns`).

    Raises `BadArgument` for fewer than 0 episodes or 1 replan.
    """

    episodes: int = 4
    replans: int = 24
    rows: bool = True
    reruns: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if self.episodes < 0 or self.replans < 1:
            raise BadArgument(
                f"Cannot show {self.episodes} episodes with {self.replans} replans each; expected --episodes from 0 "
                "and --replans from 1."
            )
