"""`{prefix}_layer{N}_ratio_evolution`: one episode in one layer over time: ratio, masses, fractions, statistics."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.levels import MORE, Levels, replan_cells
from vla_attention.analyze.core.measure import means
from vla_attention.analyze.measures.frames import LAYERS_AVG, float_values, layer_name
from vla_attention.analyze.measures.masses import ratio
from vla_attention.analyze.render.numbers import format_number
from vla_attention.analyze.render.plot_axes import (
    BASELINE_LABEL,
    legend_above,
    ratio_axis,
    share_ticks,
    uniform_line,
    whole_numbers,
)
from vla_attention.analyze.render.plot_colours import (
    BASELINE_COLOR,
    DATA_COLOR,
    LINE_OF_HATCH,
    NOTE_COLOR,
    group_styles,
)
from vla_attention.analyze.render.plot_text import explain, ratio_name, title, wrapped
from vla_attention.analyze.render.style import Style, new_canvas
from vla_attention.analyze.statistics.summaries import geometric_mean, summarize
from vla_attention.schemas.errors import plural
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.safe_text import file_part

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SLUG_LENGTH = 60
#: Group -> its rows, one per replan; group -> its colour and hatch.
Groups = Mapping[str, pl.DataFrame]
Styles = Mapping[str, Mapping[str, str]]


def evolution_stem(task_id: int, instruction: str, episode_index: int, layer: str) -> str:
    """File name: `task{id}_{slug}_ep{k}_layer{N}_ratio_evolution`, or `..._layers_avg_...`, without ending."""
    slug = re.sub(r"[^a-z0-9]+", "_", instruction.lower()).strip("_")[:_SLUG_LENGTH].rstrip("_") or "task"
    of_layer = layer if layer == LAYERS_AVG else f"layer{layer}"
    return f"task{task_id}_{slug}_ep{episode_index}_{of_layer}_ratio_evolution"


def evolution_files(levels: Levels) -> dict[str, Callable[[Path], None]]:
    """A picture of every (episode, layer), by the name of its file; each draws itself when it is written.

    They are in the folder `episodes`, with a folder for each suite where there are several.
    """
    several = len({item.store.suite for item in levels.question.selected}) > 1
    layers = [*map(str, levels.question.selection.layer_labels), LAYERS_AVG]
    files: dict[str, Callable[[Path], None]] = {}
    for i, item in enumerate(levels.question.selected):
        about = item.episode.attributes
        folder = f"episodes/{file_part(item.store.suite)}" if several else "episodes"
        for layer in dict.fromkeys(layers):
            stem = evolution_stem(about.task_id, about.instruction, about.episode_index, layer)
            files[f"{folder}/{stem}.png"] = partial(_write, levels=levels, number=i, layer=layer)
    return files


def _write(path: Path, levels: Levels, number: int, layer: str) -> None:
    rows, grouping = means(levels.measured[number], ("replan", "layer"), MORE), levels.grouping
    cells = replan_cells(rows, grouping).filter(layer=layer)
    groups = rows.filter(kind="group", layer=layer).rename({"share": "fraction"})
    with Style().settings():
        figure = draw_evolution(cells, groups, grouping)
        figure.savefig(path, format="png", dpi=Style().dpi)


def draw_evolution(cells: pl.DataFrame, rows: pl.DataFrame, grouping: Grouping) -> Figure:
    """Four panels of one episode in one layer: ratio, masses, fractions, statistics.

    Args:
        cells: `levels.replan_cells` of the episode and layer, a row per replan.
        rows: replan, group, mass and fraction of the groups.
        grouping: the groups and the ratio. Groups without mass in the episode are left out of the legend.
    """
    episode = cells.sort("replan")
    groups = {name: rows.filter(group=name).sort("replan") for name in grouping.names}
    first = episode.row(0, named=True)
    layer = first["layer"]
    figure = new_canvas(10, 6.8)
    of_layer = layer_name(layer, "mean over layers") + (f" (block {first['block']})" if layer != LAYERS_AVG else "")
    outcome = {None: "outcome not known", True: "success", False: "failure"}[first["success"]]
    note = (
        f"{of_layer}; {outcome} after {first['num_steps']} steps; {plural(episode.height, 'replan')}; "
        f"grouping '{grouping.name}'"
    )
    heading = f"{first['suite']} task {first['task_id']}, episode {first['episode_index']}: {first['instruction']}"
    title(figure, heading, note)
    ((ratio_axes, mass_axes), (fraction_axes, statistics_axes)) = figure.subplots(2, 2)
    steps = episode["env_step"].to_numpy()
    styles = group_styles(grouping.names)
    drawn = [name for name in grouping.names if (groups[name]["mass"] > 0).any()]
    _ratio_panel(ratio_axes, episode, steps, grouping)
    _mass_panel(mass_axes, groups, steps, drawn, styles)
    _fraction_panel(fraction_axes, groups, steps, drawn, styles)
    _statistics_panel(statistics_axes, episode, groups, grouping, drawn)
    # Room at either end for the markers of the first and the last replan.
    room = 0.02 * (steps[-1] - steps[0]) or 2.5
    for axes in (ratio_axes, mass_axes, fraction_axes):
        if axes.spines["left"].get_visible():  # not those that hold an explanation
            axes.set_xlim(steps[0] - room, steps[-1] + room)
            axes.set_xlabel("environment step")
            whole_numbers(axes.xaxis)
    _group_legend(figure, drawn, styles)
    return figure


def _ratio_panel(axes: Axes, episode: pl.DataFrame, steps: NDArray[np.int64], grouping: Grouping) -> None:
    axes.set_title("ratio", loc="left")
    if grouping.ratio is None:
        explain(axes, f"Grouping '{grouping.name}' defines no ratio.")
        return
    ratio = float_values(episode["ratio"])
    uniform = float_values(episode["uniform_ratio"])
    drawable = np.isfinite(ratio) & (ratio > 0)
    if not drawable.any():
        infinite = int(np.isinf(ratio).sum())
        explain(
            axes,
            f"No finite ratio: {infinite} of {len(ratio)} are infinite (no denominator mass), the others undefined or "
            "0.",
        )
        return
    ratio_axis(axes.yaxis, np.concatenate([ratio, uniform]))
    axes.plot(steps, np.where(drawable, ratio, np.nan), "o-", color=DATA_COLOR, markersize=3.5, label="ratio")
    if np.isfinite(uniform).any():
        # A line through one point is invisible: it is drawn across the panel.
        if len(steps) == 1:
            uniform_line(axes, uniform[0], linewidth=1.2, label=BASELINE_LABEL)
        else:
            axes.plot(steps, uniform, "--", color=BASELINE_COLOR, linewidth=1.2, label=BASELINE_LABEL)
    if not drawable.all():
        where = axes.get_xaxis_transform()
        axes.plot(
            steps[~drawable], np.full((~drawable).sum(), 0.985), "x", color="#D55E00", transform=where, markersize=5,
            label="not finite or 0", clip_on=False,
        )  # fmt: skip
    axes.grid(axis="y")
    axes.set_ylabel(f"{ratio_name(grouping.ratio)} (log axis)")
    legend_above(axes, 3)


def _mass_panel(axes: Axes, groups: Groups, steps: NDArray[np.int64], drawn: Sequence[str], styles: Styles) -> None:
    axes.set_title("mass", loc="left")
    for name in drawn:
        style = styles[name]
        axes.plot(
            steps,
            groups[name]["mass"].to_numpy(),
            LINE_OF_HATCH[style["hatch"]],
            marker="o",
            markersize=2.5,
            color=style["color"],
        )
    axes.set_ylim(bottom=0)
    axes.set_ylabel("mass (mean over action queries)")
    axes.grid(axis="y")


def _fraction_panel(axes: Axes, groups: Groups, steps: NDArray[np.int64], drawn: Sequence[str], styles: Styles) -> None:
    axes.set_title("fractions", loc="left")
    if not drawn:
        explain(axes, "No group has any mass in this episode.")
        return
    shares = [groups[name]["fraction"].fill_null(0).to_numpy() for name in drawn]
    bottom = np.zeros(len(steps))
    for name, share in zip(drawn, shares, strict=True):
        style: dict[str, Any] = {
            "facecolor": styles[name]["color"],
            "hatch": styles[name]["hatch"],
            "edgecolor": "white",
            "linewidth": 0.3,
        }
        if len(steps) == 1:
            axes.bar(steps, share, 2.0, bottom, **style)  # an area over one point would be invisible
        else:
            axes.fill_between(steps, bottom, bottom + share, **style)
        bottom = bottom + share
    axes.set_ylim(0, 1)
    share_ticks(axes.yaxis, 6)
    axes.set_ylabel("fraction of the groups' summed mass")


def _statistics_panel(
    axes: Axes, episode: pl.DataFrame, groups: Groups, grouping: Grouping, drawn: Sequence[str]
) -> None:
    axes.set_title("statistics over the replans", loc="left")
    explain(axes, "")
    lines: list[tuple[str, str]] = []
    if grouping.ratio:
        values = float_values(episode["ratio"])
        summary = summarize(values)
        geometric, _ = geometric_mean(values)
        above, below = (np.asarray(episode[f"{side}_mass"].mean()) for side in ("numerator", "denominator"))
        lines += [
            ("ratio, mean ± std", _with_spread(format_number(summary.mean), format_number(summary.std), len(values))),
            ("ratio, median", format_number(summary.median)),
            ("ratio, min / max", f"{format_number(summary.min)} / {format_number(summary.max)}"),
            ("ratio of mean masses", format_number(float(ratio(above, below)))),
            ("geometric mean of ratios", format_number(geometric)),
            ("not finite, left out", f"{summary.num_nonfinite} of {len(values)}"),
            ("ratio of uniform attention", format_number(_finite_mean(episode["uniform_ratio"]))),
            ("lift (ratio / uniform)", format_number(_finite_mean(episode["ratio_lift"]))),
        ]
    room = 14 - len(lines)
    means = {name: summarize(float_values(groups[name]["fraction"])).mean for name in drawn}
    largest = sorted(drawn, key=lambda name: -(means[name] or 0.0))
    shown = [name for name in drawn if name in largest[: room - (len(drawn) > room)]]
    for name in shown:
        fraction = summarize(float_values(groups[name]["fraction"]))
        text = "-"
        if fraction.mean is not None:
            spread = f"{100 * (fraction.std or 0):.1f}"
            text = _with_spread(f"{100 * fraction.mean:.1f}", spread, episode.height) + " %"
        lines.append((f"{wrapped(name, 26, 1)}, fraction", text))
    if len(shown) < len(drawn):
        lines.append((f"and {len(drawn) - len(shown)} smaller groups", ""))
    for number, (label, value) in enumerate(lines):
        height = 0.97 - number * 0.072
        axes.text(0.02, height, label, transform=axes.transAxes, va="top", size=8.5, color=NOTE_COLOR)
        axes.text(0.97, height, value, transform=axes.transAxes, va="top", ha="right", size=8.5)


def _with_spread(mean: str, spread: str, count: int) -> str:
    """`mean ± std`; the mean alone for a single replan, or where there is no finite value."""
    return mean if count < 2 or mean == "-" else f"{mean} ± {spread}"


def _finite_mean(series: pl.Series) -> float | None:
    return summarize(float_values(series)).mean


def _group_legend(figure: Figure, drawn: Sequence[str], styles: Styles) -> None:
    from matplotlib.patches import Patch

    if not drawn:
        return
    handles = [
        Patch(
            facecolor=styles[name]["color"], hatch=styles[name]["hatch"], edgecolor="white", label=wrapped(name, 28, 1)
        )
        for name in drawn
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 6 if len(handles) <= 6 else 5))
