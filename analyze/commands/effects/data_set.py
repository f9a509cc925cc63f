"""How far the policy's actions are from those of the data set that it was replayed over: a part of `effects`.

Dimensions of an action have different units. A deviation is therefore measured in the data set's own spread: 1 is the
root mean square deviation of a policy that always answers with the data set's mean action.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.about import enough, with_interval
from vla_attention.analyze.core.action_changes import ActionSpread, action_spread, readable_episodes
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.core.result import Column, Figure, Finding, Table
from vla_attention.analyze.measures.masses import finite_mean
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.tables import EPISODE_ID, LAYERS_AVG, long_table, replan_axis
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import StoreError

Array = NDArray[np.float64]

#: Fewest replans with a value on either side of which a rank correlation is taken.
FEWEST_REPLANS = 4
#: The two measures of a replan: of the first action, and of all steps of the chunk that the data set has too.
MEASURES = ("first", "chunk")
_POSITIVE: dict[str, Scale] = dict.fromkeys(MEASURES, "positive")
_UNIT = "standard deviations of the data set's actions"


def has_dataset_actions(question: Question) -> bool:
    """Whether a selected episode holds the data set's actions."""
    return any(item.episode.has("dataset_actions") for item in question.selected)


def deviation(question: Question) -> tuple[list[Finding], list[Table], list[Figure]]:
    """The deviation of the policy's actions from the data set's, beside the attention of the same replans.

    Raises:
        BadArgument: an episode lacks one of the two, or nothing in the data set's actions changes.
        StoreError: the actions of the two have different numbers of dimensions.
    """
    for item in question.selected:
        _check_has_both(item.store, item.episode)
    spread = _spread(question)
    units = np.where(spread.used, spread.spread, np.nan)
    replans, dimensions = [], []
    for item in question.selected:
        actions = item.episode.read("actions").astype(np.float64)
        scaled = scaled_deviation(actions, *_data_actions(item.episode), units)
        steps = np.isfinite(scaled).any(axis=2).sum(axis=1).astype(np.int64)
        first, chunk = root_mean_square(scaled[:, 0], axis=-1), root_mean_square(scaled, axis=(1, 2))
        values = {"steps": steps, "first": first, "chunk": chunk}
        replans.append(long_table(item, [replan_axis(item)], values, (*EPISODE_ID, "instruction")))
        used = np.flatnonzero(spread.used)
        of_dimension = {
            "first": root_mean_square(scaled[:, 0], axis=0)[used],
            "chunk": root_mean_square(scaled, axis=(0, 1))[used],
            "bias": finite_mean(scaled[:, 0])[used],
        }
        dimensions.append(long_table(item, [{"dimension": used, "spread": spread.spread[used]}], of_dimension))
    rows = pl.concat(replans)
    episodes = rows.group_by(*EPISODE_ID, "instruction", maintain_order=True).agg(pl.col(MEASURES).mean())
    tasks = estimate(episodes, ["suite", "task_id", "instruction"], _POSITIVE, question.sampling)
    whole = estimate(episodes.with_columns(scope=pl.lit("all")), ["scope"], _POSITIVE, question.sampling)
    summary = pl.concat([whole, tasks.with_columns(scope=pl.lit("task"))], how="diagonal")
    by_dimension = estimate(
        pl.concat(dimensions), ["dimension", "spread"], {**_POSITIVE, "bias": "plain"}, question.sampling, {"bias": 0.0}
    )
    correlations, known = _correlations(question, rows), pl.col("correlation").is_not_null()
    drawn = by_dimension.with_columns(label=pl.format("dimension {}", "dimension"))
    title = "How far the policy's actions are from the data set's"
    caption = "First action, means over episodes, every task weighing the same; bars: 95% intervals."
    options = {"value": "first", "label": "label", "xlabel": "deviation (standard deviations)", "log": True,
               "baseline": 1.0, "baseline_name": "the data set's mean action"}  # fmt: skip
    return (
        [_finding(question, summary, by_dimension, correlations, spread.left_out)],
        [
            Table("deviation_dimensions", by_dimension, _DIMENSIONS, f"{title}, by dimension"),
            Table("deviation_attention", correlations, _CORRELATIONS, "Does it go with attention?", known),
            Table("deviation", summary, _SUMMARY, f"{title}, by task", pl.col("scope") == "task"),
            Table("deviation_replans", rows.drop("instruction")),
        ],
        [Figure("deviation", "forest", drawn, f"{title}, by dimension of the action", caption, options)],
    )


def scaled_deviation(actions: Array, of_data: Array, counts: NDArray[np.integer[Any]], spread: Array) -> Array:
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
    return np.asarray(np.sqrt(finite_mean(values**2, axis)))


def rank_correlation(first: Array, second: Array) -> float:
    """Spearman's correlation of the places where both are finite; NaN where it is not defined.

    Equal values share their mean rank. It is not defined for fewer than `FEWEST_REPLANS` places, or where one side is
    the same everywhere.
    """
    both = np.isfinite(first) & np.isfinite(second)
    if both.sum() < FEWEST_REPLANS:
        return float("nan")
    x, y = (pl.Series(values[both]).rank("average").to_numpy() for values in (first, second))
    x, y = x - x.mean(), y - y.mean()
    size = float(np.sqrt((x**2).sum() * (y**2).sum()))
    return float((x * y).sum() / size) if size > 0 else float("nan")


def _correlations(question: Question, rows: pl.DataFrame) -> pl.DataFrame:
    """Rank correlation over an episode's replans of the deviation with the ratio, or with a group's lift."""
    levels = levels_of(question)
    groups = levels.groups("replan").collect().filter(pl.col("layer") == LAYERS_AVG)
    having = groups.filter(pl.col("mass") > 0)["group"].unique(maintain_order=True)
    place = [*EPISODE_ID, "replan"]
    parts = [
        groups.filter(group=name).select(*place, quantity=pl.lit(name), of=pl.lit("lift"), attention="lift")
        for name in question.grouping.names
        if name in having
    ]
    if question.grouping.ratio is not None:
        cells = levels.replans().collect().filter(pl.col("layer") == LAYERS_AVG)
        ratio = cells.select(*place, quantity=pl.lit("ratio"), of=pl.lit("ratio"), attention="log2_ratio")
        parts.insert(0, ratio)
    found = []
    joined = rows.join(pl.concat(parts), on=place, how="left", maintain_order="left")
    for key, part in joined.partition_by(*EPISODE_ID, "quantity", "of", as_dict=True, maintain_order=True).items():
        for measure in MEASURES:
            pair = (part[name].cast(pl.Float64).fill_null(np.nan).to_numpy() for name in ("attention", measure))
            found.append((*key, measure, rank_correlation(*pair)))
    names = joined.select(*EPISODE_ID, "quantity", "of").schema
    schema: Any = {**names, "measure": pl.String, "correlation": pl.Float64}
    table = pl.DataFrame(found, schema=schema, orient="row")
    by = ["quantity", "of", "measure"]
    return estimate(table, by, {"correlation": "correlation"}, question.sampling, {"correlation": 0.0})


def _finding(
    question: Question, summary: pl.DataFrame, dimensions: pl.DataFrame, correlations: pl.DataFrame, out: Sequence[int]
) -> Finding:
    """How far the first actions are, in which dimension most, which are shown to be biased, and with what it goes."""
    whole, most = summary.row(0, named=True), dimensions.sort("first", descending=True).row(0, named=True)
    said = f"The policy's first actions are {with_interval(whole, 'first')} {_UNIT} away from its own (1: as far "
    said += f"as the data set's mean action would be), most in dimension {most['dimension']} ({most['first']:.2g})."
    if (biased := dimensions.filter(pl.col("bias_q") <= NAMED_AT)).height:
        signed = [f"{dimension} ({bias:+.2g})" for dimension, bias in biased.select("dimension", "bias").iter_rows()]
        said += f" Shown to be off to one side in dimension {listing(signed, 7)}."
    if (sure := correlations.filter(pl.col("correlation_q") <= NAMED_AT)).height:
        named = sure.select(pl.format("{} ({}: {})", "quantity", "measure", pl.col("correlation").round(2))).to_series()
        said += f" It goes with attention to {listing(named, 6)}."
    numbers = {"estimate": whole["first"], "low": whole["first_low"], "high": whole["first_high"],
               "n": whole["num_episodes"]}  # fmt: skip
    limits = [enough(question), *([f"Not compared, without spread: dimension {listing(out, 20)}."] if out else [])]
    return Finding(said, "How far from the data set's actions?", numbers, " ".join(limits).strip())


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
    """The units, from all episodes of the stores: they do not change with --task."""
    steps = []
    for _, episode, arrays in readable_episodes(question.stores, question.settings.skip_corrupt):
        if (actions := arrays.get("dataset_actions")) is not None:
            counts = np.array(episode.attributes.dataset_action_count)
            steps.append(actions[np.arange(actions.shape[1])[None] < counts[:, None]][None])
    spread = action_spread(steps)
    if not spread.used.any():
        raise BadArgument(
            "The data set's actions are the same in every call and step, so a deviation has no unit; give stores "
            "with more episodes."
        )
    return spread


_MEASURED = [
    Column("first", "number", "first action", f"root mean square deviation of the first action, in {_UNIT}"),
    Column("chunk", "number", "whole chunk", "the same over all steps that the data set has too"),
]
_DIMENSIONS = [
    Column("dimension", "count"),
    *_MEASURED,
    Column("bias", "signed", "to one side", "mean of the first action minus the data set's"),
    Column("bias_q", "p", "q", "p of no such side, adjusted for the number of dimensions"),
    Column("spread", "number", "spread", "standard deviation of the data set's actions", screen=False),
]
_CORRELATIONS = [
    Column("quantity", "text", "attention to"),
    Column("of", "text", screen=False),
    Column("measure", "text"),
    Column("correlation", "signed", "rank correlation", "over the replans of an episode, mean over episodes"),
    Column("correlation_q", "p", "q"),
    Column("num_episodes", "count", "episodes"),
]
_SUMMARY = [Column("task_id", "count", "task"), *_MEASURED, Column("num_episodes", "count", "episodes"),
            Column("instruction", "text")]  # fmt: skip
