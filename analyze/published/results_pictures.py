"""The pictures of `parse-attention-ratio-results`, under the names of the published scripts."""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from vla_attention.analyze.core.levels import overall
from vla_attention.analyze.core.result import Figure
from vla_attention.analyze.measures.frames import LAYERS_AVG
from vla_attention.analyze.published.results_tables import ResultsTables

_AXIS = "visual / linguistic (logarithmic)"
_NO_KEYS = "The file does not hold the numbers of keys: there is no line of evenly spread attention."
_LOOK = {"log": True, "uniform": "uniform_ratio", "baseline_name": "if spread evenly"}


def figures_of_file(wanted: Sequence[str], table: ResultsTables, end: str = "") -> list[Figure]:
    """Of "distribution", "per_task", "fractions" those that are wanted; `end` stands behind the names."""
    layer = _layer(table)
    note = _NO_KEYS if table.replans["uniform_ratio"].is_null().all() else ""
    label = pl.coalesce(pl.format("{}: {}", "task_id", "instruction"), "suite", pl.lit("all")).alias("task")
    layers = table.replans["layer"].unique(maintain_order=True).to_list()
    columns = ["suite", "task_id", "episode_index", "replan", "env_step", "layer", "ratio", "uniform_ratio"]
    spread = table.replans.filter(pl.col("layer").is_in(layers if len(layers) != 2 else layers[:1])).select(columns)
    tasks = table.tasks.filter(layer=layer).with_columns(label)
    dots = table.episodes.filter(layer=layer).with_columns(label)
    groups = overall(table.groups)
    made = {
        "distribution": Figure(
            f"ratio_distribution{end}", "distribution", spread, "Ratio visual / linguistic over policy calls, by layer",
            f"Boxes: quartiles, with the median; whiskers: 5% to 95%. {note}".strip(),
            {**_LOOK, "x": "layer", "value": "ratio", "ylabel": _AXIS},
        ),
        "per_task": Figure(
            f"ratio_per_task{end}", "forest", tasks, "Ratio visual / linguistic of every task",
            f"Geometric means with 95% intervals; small dots: episodes. {note}".strip(),
            {**_LOOK, "label": "task", "value": "geometric_mean", "dots": dots, "xlabel": _AXIS},
        ),
        "fractions": Figure(
            f"attention_fractions{end}", "stacked", groups, "How attention is divided, by layer",
            f"Masses: {table.grouping.description}.",
            {"x": "layer", "value": "fraction", "color": "group", "ylabel": "part of the attention"},
        ),
    }  # fmt: skip
    return [made[name] for name in wanted]


def comparison(tables: Sequence[ResultsTables], labels: Sequence[str]) -> list[Figure]:
    """The files side by side: geometric mean ratios with intervals, and the fractions of their groups."""
    data, dots = comparison_table(tables, labels), []
    for table, label in zip(tables, labels, strict=True):
        of_file = table.episodes.filter(layer=_layer(table)).select("geometric_mean")
        dots.append(of_file.with_columns(pl.lit(label).alias("file")))
    kinds = data["kind"].n_unique() > 1
    note = " Files of different kinds measure different things: compare within a kind." if kinds else ""
    fractions = fractions_table(tables, labels)
    options = {**_LOOK, "label": "file", "value": "geometric_mean", "dots": pl.concat(dots), "xlabel": _AXIS}
    return [
        Figure(
            "results_comparison", "forest", data, "Ratio visual / linguistic of each results file",
            f"Geometric means over tasks, with 95% intervals.{note}", options | ({"color": "kind"} if kinds else {}),
        ),
        Figure(
            "results_comparison_groups", "stacked", fractions, "How attention is divided, by file", "",
            {"x": "file", "value": "fraction", "color": "group", "ylabel": "part of the attention"},
        ),
    ]  # fmt: skip


def comparison_table(tables: Sequence[ResultsTables], labels: Sequence[str]) -> pl.DataFrame:
    """One row per results file, over all its episodes, in its overall layer ("layers_avg", else the first).

    Columns: file, kind, layer, num_tasks, num_episodes, episodes_without_ratio, num_replans, num_nonfinite,
    success_rate, geometric_mean with geometric_mean_low and geometric_mean_high (about tasks like these), ratio_std
    (over episodes), uniform_ratio (null where the file has no numbers of keys).
    """
    columns = ["num_tasks", "num_episodes", "episodes_without_ratio", "num_replans", "num_nonfinite", "success_rate"]
    columns += ["geometric_mean", "geometric_mean_low", "geometric_mean_high", "ratio_std", "uniform_ratio"]
    rows = []
    for table, label in zip(tables, labels, strict=True):
        of_file = overall(table.tasks).filter(layer=_layer(table))
        identity = [pl.lit(label).alias("file"), pl.lit(table.grouping.description).alias("kind"), pl.col("layer")]
        rows.append(of_file.select(*identity, *columns))
    return pl.concat(rows, how="vertical_relaxed")


def fractions_table(tables: Sequence[ResultsTables], labels: Sequence[str]) -> pl.DataFrame:
    """Mean fractions of the files' groups: file, group, fraction, fraction_low, fraction_high."""
    columns = ["group", "fraction", "fraction_low", "fraction_high"]
    return pl.concat(
        overall(table.groups).filter(layer=_layer(table)).select(pl.lit(label).alias("file"), *columns)
        for table, label in zip(tables, labels, strict=True)
    )


def _layer(table: ResultsTables) -> str:
    """ "layers_avg" where the file has it, else its first layer."""
    layers = (
        table.tasks.select("layer", "layer_number").unique().sort("layer_number", "layer", nulls_last=True)["layer"]
    )
    return LAYERS_AVG if LAYERS_AVG in layers.to_list() else str(layers[0])
