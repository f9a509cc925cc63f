"""Time courses: means over episodes on episode time and around the first gripper closing, with pointwise intervals.

Quantities are the ratio and the fractions of all groups that take any mass, in one layer ("layers_avg" unless one layer
is chosen). The ratio is averaged geometrically, because an arithmetic mean follows the episode with the largest ratio.
Intervals are pointwise: each holds for its point. `curve_low` and `curve_high` hold for all points of a curve at once
(Bonferroni).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.aggregate import overall_layer, replans_of
from vla_attention.analyze.measures.alignment import (
    around_event,
    change_and_placebo,
    closing_replan,
    episode_timing,
    on_episode_time,
)
from vla_attention.analyze.measures.frames import (
    EPISODE_ID,
    EPISODE_KEYS,
    Tables,
    episode_id,
    float_values,
    rows_of_layer,
)
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.statistics.autocorrelation import autocorrelation_table
from vla_attention.analyze.statistics.effect_sizes import contrast, contrast_row
from vla_attention.analyze.statistics.episode_intervals import ABOUT_COLUMNS, Sampling, about_row
from vla_attention.analyze.statistics.intervals import (
    DEFAULT_LEVEL,
    SHARE,
    UNKNOWN,
    EpisodeStatistic,
    Estimate,
    ends,
    estimates,
    geometric_mean_over_episodes,
    mean_over_episodes,
)
from vla_attention.analyze.statistics.many_looks import adjusted_p_values
from vla_attention.analyze.statistics.summaries import summarize
from vla_attention.analyze.statistics.units import Units
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.grouping import Grouping

RATIO = "ratio"
#: The two alignments of a time course.
EPISODE_TIME, GRIPPER_CLOSING = "episode", "gripper"
#: Which episodes a curve is of.
ALL, SUCCESS, FAILURE = "all", "success", "failure"


#: The differences between success and failure whose p-values are adjusted for the number of quantities.
_ADJUSTED = ("difference", "within_tasks")


@dataclass(frozen=True)
class TimeSettings:
    """`num_bins` parts of the episode's time; `window` replans shown on either side of the gripper's closing."""

    num_bins: int = 20
    window: int = 8

    def __post_init__(self) -> None:
        if not 2 <= self.num_bins <= 1000:
            raise BadArgument(f"Cannot use --bins {self.num_bins}; expected 2 to 1000 parts of an episode.")
        if not 1 <= self.window <= 1000:
            raise BadArgument(f"Cannot use --window {self.window}; expected 1 to 1000 replans on either side.")


@dataclass(frozen=True)
class TimeCourses:
    """The results of `time_courses`; all tables are about one layer.

    Attributes:
        layer: the layer.
        quantities: "ratio" (when the grouping has one) and the groups whose fractions are followed.
        course: one row per (alignment, outcome, quantity, position): `position_low`, `position`, `position_high`
            (episode time 0 to 1, or replans from the closing), `value`, `low`, `high` (pointwise), `curve_low`,
            `curve_high` (all points at once), `num_episodes`, `num_tasks`,
            `uniform` (of the ratio).
        closing: one row per episode: its identity, `closing_replan` (null when the gripper never closes) and
            `closing_time` (0 to 1); empty when the stores hold no actions.
        change: one row per quantity: mean change from before to after the closing (a factor for the ratio, a difference
            for fractions) with `low` and `high`; `placebo`, what it is at the other replans of the same episodes
            (`alignment.change_and_placebo`), and `beyond`, the change without it, with `beyond_low` and `beyond_high`;
            `q`: p of no change or of none beyond, the larger (Benjamini-Hochberg over the quantities); how many
            episodes show both sides.
        outcomes: success against failure, one row per quantity, columns of `effect_sizes.contrast_row`; the ratio as
            log2. `difference_q` and `within_tasks_q` are adjusted for the number of quantities.
        autocorrelation: one row per episode, see `effective_replans.effective_replans_table`.
        num_nonfinite: (episode, replan) pairs without a finite log ratio, which take no part in the ratio's course.
    """

    layer: str
    quantities: tuple[str, ...]
    course: pl.DataFrame
    closing: pl.DataFrame
    change: pl.DataFrame
    outcomes: pl.DataFrame
    autocorrelation: pl.DataFrame
    num_nonfinite: int
    unknown_outcomes: int = 0


@dataclass(frozen=True)
class _Episode:
    """One episode's values (replan, quantity) with the ratio as its natural logarithm, and where its replans are."""

    identity: tuple[object, ...]
    task: tuple[str, int]
    success: bool | None
    values: NDArray[np.float64]
    uniform: float
    starts: NDArray[np.int64]
    num_steps: int
    closing: int | None


def time_courses(
    question: Question, settings: TimeSettings | None = None, replans: Tables | None = None
) -> TimeCourses:
    """Courses, the change at the gripper's closing, success against failure, and autocorrelation.

    Args:
        question: stores, selection and grouping.
        settings: bins and window.
        replans: the question's replans when they are known already (`aggregate.replans_of`).
    """
    settings = settings or TimeSettings()
    grouping = question.grouping
    replans = replans_of(question) if replans is None else replans
    layer = overall_layer(replans.parts[0].cells)
    of_layer = rows_of_layer(replans, layer)
    rows, groups = of_layer.cells, of_layer.groups_with_mass()
    quantities = ((RATIO,) if grouping.ratio else ()) + groups
    # What closes a gripper is known of our suites only.
    has_actions = all(
        item.episode.has("actions") and not item.store.attributes.protocol.of_other_loop for item in question.selected
    )
    by_name = {episode_id(item): item for item in question.selected}
    episodes = []
    fractions = of_layer.groups.partition_by(EPISODE_ID, as_dict=True)
    for key, part in rows.partition_by(EPISODE_ID, as_dict=True, maintain_order=True).items():
        episodes.append(_episode(by_name[key], Tables(part, fractions[key]), quantities, has_actions))
    sampling = question.sampling
    classes = {ALL: episodes}
    solved = [episode for episode in episodes if episode.success]
    failed = [episode for episode in episodes if episode.success is False]
    if solved and failed:
        classes |= {SUCCESS: solved, FAILURE: failed}
    course = [
        _course(members, outcome, alignment, quantities, settings, sampling)
        for outcome, members in classes.items()
        for alignment in ((EPISODE_TIME, GRIPPER_CLOSING) if has_actions else (EPISODE_TIME,))
    ]
    ratios = [episode.values[:, 0] for episode in episodes] if grouping.ratio else []
    return TimeCourses(
        layer=layer,
        quantities=quantities,
        course=pl.concat(course),
        closing=_closing_table(episodes if has_actions else [], rows),
        change=_change_table(episodes, quantities, settings.window, sampling),
        outcomes=_outcomes_table(episodes, quantities, sampling),
        autocorrelation=effective_replans_table(of_layer, grouping),
        num_nonfinite=int(sum((~np.isfinite(values)).sum() for values in ratios)),
        unknown_outcomes=sum(episode.success is None for episode in episodes),
    )


def _episode(item: SelectedEpisode, level: Tables, quantities: Sequence[str], has_actions: bool) -> _Episode:
    part = level.cells
    attributes = item.episode.attributes
    starts, num_steps = episode_timing(item.store.attributes, item.episode, part["env_step"].to_numpy())
    columns = [
        part["log2_ratio"] * np.log(2.0) if quantity == RATIO else level.of_group(quantity)["fraction"]
        for quantity in quantities
    ]
    uniform = part["uniform_ratio"].cast(pl.Float64).log().mean() if RATIO in quantities else None
    actions = item.episode.read("actions") if has_actions else None
    return _Episode(
        identity=part.select(EPISODE_KEYS).row(0),
        task=(item.store.suite, attributes.task_id),
        success=attributes.success,
        values=np.stack([float_values(column) for column in columns], axis=1),
        uniform=uniform if isinstance(uniform, float) else float("nan"),
        starts=starts,
        num_steps=num_steps,
        closing=None if actions is None else closing_replan(actions, starts, num_steps),
    )


def _statistics(values: NDArray[np.float64], quantities: Sequence[str]) -> list[EpisodeStatistic]:
    """Statistics over episodes of values (episode, position, quantity), quantity by quantity, position by position."""
    return [
        geometric_mean_over_episodes(values[:, position, i])
        if quantity == RATIO
        else mean_over_episodes(values[:, position, i], SHARE)
        for i, quantity in enumerate(quantities)
        for position in range(values.shape[1])
    ]


def _course(
    episodes: Sequence[_Episode],
    outcome: str,
    alignment: str,
    quantities: Sequence[str],
    settings: TimeSettings,
    sampling: Sampling,
) -> pl.DataFrame:
    if alignment == EPISODE_TIME:
        aligned = [on_episode_time(e.values, e.starts, e.num_steps, settings.num_bins) for e in episodes]
        edges = np.linspace(0.0, 1.0, settings.num_bins + 1)
        places = np.stack([edges[:-1], (edges[:-1] + edges[1:]) / 2, edges[1:]], axis=1)
    else:
        episodes = [episode for episode in episodes if episode.closing is not None]
        aligned = [around_event(e.values, e.closing, settings.window) for e in episodes if e.closing is not None]
        offsets = np.arange(-settings.window, settings.window + 1, dtype=np.float64)
        places = np.stack([offsets, offsets, offsets], axis=1)
    rows: list[tuple[object, ...]] = []
    if episodes:
        units = _units(episodes, sampling)
        decided = units.decided()
        timed = np.stack(aligned)
        statistics = _statistics(timed, quantities)
        means = estimates(statistics, decided)
        # Bonferroni over the points of one curve: all of it lies within, at the level of a single point.
        together = 1.0 - (1.0 - DEFAULT_LEVEL) / len(places)
        known = np.array([episode.uniform for episode in episodes])
        for number, (statistic, one) in enumerate(zip(statistics, means, strict=True)):
            quantity, position = quantities[number // len(places)], number % len(places)
            measured = np.isfinite(timed[:, position]).any(axis=1)
            # The baseline of the episodes that the point is of, also where none of their ratios is finite.
            of = statistic.used if statistic.used.any() else measured & np.isfinite(known)
            baseline = estimates([geometric_mean_over_episodes(known[of])], units.part(of))[0] if of.any() else UNKNOWN
            uniform = baseline.value if quantity == RATIO else None
            num_tasks = units.part(statistic.used).num_tasks
            rows.append(
                (
                    *(alignment, outcome, quantity, *(float(place) for place in places[position])),
                    *(one.value, *ends(one.interval()), *ends(one.interval(together))),
                    *(int(statistic.used.sum()), num_tasks, uniform),
                )
            )
    text = dict.fromkeys(("alignment", "outcome", "quantity"), pl.String)
    numbers = ("position_low", "position", "position_high", "value", "low", "high", "curve_low", "curve_high")
    counts = dict.fromkeys(("num_episodes", "num_tasks"), pl.Int64)
    schema = {**text, **dict.fromkeys(numbers, pl.Float64), **counts, "uniform": pl.Float64}
    return pl.DataFrame(rows, schema=schema, orient="row")


def _units(episodes: Sequence[_Episode], sampling: Sampling) -> Units:
    """The units of episodes, not decided."""
    tasks = [episode.task for episode in episodes]
    return sampling.units(pl.DataFrame(tasks, schema={"suite": pl.String, "task_id": pl.Int64}, orient="row"))


def _closing_table(episodes: Sequence[_Episode], rows: pl.DataFrame) -> pl.DataFrame:
    closings = [
        (*e.identity, e.closing, None if e.closing is None else float(e.starts[e.closing] / e.num_steps))
        for e in episodes
    ]
    kinds = {key: rows.schema[key] for key in EPISODE_KEYS}
    return pl.DataFrame(
        closings, schema={**kinds, "closing_replan": pl.Int64, "closing_time": pl.Float64}, orient="row"
    )


_CHANGE_SCHEMA: dict[str, Any] = {
    "quantity": pl.String,
    **dict.fromkeys(("change", "low", "high", "placebo", "beyond", "beyond_low", "beyond_high", "q"), pl.Float64),
    "num_episodes": pl.Int64,
    "num_tasks": pl.Int64,
    **ABOUT_COLUMNS,
}


def _change_table(
    episodes: Sequence[_Episode], quantities: Sequence[str], window: int, sampling: Sampling
) -> pl.DataFrame:
    """The table `TimeCourses.change`."""
    closers, changes, placebos = _changes_at_closing(episodes, window)
    if not closers:
        return pl.DataFrame(schema=_CHANGE_SCHEMA)
    units = _units(closers, sampling)

    def means(values: NDArray[np.float64]) -> list[EpisodeStatistic]:
        return [
            geometric_mean_over_episodes(values[:, i]) if quantity == RATIO else mean_over_episodes(values[:, i])
            for i, quantity in enumerate(quantities)
        ]

    statistics = means(changes)
    change, placebo, beyond = (
        estimates(of, units.decided()) for of in (statistics, means(placebos), means(changes - placebos))
    )
    nulls = [1.0 if quantity == RATIO else 0.0 for quantity in quantities]
    q_values = adjusted_p_values([_larger_p(*of) for of in zip(change, beyond, nulls, strict=True)])
    rows = []
    for i, (quantity, statistic) in enumerate(zip(quantities, statistics, strict=True)):
        numbers = (change[i].value, *ends(change[i].interval()), placebo[i].value, beyond[i].value)
        counts = int(statistic.used.sum()), units.part(statistic.used).num_tasks, *about_row(units).values()
        rows.append((quantity, *numbers, *ends(beyond[i].interval()), q_values[i], *counts))
    return pl.DataFrame(rows, schema=_CHANGE_SCHEMA, orient="row")


def _changes_at_closing(
    episodes: Sequence[_Episode], window: int
) -> tuple[list[_Episode], NDArray[np.float64], NDArray[np.float64]]:
    """The episodes with replans on both sides of the closing, and their changes and placebos, (episode, quantity)."""
    known = [
        (episode, *change_and_placebo(episode.values, episode.starts, episode.closing, window))
        for episode in episodes
        if episode.closing is not None
    ]
    known = [of for of in known if np.isfinite(of[1]).any()]
    return [of[0] for of in known], np.array([of[1] for of in known]), np.array([of[2] for of in known])


def _larger_p(change: Estimate, beyond: Estimate, null: float) -> float | None:
    """p of no change, or of none beyond its placebo: both have to be ruled out (Berger 1982, Technometrics 24)."""
    p_values = change.p_value(null), beyond.p_value(null)
    if change.value is None or beyond.value is None or p_values[0] is None or p_values[1] is None:
        return None
    return max(p_values[0], p_values[1]) if (change.value > null) == (beyond.value > null) else 1.0


def _outcomes_table(episodes: Sequence[_Episode], quantities: Sequence[str], sampling: Sampling) -> pl.DataFrame:
    """Success against failure on the episodes' means over replans: log2 of the ratio, and fractions."""
    units = _units(episodes, sampling)
    solved = np.array([episode.success is True for episode in episodes])
    means = np.array([[summarize(column).mean for column in episode.values.T] for episode in episodes], np.float64)
    means[[episode.success is None for episode in episodes]] = np.nan  # in neither class
    names, contrasts = [], []
    for i, quantity in enumerate(quantities):
        values = means[:, i] / np.log(2.0) if quantity == RATIO else means[:, i]
        names.append("log2_ratio" if quantity == RATIO else f"{quantity}_fraction")
        contrasts.append(contrast(values, solved, units))
    looks = {name: adjusted_p_values([getattr(one, name).p_value(0.0) for one in contrasts]) for name in _ADJUSTED}
    rows = [
        {"quantity": name, **contrast_row(one, SUCCESS, FAILURE), **{f"{of}_q": looks[of][i] for of in _ADJUSTED}}
        for i, (name, one) in enumerate(zip(names, contrasts, strict=True))
    ]
    texts = {"quantity": pl.String, "note": pl.String}
    return pl.DataFrame(rows, schema_overrides=texts, infer_schema_length=None).with_columns(
        pl.col(pl.Null).cast(pl.Float64)
    )


def effective_replans_table(replans: Tables, grouping: Grouping) -> pl.DataFrame:
    """`autocorrelation_table` of every (episode, layer) of `aggregate.replan_tables`.

    The series is log2_ratio, or the first group's fraction when the grouping has no ratio.
    """
    keys = [*EPISODE_KEYS, "layer", "layer_number"]
    if grouping.ratio:
        name, values = "log2_ratio", replans.cells["log2_ratio"]
    else:
        name, values = f"{grouping.names[0]}_fraction", replans.of_group(grouping.names[0])["fraction"]
    table = replans.cells.select(*keys, "replan", values.alias(name)).sort("replan", maintain_order=True)
    return autocorrelation_table(table, keys, name).sort(*EPISODE_ID, "layer_number", nulls_last=True)
