"""Results files as the tables of `core.levels`, so that pictures and intervals are those of stores.

A results file holds masses and fractions, but no row sums, and only the numbers of keys of the two sides of the ratio.
The other columns are null, and so are the lifts of groups. The uniform baseline is null where a file has no numbers of
keys, as those of the published scripts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import polars as pl

from vla_attention.analyze.core.levels import LAYER, over_replans, task_cells, task_groups
from vla_attention.analyze.measures.tables import EPISODE_ID, EPISODE_KEYS, LAYERS_AVG
from vla_attention.analyze.published.results_reader import RATIO, ResultsFile, ResultsKind
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
#: The ratio that uniform attention gives at every step; null where the numbers of keys are unknown.
UNIFORM_RATIO = (pl.col("visual_keys") / pl.col("linguistic_keys")).fill_nan(None)


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

    @property
    def layer(self) -> str:
        """What one number is about, see `overall_layer`."""
        return overall_layer(self.tasks)


def layers_of(rows: pl.DataFrame) -> list[str]:
    """Layers by number, "layers_avg" last."""
    layers = rows.select("layer", "layer_number").unique()
    return layers.sort("layer_number", "layer", nulls_last=True)["layer"].to_list()


def overall_layer(rows: pl.DataFrame) -> str:
    """The layer that a summary in one number is about: "layers_avg" where there is one, else the first layer."""
    layers = layers_of(rows)
    return LAYERS_AVG if LAYERS_AVG in layers else layers[0]


def spread() -> list[pl.Expr]:
    """Numbers over ratios as the published parser gives them: finite ones only, std with ddof 0; how many of which."""
    ratio = pl.col("ratio")
    finite = ratio.filter(ratio.is_finite())
    return [
        pl.len().alias("replans"), finite.mean().alias("mean"), finite.std(ddof=0).alias("std"),
        finite.median().alias("median"), finite.min().alias("min"), finite.max().alias("max"),
        *(finite.quantile(part / 100, "linear").alias(f"q{part}") for part in (25, 75)),
        ratio.is_infinite().sum().alias("infinite"), ratio.is_null().sum().alias("undefined"),
    ]  # fmt: skip


def results_tables(files: Sequence[ResultsFile], labels: Sequence[str]) -> ResultsTables:
    """Tables over files of one kind; `labels` stand in the column `suite`."""
    rows = pl.concat(
        file.steps.join(file.episodes.drop("num_replans"), on="episode", how="left", maintain_order="left")
        .drop("episode")
        .with_columns(suite=pl.lit(label))
        for file, label in zip(files, labels, strict=True)
    ).sort(*EPISODE_ID, "replan", "layer_number", nulls_last=True)
    rows, grouping = _with_rest(rows, files[0].kind)
    not_finite = ~pl.col("ratio").is_finite().fill_null(False)
    average = pl.col("layer") == LAYERS_AVG
    left_out = pl.when(~average).then(not_finite).sum().over(*EPISODE_ID, "replan")
    rows = rows.with_columns(
        pl.lit(None, dtype=pl.Int64).alias("block"),
        *(_UNKNOWN.alias(name) for name in ("row_sum", "num_valid", "density", "lift")),
        pl.col("visual_mass").alias("numerator_mass"),
        pl.col("linguistic_mass").alias("denominator_mass"),
        UNIFORM_RATIO.alias("uniform_ratio"),
        # A file says one ratio; over layers it is the published mean of ratios.
        pl.col("ratio").alias("ratio_mean"),
        (pl.col("ratio") / UNIFORM_RATIO).fill_nan(None).alias("ratio_lift"),
        pl.col("ratio").log(2.0).alias("log2_ratio"),
        pl.when(average).then(left_out).otherwise(not_finite).cast(pl.Int64).alias("nonfinite_layers"),
    )
    order = [*EPISODE_ID, "layer_number"]
    episodes = over_replans(rows).sort(order, nulls_last=True, maintain_order=True)
    sampling, of_episodes = Sampling(), rows.group_by(*EPISODE_KEYS, *LAYER, maintain_order=True)
    groups = pl.concat(
        of_episodes.agg(
            pl.lit(name).alias("group"),
            pl.col(f"{name}_mass").cast(pl.Float64).mean().alias("mass"),
            pl.col(f"{name}_fraction").cast(pl.Float64).mean().alias("fraction"),
            (pl.col(f"{name}_keys") if f"{name}_keys" in rows.columns else pl.col("lift")).mean().alias("keys"),
            pl.col("density", "lift").mean(),
        )
        for name in grouping.names
    ).sort(order, nulls_last=True, maintain_order=True)
    return ResultsTables(grouping, rows, episodes, task_cells(episodes, sampling), task_groups(groups, sampling))


def _with_rest(rows: pl.DataFrame, kind: ResultsKind) -> tuple[pl.DataFrame, Grouping]:
    """The rows with mass and fraction of what no known fraction holds, where it is anything; the grouping."""
    names = ["visual", "linguistic", *(["action"] if kind.has_action else [])]
    fractions = [f"{name}_fraction" for name in names]
    known = pl.all_horizontal(pl.col(fractions).is_not_null())
    rest = pl.when(known).then(1 - pl.sum_horizontal(fractions))
    most = rows.select(rest.max()).item()
    if most is not None and most > _NO_REST:
        sides = [(pl.col(f"{name}_mass"), pl.col(f"{name}_fraction")) for name in names]
        totals = [pl.when(fraction > 0).then(mass / fraction) for mass, fraction in sides]
        share = rest.clip(0, 1)
        rows = rows.with_columns(share.alias(f"{REST}_fraction"), (share * pl.coalesce(totals)).alias(f"{REST}_mass"))
        names.append(REST)
    # Only the names are known. The selectors are never resolved: a results file has no keys.
    groups = {name: (f"span:{name}",) for name in names}
    return rows, Grouping("results file", groups, Ratio(("visual",), ("linguistic",)), description=str(kind))


#: Known causes of a difference between a file's summary and its steps.
NO_FINITE_AS_ZERO = "its summary gives 0 where no ratio is finite; such a mean is undefined here"
ZEROS_COUNTED = "its summary counts steps without a ratio as ratios of 0; here they are left out"


def disagreements(file: ResultsFile) -> pl.DataFrame:
    """The numbers of a file's own summaries that differ from those of its steps.

    Returns:
        episode, layer, measure, statistic, value as stated, `computed` from the steps, and `reason`: the cause where it
        is a known other definition, else empty. Measures and statistics that are unknown here are skipped.
    """
    steps = file.steps.rename({"ratio": RATIO})
    measures = [name for name in steps.columns if name == RATIO or name.endswith(("_mass", "_fraction"))]
    long = steps.unpivot(measures, index=["episode", "layer"], variable_name="measure", value_name="x")
    keys = ["episode", "layer", "measure"]
    found = file.summaries.filter(pl.col("measure").is_in(measures), pl.col("statistic").is_in(_STATISTICS))
    # As it is here, and with ratios that do not exist as 0.
    for name, given in (("computed", pl.col("x")), ("counted", pl.col("x").fill_null(0.0))):
        x = given.filter(given.is_finite())
        five = (x.mean(), x.std(ddof=0), x.median(), x.min(), x.max())
        rows = long.group_by(keys).agg(value.alias(name) for name, value in zip(_STATISTICS, five, strict=True))
        rows = rows.unpivot(index=keys, variable_name="statistic", value_name=name)
        found = found.join(rows, on=[*keys, "statistic"], how="left", maintain_order="left")
    has_steps = file.steps.select("episode", "layer", pl.lit(True).alias("has_steps")).unique()
    found = found.join(has_steps, on=["episode", "layer"], how="left", maintain_order="left")
    of_ratio = (pl.col("measure") == RATIO) & pl.col("has_steps")
    none = pl.when(of_ratio & pl.col("computed").is_null() & (pl.col("value") == 0)).then(pl.lit(NO_FINITE_AS_ZERO))
    reason = none.when(of_ratio & _agrees("counted")).then(pl.lit(ZEROS_COUNTED)).otherwise(pl.lit(""))
    return found.filter(~_agrees("computed")).with_columns(reason=reason).drop("counted", "has_steps")


def _agrees(name: str) -> pl.Expr:
    """Whether a computed number is the stated one."""
    stated, computed = pl.col("value"), pl.col(name)
    room = _TOLERANCE * pl.max_horizontal(pl.lit(1.0), stated.abs(), computed.abs())
    close = ((stated - computed).abs() <= room).fill_null(False)
    return close | (stated.is_null() & computed.is_null())


def labels_of(files: Sequence[ResultsFile]) -> list[str]:
    """A name for each file: its suite, with as much of its folder as it takes to tell files of one suite apart."""
    places = [(file.suite, (*file.path.resolve().parent.parts[1:], file.path.stem)) for file in files]
    labels = []
    for suite, parts in places:
        same = [other for its, other in places if its == suite]
        # x.json and attention_ratio_results_x.json are about one suite: their names tell them apart, else folders do.
        depths = (d for d in range(1, len(parts) + 1) if sum(path[-d:] == parts[-d:] for path in same) == 1)
        depth = 0 if len(same) == 1 else next(depths)
        labels.append(parts[-1] if depth == 1 else "/".join((*parts[-depth:-1], suite)) if depth else suite)
    return labels
