"""The base of reruns by itself: its question, and the attention of its episodes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import polars as pl

from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.measures.frames import LAYERS_AVG
from vla_attention.analyze.measures.question import Question
from vla_attention.schemas.groupings.grouping import Grouping


@dataclass(frozen=True)
class Analysis:
    """A question with the ratios of its episodes."""

    question: Question
    headline: Any = None
    contribution_rows: pl.DataFrame | None = None

    @property
    def grouping(self) -> Grouping:
        """The groups and the ratio."""
        return self.question.grouping

    @cached_property
    def episodes(self) -> pl.DataFrame:
        """`Levels.episodes`."""
        return levels_of(self.question).episodes()

    @property
    def overall(self) -> dict[str, Any]:
        """Number of episodes, and the layer that numbers are of."""
        return {"num_episodes": len(self.question.selected), "layer": LAYERS_AVG}
