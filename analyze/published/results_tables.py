"""Results files as the tables of `core.levels`, so that pictures and intervals are those of stores.

A results file holds masses and fractions, but no row sums, and only the numbers of keys of the two sides of the ratio.
The other columns are null, and so are the lifts of groups. The uniform baseline is null where a file has no numbers of
keys, as those of the published scripts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.levels import over_replans, task_cells, task_groups
from vla_attention.analyze.measures.frames import EPISODE_ID, EPISODE_KEYS, LAYERS_AVG, float_values
from vla_attention.analyze.published.results_reader import ResultsFile, ResultsKind, SummaryNumber
from vla_attention.analyze.statistics.summaries import SampleSummary, summarize
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.groupings.grouping import Grouping, Ratio

#: The group of what is left: 1 minus the known fractions.
REST = "rest"
#: Fractions that sum to 1 within this have no rest.
_NO_REST = 1e-4
#: A file's summary agrees with its steps within this (float32 sums, printed decimals).
_TOLERANCE = 1e-5
_STATISTICS = ("mean", "std", "median", "min", "max")
_UNKNOWN = pl.lit(None, dtype=pl.Float64)
_OF_GROUPS = ("mass", "fraction", "keys", "density", "lift")


@dataclass(frozen=True)
class ResultsTables:
    """Tables of one or several results files; `suite` holds the files' labels, which keep equal task ids apart.

    Attributes:
        grouping: the sides, and what is left.
        replans: as `levels.Levels.replans`.
        episodes, tasks: as `levels.over_replans` and `levels.task_cells`.
        groups: as `levels.task_groups`.
    """

    grouping: Grouping
    replans: pl.DataFrame
    episodes: pl.DataFrame
    tasks: pl.DataFrame
    groups: pl.DataFrame


@dataclass(frozen=True)
class Spread:
    """Numbers over the replans of one layer as the published parser gives them: finite ratios only, std with ddof 0."""

    num_replans: int
    num_infinite: int
    num_undefined: int
    mean: float | None
    std: float | None
    median: float | None
    min: float | None
    max: float | None
    q25: float | None
    q75: float | None

    @property
    def num_finite(self) -> int:
        """How many ratios take part."""
        return self.num_replans - self.num_infinite - self.num_undefined


def spread_of(ratios: pl.Series) -> Spread:
    """Summarise ratios (null: undefined)."""
    values = float_values(ratios)
    finite = values[np.isfinite(values)]
    known = summarize(values)
    low, high = np.percentile(finite, [25, 75]).tolist() if finite.size else (None, None)
    return Spread(
        num_replans=len(values),
        num_infinite=int(np.isinf(values).sum()),
        num_undefined=int(np.isnan(values).sum()),
        mean=known.mean,
        std=known.std,
        median=known.median,
        min=known.min,
        max=known.max,
        q25=low,
        q75=high,
    )


def results_tables(files: Sequence[ResultsFile], labels: Sequence[str]) -> ResultsTables:
    """Tables over files of one kind; `labels` stand in the column `suite`."""
    rows = pl.concat([_rows(file, label) for file, label in zip(files, labels, strict=True)])
    grouping = _grouping(files[0].kind, rows)
    replans, of_groups = _replans(rows, grouping)
    order = [*EPISODE_ID, "layer_number"]
    episodes = over_replans(replans).sort(order, nulls_last=True, maintain_order=True)
    names = [*EPISODE_KEYS, "layer", "layer_number", "block", "group"]
    finite = [pl.col(name).filter(pl.col(name).is_finite()).mean() for name in _OF_GROUPS]
    of_episodes = (
        of_groups.group_by(names, maintain_order=True).agg(finite).sort(order, nulls_last=True, maintain_order=True)
    )
    sampling = Sampling()
    return ResultsTables(
        grouping, replans, episodes, task_cells(episodes, sampling), task_groups(of_episodes, sampling)
    )


def _rows(file: ResultsFile, label: str) -> pl.DataFrame:
    episodes = file.episodes.with_columns(pl.lit(label).alias("suite")).drop("num_replans")
    return file.steps.join(episodes, on="episode", how="left", maintain_order="left").drop("episode")


def _grouping(kind: ResultsKind, rows: pl.DataFrame) -> Grouping:
    names = ["visual", "linguistic", *(["action"] if kind.has_action else [])]
    rest = 1 - pl.sum_horizontal(f"{name}_fraction" for name in names)
    most = rows.select(pl.when(_defined(names)).then(rest).max()).item()
    if most is not None and most > _NO_REST:
        names.append(REST)
    # Only the names are known. The selectors are never resolved: a results file has no keys.
    groups = {name: (f"span:{name}",) for name in names}
    return Grouping("results file", groups, Ratio(("visual",), ("linguistic",)), description=str(kind))


def _defined(names: Sequence[str]) -> pl.Expr:
    return pl.all_horizontal(pl.col(f"{name}_fraction").is_not_null() for name in names)


def _replans(rows: pl.DataFrame, grouping: Grouping) -> tuple[pl.DataFrame, pl.DataFrame]:
    """The cells of replans, and their groups."""
    names = [name for name in grouping.names if name != REST]
    if REST in grouping.names:
        rest = pl.when(_defined(names)).then(1 - pl.sum_horizontal(f"{name}_fraction" for name in names)).clip(0, 1)
        total = pl.coalesce(
            pl.when(pl.col(f"{name}_fraction") > 0).then(pl.col(f"{name}_mass") / pl.col(f"{name}_fraction"))
            for name in names
        )
        rows = rows.with_columns(rest.alias(f"{REST}_fraction"), (rest * total).alias(f"{REST}_mass"))
    uniform = uniform_ratios()
    not_finite = ~pl.col("ratio").is_finite().fill_null(False)
    left_out = (
        pl.when(pl.col("layer") != LAYERS_AVG)
        .then(not_finite)
        .sum()
        .over("suite", "task_id", "episode_index", "replan")
    )
    table = rows.with_columns(
        pl.lit(None, dtype=pl.Int64).alias("block"),
        _UNKNOWN.alias("row_sum"),
        _UNKNOWN.alias("valid_mass"),
        _UNKNOWN.alias("num_valid"),
        pl.col("visual_mass").alias("numerator_mass"),
        pl.col("linguistic_mass").alias("denominator_mass"),
        uniform.alias("uniform_ratio"),
        # A file says one ratio; over layers it is the published mean of ratios.
        pl.col("ratio").alias("ratio_mean"),
        (pl.col("ratio") / uniform).fill_nan(None).alias("ratio_lift"),
        pl.col("ratio").log(2.0).alias("log2_ratio"),
        pl.when(pl.col("layer") == LAYERS_AVG)
        .then(left_out)
        .otherwise(not_finite)
        .cast(pl.Int64)
        .alias("nonfinite_layers"),
    ).sort(*EPISODE_ID, "replan", "layer_number", nulls_last=True)
    measures = [f"{name}_{kind}" for name in grouping.names for kind in ("mass", "fraction")]
    groups = pl.concat(
        table.select(
            *EPISODE_KEYS, "replan", "env_step", "layer", "layer_number", "block",
            pl.lit(name).alias("group"),
            pl.col(f"{name}_mass").cast(pl.Float64).alias("mass"),
            pl.col(f"{name}_fraction").cast(pl.Float64).alias("fraction"),
            (pl.col(f"{name}_keys") if f"{name}_keys" in table.columns else _UNKNOWN).alias("keys"),
            *(_UNKNOWN.alias(name) for name in _OF_GROUPS if name not in ("mass", "fraction", "keys")),
            pl.int_range(pl.len()).alias("_cell"),
        )
        for name in grouping.names
    ).sort("_cell", maintain_order=True)  # fmt: skip
    return table.drop(measures, "total_mass", "visual_keys", "linguistic_keys"), groups.drop("_cell")


def uniform_ratios() -> pl.Expr:
    """The ratio that uniform attention gives at every step; null where the numbers of keys are unknown."""
    return (pl.col("visual_keys") / pl.col("linguistic_keys")).fill_nan(None)


def layers_of(file: ResultsFile) -> list[str]:
    """Layers by number, "layers_avg" last."""
    layers = file.steps.select("layer", "layer_number").unique().sort("layer_number", "layer", nulls_last=True)
    return layers["layer"].to_list()


def overall_layer(file: ResultsFile) -> str:
    """The layer that a summary in one number is about: "layers_avg" where there is one, else the first layer."""
    layers = layers_of(file)
    return LAYERS_AVG if LAYERS_AVG in layers else layers[0]


@dataclass(frozen=True)
class Disagreement:
    """A number in a file's summary that differs from the one computed from its steps.

    `reason` names the cause where it is a known other definition, and is empty otherwise.
    """

    stated: SummaryNumber
    computed: float | None
    reason: str


#: Known causes of a difference.
NO_FINITE_AS_ZERO = "its summary gives 0 where no ratio is finite; such a mean is undefined here"
ZEROS_COUNTED = "its summary counts steps without a ratio as ratios of 0; here they are left out"


def disagreements(file: ResultsFile) -> list[Disagreement]:
    """Compare a file's own summaries with its steps; measures and statistics that are unknown here are skipped."""
    parts = {
        (int(str(episode)), str(layer)): rows
        for (episode, layer), rows in file.steps.partition_by("episode", "layer", as_dict=True).items()
    }
    known: dict[tuple[int, str, str], tuple[NDArray[np.float64], SampleSummary]] = {}
    disagreeing = []
    for stated in file.summary_numbers:
        column = "ratio" if stated.measure == "visual_linguistic_ratio" else stated.measure
        if column not in file.steps.columns or stated.statistic not in _STATISTICS:
            continue
        key = (stated.episode, stated.layer, column)
        if key not in known:
            rows = parts.get(key[:2])
            values = np.zeros(0) if rows is None else float_values(rows[column])
            known[key] = (values, summarize(values))
        values, summary = known[key]
        computed = getattr(summary, stated.statistic)
        if not _agrees(stated.value, computed):
            disagreeing.append(Disagreement(stated, computed, _reason(stated, values)))
    return disagreeing


def _agrees(stated: float | None, computed: float | None) -> bool:
    if stated is None or computed is None:
        return stated is computed
    return abs(stated - computed) <= _TOLERANCE * max(1.0, abs(stated), abs(computed))


def _reason(stated: SummaryNumber, values: NDArray[np.float64]) -> str:
    if stated.measure != "visual_linguistic_ratio" or values.size == 0:
        return ""
    if not np.isfinite(values).any() and stated.value == 0:
        return NO_FINITE_AS_ZERO
    counted = np.where(np.isnan(values), 0.0, values)
    return ZEROS_COUNTED if _agrees(stated.value, getattr(summarize(counted), stated.statistic)) else ""


def labels_of(files: Sequence[ResultsFile]) -> list[str]:
    """A name for each file: its suite, with as much of its folder as it takes to tell files of one suite apart."""
    return [_label(i, files) for i in range(len(files))]


def _label(number: int, files: Sequence[ResultsFile]) -> str:
    file = files[number]
    same = [(*other.path.resolve().parent.parts[1:], other.path.stem) for other in files if other.suite == file.suite]
    parts = (*file.path.resolve().parent.parts[1:], file.path.stem)
    if len(same) == 1:
        return file.suite
    # x.json and attention_ratio_results_x.json are about one suite: their file names tell them apart, else folders do.
    depth = next(
        depth for depth in range(1, len(parts) + 1) if sum(path[-depth:] == parts[-depth:] for path in same) == 1
    )
    return file.path.stem if depth == 1 else "/".join((*parts[-depth:-1], file.suite))


def by_kind(files: Sequence[ResultsFile]) -> dict[ResultsKind, list[ResultsFile]]:
    """Files by the kind of their masses, in order of appearance."""
    kinds: dict[ResultsKind, list[ResultsFile]] = {}
    for file in files:
        kinds.setdefault(file.kind, []).append(file)
    return kinds
