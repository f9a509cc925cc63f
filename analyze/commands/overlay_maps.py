"""What moves the action, beside what is read: rows of pictures of `overlay`, where a run has maps of patches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.action_changes import ActionUnits, units_of
from vla_attention.analyze.core.camera_maps import EpisodeMaps, line_levels, scale_end
from vla_attention.analyze.core.map_pictures import HOW, EpisodeMoves, has_map, in_both, shown_lift
from vla_attention.analyze.core.result import Finding
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.schemas.errors import listing, plural

_PLACES = (("top", "middle", "bottom"), ("left", "centre", "right"))
_ROWS = ("read", "moves the action")


def units_of_maps(question: Question, chosen: Sequence[SelectedEpisode]) -> ActionUnits | None:
    """What exact changes are told in; None where no episode has a map of patches."""
    if not any(has_map(item) for item in chosen):
        return None
    return units_of(question.stores, question.settings.units, question.settings.skip_corrupt)


def how_drawn(moved: Sequence[EpisodeMoves]) -> dict[str, Any]:
    """The option `second` of pictures: all maps on one scale, which is not that of attention."""
    high = scale_end(np.concatenate([moves.lifts for moves in moved]))
    marked = "exact call without it" if any(moves.marked for moves in moved) else ""
    how = listing(dict.fromkeys(HOW[moves.way] for moves in moved))
    return {"high": high, "levels": line_levels(high), "unit": "the mean", "marked": marked, "how": how}


def with_rows_of_moves(frame: pl.DataFrame, moves: EpisodeMoves, units: ActionUnits) -> pl.DataFrame:
    """A frame of pictures with attention, with a row of pictures for what moves the action below each camera's."""
    rows = []
    for one in frame.iter_rows(named=True):
        own, at = moves.cameras[one["camera"]], moves.row(one["replan"])
        lift = np.full(own.lift.shape[1:], np.nan) if at is None else shown_lift(own, at)
        marks = [] if at is None else own.marks(at)
        read, moved = ({**one, "row": f"{what}: {one['camera']}", "second": None, "marks": None} for what in _ROWS)
        moved |= {
            "map": None,
            "second": lift.tolist(),
            "marks": [mark[:2] for mark in marks] if moves.marked else None,
            "above": f"step {one['step']}",
            "below": _strongest(lift, marks, units),
        }
        rows += [read, moved]
    numbers = pl.List(pl.List(pl.Float64))
    order = [f"{what}: {camera}" for camera in moves.cameras for what in _ROWS]
    made = pl.DataFrame(rows, {**frame.schema, "second": numbers, "marks": numbers})
    return made.sort(pl.col("row").replace_strict(order, range(len(order))), maintain_order=True)


def _strongest(lift: NDArray[np.float64], marks: Sequence[tuple[float, float, float]], units: ActionUnits) -> str:
    """Of a picture: where the map is highest, and the largest exact change."""
    if not np.isfinite(lift).any():
        return "no map of this call"
    row, column = np.unravel_index(int(np.nan_to_num(lift).argmax()), lift.shape)
    said = f"highest {float(f'{lift[row, column]:.2g}'):g}, {place_in(int(row), int(column), lift.shape)}"
    return f"{said}\nexact: up to {units.short(max(size for *_, size in marks))}" if marks else said


def place_in(row: int, column: int, shape: tuple[int, ...]) -> str:
    """Where a patch is in a picture, in words."""
    vertical, horizontal = (
        part[int(3 * (at + 0.5) / side)] for part, at, side in zip(_PLACES, (row, column), shape, strict=True)
    )
    return f"{vertical} {horizontal}"


def caption_of_moves(second: Mapping[str, Any] | None) -> str:
    """What pictures of what moves the action show; empty without any."""
    if second is None:
        return ""
    lines = " and ".join(f"{level:g}" for level in second["levels"])
    said = (
        f" Moves the action: {second['how']}; on a scale of its own, as so many times the mean patch of the call "
        f"(lines at {lines} times, all of the colour from {second['high']:g} times on)."
    )
    marked = " Squares: patches that were also taken away by an exact call; below, up to how far that moved the action."
    return said + marked * bool(second["marked"])


def of_both(
    question: Question,
    every: Sequence[EpisodeMaps],
    moved: Sequence[EpisodeMoves | None],
    shown: Sequence[Sequence[int]],
) -> list[Finding]:
    """How many of the patches that are read most are among those that move the action most: a count, no more."""
    calls = [
        found
        for maps, moves, which in zip(every, moved, shown, strict=True)
        for replan in which
        if moves is not None and (found := in_both(maps, moves, replan)) is not None
    ]
    if not calls:
        return []
    both, number, patches = (float(mean) for mean in np.mean(calls, axis=0))
    chance = float(np.mean([number**2 / patches for _, number, patches in calls]))
    by_order = any(moves is not None and moves.way == "first order" for moves in moved)
    most = "are first in the order of what moves the action" if by_order else "move the action most"
    said = (
        f"Of the {number:.2g} patches that are read most, {both:.2g} are among the {number:.2g} that {most} "
        f"(of {patches:.0f}; by chance {chance:.2g}), "
        + ("in the call shown." if len(calls) == 1 else f"mean of the {plural(len(calls), 'call')} shown.")
    )
    numbers = {"both": both, "number": number, "patches": patches, "chance": chance, "calls": len(calls)}
    ways = dict.fromkeys(HOW[moves.way] for moves in moved if moves is not None)
    limit = f"A count in these calls, without an interval. What moves the action: {listing(ways)}."
    return [
        Finding(said, "Does it read what moves the action?", numbers, limit,
                f"vla-attention effects {question.stores[0].path}")
    ]  # fmt: skip
