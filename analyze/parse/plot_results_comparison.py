"""`results_comparison`: results files side by side: mean ratio with interval, single episodes, fractions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from vla_attention.analyze.measures.aggregate import FRACTION_COLUMNS, overall_layer, overall_rows
from vla_attention.analyze.measures.frames import LAYERS_AVG, layer_name
from vla_attention.analyze.published.results_tables import ResultsTables
from vla_attention.analyze.show.numbers import interval_name, plural
from vla_attention.analyze.show.plot_axes import BASELINE_LABEL, note_at_row, ratio_axis, scattered, share_ticks
from vla_attention.analyze.show.plot_colours import BASELINE_COLOR, FIXED_COLORS, NOTE_COLOR, SERIES_COLORS
from vla_attention.analyze.show.plot_rows import MANY_ROWS, draw_estimate, draw_uniform
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import title, wrapped
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEM = "results_comparison"
#: Colour and marker of each kind of masses, in order of appearance.
_KINDS = tuple(zip(SERIES_COLORS, "oDs^vP", strict=True))
_FRACTIONS = ("visual", "linguistic", "action", "rest")


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
        layer = overall_layer(table.tasks.cells)
        row = overall_rows(table.tasks).cells.filter(layer=layer).row(0, named=True)
        identity = {"file": label, "kind": table.grouping.description, "layer": layer}
        rows.append({**identity, **{column: row[column] for column in columns}})
    floats = dict.fromkeys(columns[6:], pl.Float64)
    return pl.DataFrame(rows, schema_overrides=floats, infer_schema_length=None)


def fractions_table(tables: Sequence[ResultsTables], labels: Sequence[str]) -> pl.DataFrame:
    """Mean fractions of the files' groups in the layer of `comparison_table`.

    Columns: file, group, fraction, fraction_low, fraction_high.
    """
    parts = []
    for table, label in zip(tables, labels, strict=True):
        rows = overall_rows(table.tasks).filter(pl.col("layer") == overall_layer(table.tasks.cells)).groups
        parts.append(rows.select(pl.lit(label).alias("file"), "group", *FRACTION_COLUMNS))
    return pl.concat(parts)


@drawn_in_our_style
def plot_results_comparison(tables: Sequence[ResultsTables], labels: Sequence[str], folder: Path) -> list[Path]:
    """Draw one row per results file; returns the paths of png, pdf and csv. A row without a finite ratio says so."""
    data = comparison_table(tables, labels)
    few = data.height <= MANY_ROWS
    kinds = data["kind"].unique(maintain_order=True).to_list()
    figure = new_figure(10, 1.9 + (0.42 if few else 0.22) * (data.height + 0.5) + 0.16 * len(kinds))
    note = (
        f"n counts episodes. Geometric means over tasks with {interval_name(DEFAULT_LEVEL)}s (about tasks like these)."
    )
    if data["uniform_ratio"].null_count():
        note += " No uniform baseline where a results file does not hold the numbers of keys."
    if len(kinds) > 1:
        note += " Files of different kinds measure different things: compare within a kind."
    layers = data["layer"].unique(maintain_order=True).to_list()
    which = ", ".join(layer_name(layer, LAYERS_AVG) for layer in layers)
    suite = _common_suite(data)
    of = f" of {suite}" if suite else ""
    title(figure, f"{plural(data.height, 'results file')}{of}, {which}", note)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=[1.5, 1])
    _ratios(left, data, tables, kinds, few)
    fractions = fractions_table(tables, labels)
    _stacked_fractions(right, labels, fractions)
    figure.legend(handles=left.get_legend_handles_labels()[0], loc="outside lower left", ncols=min(len(kinds) + 1, 2))
    left.set_yticks(range(data.height), row_names(data, few))
    left.set_ylim(data.height - 0.4, -0.6)
    left.tick_params(axis="y", length=0)
    right.tick_params(axis="y", length=0)
    return save_figure(figure, folder, STEM, {"": data, "_groups": fractions})


def row_names(data: pl.DataFrame, few: bool) -> list[str]:
    """Labels of the rows, shortened to the room; with the row number where two would be equal.

    The title names a suite that all files share; labels name layers only where files differ in them.
    """
    layers = [layer_name(layer, LAYERS_AVG) for layer in data["layer"]]
    names = []
    for label, layer in zip(data["file"], layers, strict=True):
        folder, _, suite = label.rpartition("/")
        parts = [folder, suite] if _common_suite(data) is None or not folder else [folder]
        if len(set(layers)) > 1:
            parts[-1] += f" ({layer})"
        parts = [part for part in parts if part]
        joined = "/".join(parts)
        if len(joined) <= 36:
            names.append(joined)
        else:
            names.append(
                "\n".join(map(_clipped, parts)) if few else "/".join(_clipped(part, 44 // len(parts)) for part in parts)
            )
    return [f"{i + 1}: {name}" if names.count(name) > 1 else name for i, name in enumerate(names)]


def _common_suite(data: pl.DataFrame) -> str | None:
    """The suite that all files are about, when folders tell them apart."""
    suites = {label.rpartition("/")[2] for label in data["file"]}
    return suites.pop() if len(suites) == 1 and data.height > 1 else None


def _clipped(text: str, most: int = 40) -> str:
    return text if len(text) <= most else f"{text[: most // 2]}…{text[-(most - most // 2 - 1) :]}"


def _ratios(axes: Axes, data: pl.DataFrame, tables: Sequence[ResultsTables], kinds: list[str], few: bool) -> None:
    generator = np.random.default_rng(0)
    dots = [
        table.episodes.cells.filter(layer=layer)["geometric_mean"].drop_nulls().to_numpy()
        for table, layer in zip(tables, data["layer"], strict=True)
    ]
    bounds = [data[f"geometric_mean{end}"].drop_nulls().to_numpy() for end in ("", "_low", "_high")]
    uniform = data["uniform_ratio"].drop_nulls().to_numpy()
    ratio_axis(axes.xaxis, np.concatenate([*bounds, *dots, uniform]))
    low, high = axes.get_xlim()
    if low < 1 < high:
        axes.axvline(1.0, color=NOTE_COLOR, linewidth=0.9, zorder=1)
        axes.text(1.0, 1.0, "equal masses", transform=axes.get_xaxis_transform(), ha="center", va="bottom", size=7)
    for position, (row, values) in enumerate(zip(data.iter_rows(named=True), dots, strict=True)):
        color, marker = _KINDS[kinds.index(row["kind"]) % len(_KINDS)]
        values = values[values > 0]
        places = scattered(generator, position, len(values))
        axes.scatter(values, places, s=10 if few else 6, color=color, alpha=0.35, linewidths=0, zorder=2)
        if row["geometric_mean"] is None or row["geometric_mean"] <= 0:
            text = "no finite ratio" if row["geometric_mean"] is None else "mean ratio 0"
            note_at_row(axes, position, text, x=0.01)
        else:
            first, last = row["geometric_mean_low"], row["geometric_mean_high"]
            ends = (first if first is None else max(first, low), last)
            draw_estimate(axes, position, row["geometric_mean"], ends, color, marker)
        if row["uniform_ratio"]:
            draw_uniform(axes, position, row["uniform_ratio"])
        text = f"n = {row['num_episodes']}"
        if row["episodes_without_ratio"]:
            text += f" ({row['episodes_without_ratio']} without)"
        note_at_row(axes, position, text)
    for i, kind in enumerate(kinds):
        color, marker = _KINDS[i % len(_KINDS)]
        axes.plot([], [], marker, color=color, markersize=6, label=wrapped(kind, 60, 2))
    axes.scatter([], [], s=10, color=NOTE_COLOR, alpha=0.5, linewidths=0, label="single episode")
    if uniform.size:
        axes.plot([], [], "--", color=BASELINE_COLOR, linewidth=1.2, label=BASELINE_LABEL)
    axes.grid(axis="x")
    axes.set_xlabel("ratio of masses, visual / linguistic (logarithmic)")


def _stacked_fractions(axes: Axes, files: Sequence[str], fractions: pl.DataFrame) -> None:
    start = np.zeros(len(files))
    for name in _FRACTIONS:
        known = dict(fractions.filter(group=name).drop_nulls("fraction").select("file", "fraction").iter_rows())
        if not known:
            continue
        values = np.array([known.get(file, 0.0) for file in files])
        label = "other" if name == "rest" else name
        axes.barh(range(len(files)), values, 0.6, start, color=FIXED_COLORS[name], edgecolor="white", label=label)
        for position, (value, left) in enumerate(zip(values, start, strict=True)):
            if value >= 0.09:
                axes.text(
                    left + value / 2, position, f"{100 * value:.0f}", ha="center", va="center", size=7, color="white"
                )
        start += values
    axes.set_xlim(0, 1)
    share_ticks(axes.xaxis, 5)
    axes.set_xlabel("mean fraction")
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2, handlelength=1.0, columnspacing=1.0
    )
