"""`{prefix}_layer{N}_ratio_evolution`: one episode in one layer over time: ratio, masses, fractions, statistics."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from vla_attention.analyze.core.levels import Levels, replan_cells
from vla_attention.analyze.core.measure import means
from vla_attention.analyze.measures.tables import LAYERS_AVG, float_values, layer_name
from vla_attention.analyze.render.figures import lines, stacked
from vla_attention.analyze.render.numbers import format_number
from vla_attention.analyze.render.style import NOTE_COLOR, Style, explain, wrapped
from vla_attention.analyze.render.terminal import shortened
from vla_attention.analyze.statistics.summaries import geometric_mean, summarize
from vla_attention.schemas.errors import plural
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.safe_text import file_part

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

_SLUG_LENGTH = 60
#: Lines of the panel of statistics.
_MOST_LINES = 14


def evolution_files(levels: Levels) -> dict[str, Callable[[Path], None]]:
    """A picture of every (episode, layer), by the name of its file; each draws itself when it is written.

    They are called `task{id}_{slug}_ep{k}_layer{N}_ratio_evolution.png`, or `..._layers_avg_...`, in the folder
    `episodes`, with a folder for each suite where there are several.
    """
    several = len({item.store.suite for item in levels.question.selected}) > 1
    layers = dict.fromkeys([*map(str, levels.question.selection.layer_labels), LAYERS_AVG])
    files: dict[str, Callable[[Path], None]] = {}
    for i, item in enumerate(levels.question.selected):
        about = item.episode.attributes
        folder = f"episodes/{file_part(item.store.suite)}" if several else "episodes"
        slug = re.sub(r"[^a-z0-9]+", "_", about.instruction.lower()).strip("_")[:_SLUG_LENGTH].rstrip("_") or "task"
        for layer in layers:
            of_layer = layer if layer == LAYERS_AVG else f"layer{layer}"
            stem = f"task{about.task_id}_{slug}_ep{about.episode_index}_{of_layer}_ratio_evolution"
            files[f"{folder}/{stem}.png"] = partial(_write, levels=levels, number=i, layer=layer)
    return files


def _write(path: Path, levels: Levels, number: int, layer: str) -> None:
    measured, grouping = levels.measured[number], levels.grouping
    cells = replan_cells(measured, grouping).filter(layer=layer).sort("replan")
    rows = means(measured, ("replan", "layer"))
    groups = rows.filter(kind="group", layer=layer).rename({"share": "fraction"}).sort("replan")
    with Style().settings():
        path.write_bytes(Style().content(_draw(cells, groups, grouping), "png"))


def _draw(cells: pl.DataFrame, groups: pl.DataFrame, grouping: Grouping) -> Canvas:
    """Four panels of one episode in one layer: ratio, masses, fractions, statistics.

    Args:
        cells: `levels.replan_cells` of the episode and layer, a row per replan.
        groups: replan, env_step, group, mass and fraction. Groups without mass in the episode are left out.
    """
    drawn = [name for name in grouping.names if (groups.filter(group=name)["mass"] > 0).any()]
    groups = pl.concat([groups.clear(), *(groups.filter(group=name) for name in drawn)])
    first = cells.row(0, named=True)
    of_layer = layer_name(first["layer"], "mean over layers")
    block = "" if first["layer"] == LAYERS_AVG else f" (block {first['block']})"
    outcome = {None: "outcome not known", True: "success", False: "failure"}[first["success"]]
    canvas = Style().canvas(10, 6.8)
    title = f"{first['suite']} task {first['task_id']}, episode {first['episode_index']}: {first['instruction']}"
    note = f"{of_layer}{block}; {outcome} after {first['num_steps']} steps; {plural(cells.height, 'replan')}; "
    note += f"grouping '{grouping.name}'"
    canvas.text(0.01, 0.985, f"{wrapped(title, 125, 2)}\n{wrapped(note, 125, 1)}", va="top", size=9, linespacing=1.35)
    ratio, mass, fraction, statistics = canvas.subplots(2, 2).flat
    for axes, name in zip(
        (ratio, mass, fraction, statistics), ("ratio", "mass", "fractions", "statistics over the replans"), strict=True
    ):
        axes.set_title(name, loc="left")
    finite = "ratio" in cells.columns and cells.filter(pl.col("ratio").is_finite() & (pl.col("ratio") > 0)).height
    if grouping.ratio is None or not finite:
        explain(ratio, f"Grouping '{grouping.name}' defines no ratio." if grouping.ratio is None else
                "No finite ratio: each is infinite (no denominator mass), undefined or 0.")  # fmt: skip
    else:
        lines(ratio, cells, {"x": "env_step", "value": "ratio", "uniform": "uniform_ratio", "log": True})
        ratio.set_ylabel(f"{' / '.join(map(_side, (grouping.ratio.numerator, grouping.ratio.denominator)))} (log axis)")
        ratio.legend(loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.1)
    if drawn:
        lines(mass, groups, {"x": "env_step", "value": "mass", "color": "group"})
        stacked(fraction, groups, {"x": "env_step", "value": "fraction", "color": "group"})
        canvas.legend(*fraction.get_legend_handles_labels(), loc="lower center", ncols=6)
    else:
        explain(mass, "No group has any mass in this episode.")
        explain(fraction, "No group has any mass in this episode.")
    mass.set_ylabel("mass (mean over action queries)")
    fraction.set_ylabel("part of the groups' summed mass")
    for axes in (ratio, mass, fraction):
        axes.set_xlabel("environment step")
    explain(statistics, "")
    said = _statistics(cells, groups, grouping, drawn)
    for x, align, color, texts in ((0.02, "left", NOTE_COLOR, said), (0.97, "right", "black", said.values())):
        statistics.text(x, 0.97, "\n".join(texts), transform=statistics.transAxes, va="top", ha=align, size=8.5,
                        color=color, linespacing=1.5)  # fmt: skip
    canvas.tight_layout(rect=(0, 0.05, 1, 0.92))
    return canvas


def _side(names: tuple[str, ...]) -> str:
    """Groups on an axis: their names, or how many they are where those would not fit."""
    joined = " + ".join(names)
    return f"{len(names)} groups" if len(joined) > 24 and len(names) > 1 else shortened(joined, 24)


def _statistics(cells: pl.DataFrame, groups: pl.DataFrame, grouping: Grouping, drawn: list[str]) -> dict[str, str]:
    """What the fourth panel says."""
    said: dict[str, str] = {}
    if grouping.ratio:
        values = float_values(cells["ratio"])
        known = summarize(values)
        uniform, lift = (summarize(float_values(cells[name])).mean for name in ("uniform_ratio", "ratio_lift"))
        of_means = cells.select(pl.col("numerator_mass").mean() / pl.col("denominator_mass").mean()).item()
        said = {
            "ratio, mean ± std": f"{format_number(known.mean)} ± {format_number(known.std)}",
            "ratio, median": format_number(known.median),
            "ratio, min / max": f"{format_number(known.min)} / {format_number(known.max)}",
            "ratio of mean masses": format_number(of_means),
            "geometric mean of ratios": format_number(geometric_mean(values)[0]),
            "not finite, left out": f"{known.num_nonfinite} of {len(values)}",
            "ratio of uniform attention": format_number(uniform),
            "lift (ratio / uniform)": format_number(lift),
        }
    shares = {name: summarize(float_values(groups.filter(group=name)["fraction"])) for name in drawn}
    room = _MOST_LINES - len(said)
    largest = sorted(drawn, key=lambda name: -(shares[name].mean or 0.0))[: room - (len(drawn) > room)]
    for name in drawn:
        if name in largest:
            mean, std = shares[name].mean, shares[name].std
            said[f"{shortened(name, 26)}, %"] = "-" if mean is None else f"{100 * mean:.1f} ± {100 * (std or 0):.1f}"
    if len(largest) < len(drawn):
        said[f"and {len(drawn) - len(largest)} smaller groups"] = ""
    return said
