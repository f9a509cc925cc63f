"""The deviation of a policy's actions from a data set's: by dimension, task and phase, and beside attention.

Dimensions of an action have different units. A deviation is therefore measured in the data set's own spread: 1 is the
root mean square deviation of a policy that always answers with the data set's mean action.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.effects.action_changes import ActionSpread, action_spread
from vla_attention.analyze.effects.paired_replans import ALL, PHASES
from vla_attention.analyze.measures.aggregate import overall_layer, replans_of
from vla_attention.analyze.measures.alignment import episode_timing, on_episode_time
from vla_attention.analyze.measures.frames import (
    EPISODE_ID,
    Tables,
    episode_id,
    float_values,
    long_table,
    replan_axis,
    rows_of_layer,
)
from vla_attention.analyze.measures.masses import finite_mean
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.statistics.episode_intervals import means_of_all_and_of_tasks, means_with_intervals
from vla_attention.analyze.statistics.intervals import NO_LIMITS, POSITIVE
from vla_attention.analyze.statistics.many_looks import adjusted_p_values
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import StoreError

Array = NDArray[np.float64]

#: Fewest replans with a value on either side of which a rank correlation is taken.
FEWEST_REPLANS = 4


def scaled_deviation(actions: Array, of_data: Array, counts: NDArray[np.integer], spread: Array) -> Array:
    """(action - data set's action) / spread, over the steps that both have; NaN behind them.

    Args:
        actions: the policy's, (replan, step, dimension).
        of_data: the data set's, (replan, step, dimension); other numbers of steps are allowed.
        counts: (replan,) how many of the data set's steps there are.
        spread: (dimension,) the units; NaN for dimensions that are not compared.

    Returns:
        (replan, step, dimension), with the smaller number of steps.
    """
    steps = min(actions.shape[1], of_data.shape[1])
    scaled: Array = (actions[:, :steps] - of_data[:, :steps]) / spread
    scaled[np.arange(steps)[None] >= np.asarray(counts)[:, None]] = np.nan
    return scaled


def root_mean_square(values: Array, axis: int | tuple[int, ...]) -> Array:
    """Root mean square of the values that are there; NaN where none is."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    with np.errstate(invalid="ignore"):
        root: Array = np.sqrt(
            np.where(known, values, 0.0).__pow__(2).sum(axis=axis) / np.where(count > 0, count, np.nan)
        )
    return root


def rank_correlation(first: Array, second: Array) -> float:
    """Spearman's correlation of the places where both are finite; NaN where it is not defined.

    Equal values share their mean rank. It is not defined for fewer than `FEWEST_REPLANS` places, or where one side is
    the same everywhere.
    """
    both = np.isfinite(first) & np.isfinite(second)
    if both.sum() < FEWEST_REPLANS:
        return float("nan")
    x, y = (_ranks(values[both]) for values in (first, second))
    x, y = x - x.mean(), y - y.mean()
    size = float(np.sqrt((x**2).sum() * (y**2).sum()))
    return float((x * y).sum() / size) if size > 0 else float("nan")


def _ranks(values: Array) -> Array:
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(count)
    mean: Array = (last - (count - 1) / 2.0)[place]
    return mean


#: The two measures of a replan: of the first action, and of all steps of the chunk that the data set has too.
MEASURES = ("first", "chunk")
RATIO = "ratio"
_CORRELATION_LIMITS = (-1.0, 1.0)


@dataclass(frozen=True)
class DeviationStudy:
    """The result of `study_deviation`.

    Attributes:
        question: stores, selection and grouping.
        spread: the units: standard deviation of each dimension over all steps of the data set's actions in the stores.
        layer: label of the layer whose attention is correlated: "layers_avg" or the only one.
        replans: one row per (episode, replan): suite, task_id, episode_index, replan, env_step, steps (compared),
            first and chunk: root mean square over the dimensions, and over the steps, in spreads.
        phases: means over replans with intervals, `scope` "all" or "task" (suite, task_id, instruction), phase "all"
            or a third of the episode's time: first, chunk.
        dimensions: one row per dimension that is compared: its root mean square deviation over an episode's replans,
            first and chunk, and `bias`, the mean of the first action's (action - data set's); means over episodes with
            intervals.
        correlations: one row per (quantity, measure): Spearman's correlation over the replans of an episode of the
            deviation with the ratio, or with a group's lift; mean over episodes with its interval, and `correlation_q`.
    """

    question: Question
    spread: ActionSpread
    layer: str
    replans: pl.DataFrame
    phases: pl.DataFrame
    dimensions: pl.DataFrame
    correlations: pl.DataFrame

    @property
    def overall(self) -> dict[str, float | int | None]:
        """The row of `phases` over everything."""
        return self.phases.row(by_predicate=(pl.col("scope") == "all") & (pl.col("phase") == ALL), named=True)

    def tables(self) -> dict[str, pl.DataFrame]:
        """The tables that are written to files, by the files' names."""
        return {
            "deviation_replans": self.replans,
            "deviation": self.phases,
            "deviation_dimensions": self.dimensions,
            "deviation_attention": self.correlations,
        }


@dataclass(frozen=True)
class _Episode:
    """The deviations of one episode, (replan, step, dimension) in spreads; NaN where there is none."""

    item: SelectedEpisode
    scaled: Array

    @property
    def measures(self) -> Array:
        """`MEASURES` of every replan, (replan, measure)."""
        return np.stack(
            (root_mean_square(self.scaled[:, 0], axis=-1), root_mean_square(self.scaled, axis=(1, 2))), axis=1
        )


def has_dataset_actions(question: Question) -> bool:
    """Whether every selected episode holds the data set's actions beside the policy's."""
    return all(item.episode.has("dataset_actions") and item.episode.has("actions") for item in question.selected)


def study_deviation(question: Question, replans: Tables | None = None) -> DeviationStudy:
    """Measure the deviation of the policy's actions from the data set's, beside the attention of the same replans.

    replans: the question's replans when they are known already (`aggregate.replans_of`).

    Raises:
        BadArgument: an episode lacks one of the two, or nothing in the data set's actions changes.
        StoreError: the actions of the two have different numbers of dimensions.
    """
    for item in question.selected:
        _check_has_both(item.store, item.episode)
    spread = _spread(question)
    units = np.where(spread.used, spread.spread, np.nan)
    episodes = []
    for item in question.selected:
        actions = item.episode.read("actions").astype(np.float64)
        episodes.append(_Episode(item, scaled_deviation(actions, *_data_actions(item.episode), units)))
    replans = replans_of(question) if replans is None else replans
    layer = overall_layer(replans.parts[0].cells)
    return DeviationStudy(
        question=question,
        spread=spread,
        layer=layer,
        replans=pl.concat([_replan_rows(episode) for episode in episodes]),
        phases=_phase_table(episodes, question),
        dimensions=_dimension_table(episodes, question, spread),
        correlations=_correlation_table(episodes, question, rows_of_layer(replans, layer)),
    )


def _check_has_both(store: Store, episode: StoredEpisode) -> None:
    if not episode.has("dataset_actions"):
        raise BadArgument(
            f"{episode.name} of {store.path} holds no actions of a data set to compare the policy's with; stores of "
            "vla-attention capture replay hold them, and replan(dataset_actions=...) of va.record stores them."
        )
    if not episode.has("actions"):
        raise BadArgument(
            f"{episode.name} of {store.path} holds no actions of the policy, only those of the data set; record the "
            "run with its actions."
        )
    ours, theirs = (episode.attributes.arrays[name].shape[2] for name in ("actions", "dataset_actions"))
    if ours != theirs:
        raise StoreError(
            f"In {episode.name} of {store.path} the policy's actions have {ours} dimensions and the data set's "
            f"{theirs}: they are not of the same kind; replay the data set with a policy of its actions."
        )


def _data_actions(episode: StoredEpisode) -> tuple[Array, NDArray[np.int64]]:
    """The data set's actions (replan, step, dimension), and how many steps of each replan there are."""
    actions = episode.read("dataset_actions").astype(np.float64)
    return actions, episode.read("dataset_action_count").astype(np.int64)


def _spread(question: Question) -> ActionSpread:
    """The units, from all episodes of the stores: they do not change with --tasks. Damaged episodes are left out."""
    if question.settings.skip_corrupt:
        members = [item.episode for item in question.selected]
    else:
        members = [episode for store in question.stores for episode in store.episodes]
    steps = []
    for episode in members:
        if episode.has("dataset_actions"):
            actions, counts = _data_actions(episode)
            steps.append(actions[np.arange(actions.shape[1])[None] < counts[:, None]][None])
    spread = action_spread(steps)
    if not spread.used.any():
        raise BadArgument(
            "The data set's actions are the same in every replan and step, so a deviation has no unit; give stores "
            "with more episodes."
        )
    return spread


def _replan_rows(episode: _Episode) -> pl.DataFrame:
    values = {"steps": np.isfinite(episode.scaled).any(axis=2).sum(axis=1).astype(np.int64)}
    measures = {name: episode.measures[:, i] for i, name in enumerate(MEASURES)}
    return long_table(episode.item, [replan_axis(episode.item)], values | measures)


def _phase_table(episodes: list[_Episode], question: Question) -> pl.DataFrame:
    rows = []
    for episode in episodes:
        item, values = episode.item, episode.measures
        env_step = item.episode.read("env_step").astype(np.int64)
        starts, num_steps = episode_timing(item.store.attributes, item.episode, env_step)
        timed = on_episode_time(values, starts, num_steps, len(PHASES))
        parts = {ALL: finite_mean(values), **dict(zip(PHASES, timed, strict=True))}
        suite, task, _ = episode_id(item)
        identity = {"suite": suite, "task_id": task, "instruction": visible(item.episode.attributes.instruction)}
        rows += [
            identity | {"phase": phase} | dict(zip(MEASURES, means.tolist(), strict=True))
            for phase, means in parts.items()
        ]
    table = pl.DataFrame(rows).with_columns(pl.col(MEASURES).fill_nan(None))
    limits = dict.fromkeys(MEASURES, POSITIVE)
    return means_of_all_and_of_tasks(table, ["phase"], limits, question.sampling)


def _dimension_table(episodes: list[_Episode], question: Question, spread: ActionSpread) -> pl.DataFrame:
    rows = []
    for episode in episodes:
        suite, task, _ = episode_id(episode.item)
        first, chunk = root_mean_square(episode.scaled[:, 0], axis=0), root_mean_square(episode.scaled, axis=(0, 1))
        bias = finite_mean(episode.scaled[:, 0])
        rows += [
            {
                "suite": suite,
                "task_id": task,
                "dimension": int(i),
                "spread": float(spread.spread[i]),
                "first": float(first[i]),
                "chunk": float(chunk[i]),
                "bias": float(bias[i]),
            }
            for i in np.flatnonzero(spread.used)
        ]
    limits = {**dict.fromkeys(MEASURES, POSITIVE), "bias": NO_LIMITS}
    return means_with_intervals(
        pl.DataFrame(rows), ["dimension", "spread"], limits, question.sampling, nulls={"bias": 0.0}
    )


def _correlation_table(episodes: list[_Episode], question: Question, level: Tables) -> pl.DataFrame:
    quantities = [*([RATIO] if question.grouping.ratio else []), *level.groups_with_mass()]
    cells = level.cells.partition_by(EPISODE_ID, as_dict=True, maintain_order=True)
    groups = level.groups.partition_by(EPISODE_ID, as_dict=True, maintain_order=True)
    rows = []
    for episode in episodes:
        key = episode_id(episode.item)
        part, of_groups = cells[key].sort("replan"), groups[key]
        for quantity in quantities:
            if quantity == RATIO:
                attention = float_values(part["log2_ratio"])
            else:
                attention = float_values(of_groups.filter(group=quantity).sort("replan")["lift"])
            rows += [
                {
                    "suite": key[0],
                    "task_id": key[1],
                    "quantity": quantity,
                    "of": RATIO if quantity == RATIO else "lift",
                    "measure": name,
                    "correlation": rank_correlation(attention, episode.measures[:, i]),
                }
                for i, name in enumerate(MEASURES)
            ]
    table = means_with_intervals(
        pl.DataFrame(rows, schema=_CORRELATION_SCHEMA),
        ["quantity", "of", "measure"],
        {"correlation": _CORRELATION_LIMITS},
        question.sampling,
        nulls={"correlation": 0.0},
    )
    q_values = adjusted_p_values(table["correlation_p"].to_list())
    return table.with_columns(pl.Series("correlation_q", q_values, dtype=pl.Float64)).drop("correlation_p")


_CORRELATION_SCHEMA = {
    "suite": pl.String,
    "task_id": pl.Int64,
    "quantity": pl.String,
    "of": pl.String,
    "measure": pl.String,
    "correlation": pl.Float64,
}
