"""The ratio over an episode as a small inline SVG: where its lines, marks and texts are. Pure functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.show.numbers import format_number

#: Marks of the axis that are nearer than this (in the units of the picture) would write over each other.
_LEAST_DISTANCE = 12


@dataclass(frozen=True)
class Point:
    """A replan in the picture, in tenths of a unit; `y` is None where the ratio is not finite or 0."""

    x: float
    y: float | None


@dataclass(frozen=True)
class Mark:
    """A value on the axis."""

    y: float
    text: str


@dataclass(frozen=True)
class RatioCurve:
    """The picture of one episode, in the units of its view box.

    Attributes:
        points: one per replan.
        lines: the points of each polyline, in SVG's notation; ratios that are not finite are gaps.
        marks: lowest and highest ratio on the axis; one when they would write over each other.
        uniform: the mean uniform ratio; None where it cannot be drawn.
        first_step, last_step: environment steps of the first and the last replan.
        description: the curve in words.
    """

    width: ClassVar[int] = 560
    height: ClassVar[int] = 130
    left: ClassVar[int] = 46
    right: ClassVar[int] = 550
    top: ClassVar[int] = 16
    bottom: ClassVar[int] = 106
    points: Sequence[Point]
    lines: Sequence[str]
    marks: Sequence[Mark]
    uniform: Mark | None
    first_step: int
    last_step: int
    description: str

    @property
    def uniform_text_y(self) -> float | None:
        """Height of the text of the uniform ratio: above its line, or below where there is no room."""
        if self.uniform is None:
            return None
        return round(self.uniform.y + (-4 if self.uniform.y > self.top + 14 else 13), 1)


def ratio_curve(
    ratio: NDArray[np.float64], uniform: NDArray[np.float64] | None, env_step: NDArray[np.int64]
) -> RatioCurve | None:
    """The curve of an episode's ratios, on a logarithmic axis; None when no ratio is finite and positive.

    Args:
        ratio: (replan,), not finite or 0 where there is nothing to draw.
        uniform: (replan,), ratios that uniform attention would give.
        env_step: (replan,), environment steps.
    """
    drawable = np.isfinite(ratio) & (ratio > 0)
    if not drawable.any():
        return None
    logs = np.log2(np.where(drawable, ratio, np.nan))
    known = uniform is not None and bool(np.isfinite(uniform).any() and (uniform > 0).all())
    low, high = _limits(logs, uniform)

    def height(value: float) -> float:
        share = (high - value) / (high - low)
        return round(RatioCurve.top + share * (RatioCurve.bottom - RatioCurve.top), 1)

    points = [
        Point(x, None if np.isnan(log) else height(log))
        for x, log in zip(_places(env_step), logs.tolist(), strict=True)
    ]
    least, most = float(ratio[drawable].min()), float(ratio[drawable].max())
    marks = sorted({Mark(height(np.log2(value)), format_number(value)) for value in (least, most)}, key=lambda m: m.y)
    if len(marks) == 2 and marks[1].y - marks[0].y < _LEAST_DISTANCE:
        marks = marks[:1]
    mean_uniform = float(np.nanmean(uniform)) if known and uniform is not None else None
    first, last = int(env_step[0]), int(env_step[-1])
    return RatioCurve(
        points=points,
        lines=_lines(points),
        marks=marks,
        uniform=None if mean_uniform is None else Mark(height(np.log2(mean_uniform)), format_number(mean_uniform)),
        first_step=first,
        last_step=last,
        description=f"Ratio from step {first} to {last}: lowest {format_number(least)}, highest {format_number(most)}",
    )


def _places(env_step: NDArray[np.int64]) -> list[float]:
    """The x of every replan; in the middle when there is one."""
    steps = env_step.astype(np.float64)
    length = steps[-1] - steps[0]
    if not length:
        return [RatioCurve.width / 2] * len(steps)
    places = RatioCurve.left + (steps - steps[0]) / length * (RatioCurve.right - RatioCurve.left)
    return [round(place, 1) for place in places.tolist()]


def _limits(logs: NDArray[np.float64], uniform: NDArray[np.float64] | None) -> tuple[float, float]:
    """Limits of the axis (base-2 logarithms), at least a factor of two apart; they include the uniform ratio."""
    known = [logs[np.isfinite(logs)]]
    if uniform is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            of_uniform = np.log2(uniform)
        known.append(of_uniform[np.isfinite(of_uniform)])
    every = np.concatenate(known)
    low, high = float(every.min()), float(every.max())
    room = max(0.08 * (high - low), 0.5 * (1.0 - (high - low)), 0.05)
    return low - room, high + room


def _lines(points: Sequence[Point]) -> list[str]:
    """Neighbouring points as polylines; a single point becomes a line of length 0, which round ends make a dot."""
    lines: list[list[str]] = [[]]
    for point in points:
        if point.y is None:
            lines.append([])
        else:
            lines[-1].append(f"{point.x},{point.y}")
    return [" ".join(line if len(line) > 1 else line * 2) for line in lines if line]
