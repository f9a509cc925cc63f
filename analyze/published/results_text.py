"""The text of `parse-attention-ratio-results`: the published parser's numbers, intervals, and notes on them."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any

import polars as pl

from vla_attention.analyze.core.levels import overall
from vla_attention.analyze.core.result import Column, Table
from vla_attention.analyze.measures.frames import LAYERS_AVG, layer_name
from vla_attention.analyze.measures.task_families import related_instructions
from vla_attention.analyze.published.results_reader import ResultsFile
from vla_attention.analyze.published.results_tables import (
    ResultsTables,
    Spread,
    by_kind,
    disagreements,
    layers_of,
    overall_layer,
    spread_of,
    uniform_ratios,
)
from vla_attention.analyze.render.numbers import format_number
from vla_attention.analyze.render.terminal import WIDTH, table_text
from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.results import ResultsError

#: Thresholds of the published interpretation guide, on the mean ratio.
VISUAL_ABOVE, LINGUISTIC_BELOW = 1.5, 0.67
_VERDICTS = {
    "visual-dominant": "Model is VISUAL-dominant (prefers visual features)",
    "linguistic-dominant": "Model is LINGUISTIC-dominant (prefers text instructions)",
    "balanced": "Model shows BALANCED attention between visual and linguistic",
}
_CAVEAT = (
    "The file does not say how many keys are on each side, so there is no uniform baseline here. With hundreds of "
    "image keys and a dozen words, uniform attention alone gives ratios of 35 to 50: the verdict (above "
    f"{VISUAL_ABOVE} visual, below {LINGUISTIC_BELOW} linguistic) means little without it. vla-analyze prints it "
    "beside every ratio."
)
_FRAMES_CAVEAT = (
    "Latent frames have equally many keys: uniform attention gives a ratio of 1. The usual text frame, frame0, is a "
    "blank placeholder without language: an instruction enters through cross-attention, which these masses are not of. "
    "Masses may be sums over queries."
)


def verdict(ratio: float | None) -> str:
    """The guide's name for a mean ratio: above 1.5, below 0.67, or between; "undefined" without a ratio."""
    if ratio is None or math.isnan(ratio):
        return "undefined"
    if ratio > VISUAL_ABOVE:
        return "visual-dominant"
    return "linguistic-dominant" if ratio < LINGUISTIC_BELOW else "balanced"


def wrap(text: str, first: str = "", rest: str = "") -> list[str]:
    """Lines of a screen's width; `first` and `rest` indent the first line and the others."""
    return textwrap.wrap(
        text, WIDTH, initial_indent=first, subsequent_indent=rest, break_long_words=False, break_on_hyphens=False
    )


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}%"


def summary_of_files(title: str, files: Sequence[ResultsFile], tables: ResultsTables) -> str:
    """The block on one file, or on several of one kind pooled ("COMBINED")."""
    episodes = pl.concat([file.episodes.with_columns(pl.lit(i).alias("file")) for i, file in enumerate(files)])
    layer = LAYERS_AVG if LAYERS_AVG in _layers(files) else _layers(files)[0]
    rows = pl.concat(_rows_of(files, layer))
    spread = spread_of(rows["ratio"])
    lines = ["=" * WIDTH, f"ATTENTION RATIO ANALYSIS: {title}", "=" * WIDTH, *_origin(files), ""]
    lines += _dataset(episodes)
    lines += [
        "",
        f"Visual/Linguistic Ratio ({_named(layer)}, {plural(spread.num_replans, 'replan')}):",
        *_ratio(spread, layer),
        *_baseline(rows, spread),
    ]
    lines += _over_episodes(tables, layer)
    lines += ["", f"Attention Fractions ({_named(layer)}):", *_fractions(rows)]
    if len(_layers(files)) > 1:
        lines += ["", "Per layer", _per_layer(files)]
    lines += ["", f"Per task ({_named(layer)})", _per_task(episodes, files, layer)]
    known = rows.select(uniform_ratios().is_not_null().all()).item()
    notes = [
        *([_FRAMES_CAVEAT] if files[0].kind.frames else [] if known else [_CAVEAT]),
        *(note for file in files for note in _notes(file, layer, named=len(files) > 1)),
    ]
    if notes:
        lines += ["", "Notes", *(line for note in notes for line in wrap(note, first="  - ", rest="    "))]
    return "\n".join(lines) + "\n"


def why_not_pooled(files: Sequence[ResultsFile], side_by_side: bool) -> str:
    """The reason why several files have no COMBINED block; empty where they have one.

    Raises:
        ResultsError: the files hold masses of different kinds, and are not to be compared `side_by_side`.
    """
    kinds = by_kind(files)
    if len(kinds) > 1:
        parts = "; ".join(f"{listing([file.path for file in of_kind], 3)}: {kind}" for kind, of_kind in kinds.items())
        if not side_by_side:
            raise ResultsError(
                f"These results files hold masses of different kinds, which cannot be summarised together ({parts}); "
                "give one kind at a time, or see them side by side with --plot-comparison."
            )
        return _paragraph(f"No COMBINED: the files hold masses of different kinds ({parts}).")
    repeated = sorted({file.suite for file in files if sum(file.suite == other.suite for other in files) > 1})
    if repeated:
        paths = [file.path for file in files if file.suite in repeated]
        return _paragraph(
            f"No COMBINED: {listing(paths, 4)} are about the same suite ({listing(repeated)}), that is, different runs "
            "of it."
        )
    return ""


def _paragraph(text: str) -> str:
    return "\n".join(wrap(text)) + "\n"


def _layers(files: Sequence[ResultsFile]) -> list[str]:
    """Layers of all files by number, "layers_avg" last."""
    layers = dict.fromkeys(layer for file in files for layer in layers_of(file))
    return sorted(layers, key=lambda layer: (layer == LAYERS_AVG, int(layer) if layer != LAYERS_AVG else 0))


def _rows_of(files: Sequence[ResultsFile], layer: str) -> list[pl.DataFrame]:
    """Steps of that layer; of a pooled file without this layer, those of its overall layer."""
    parts = []
    for i, file in enumerate(files):
        shown = layer if layer in layers_of(file) else overall_layer(file)
        parts.append(file.steps.filter(pl.col("layer") == shown).with_columns(pl.lit(i).alias("file")))
    return parts


def _origin(files: Sequence[ResultsFile]) -> list[str]:
    kind = files[0].kind
    lines = [f"file:   {file.path}" for file in files]
    lines += wrap(f"masses: {kind}", rest=" " * 8)
    if kind.grouping is not None and kind.grouping[1]:
        lines += wrap(kind.grouping[1], first=" " * 8, rest=" " * 8)
    return lines


def _dataset(episodes: pl.DataFrame) -> list[str]:
    without = episodes.filter(pl.col("num_replans") == 0)
    known, solved = episodes["success"].drop_nulls().len(), int(episodes["success"].sum())
    rate = f"{_percent(solved / known)} ({solved} of {known})" if known else "not known"
    if 0 < known < episodes.height:
        rate += f"; of {episodes.height - known} episodes it is not known"
    lines = [
        "Dataset:",
        f"  Episodes: {episodes.height}",
        f"  Tasks: {episodes.select('file', 'task_id').n_unique()}",
        f"  Success Rate: {rate}",
    ]
    steps = _float(episodes["num_steps"].mean())
    if steps is not None:
        lines.append(f"  Steps: {format_number(steps)} (mean; the loop's counter at the end, waiting steps included)")
    if without.height:
        named = [f"task {row['task_id']} episode {row['episode_index']}" for row in without.iter_rows(named=True)]
        lines.append(f"  Without a single step, and so in no ratio: {listing(named, 6)}")
    return lines


def _ratio(spread: Spread, layer: str) -> list[str]:
    why = "no layer with a finite ratio" if layer == LAYERS_AVG else "no mass on either side"
    parts = {"infinite (no linguistic mass)": spread.num_infinite, f"undefined ({why})": spread.num_undefined}
    left_out = ", ".join(f"{count} {what}" for what, count in parts.items() if count)
    if not spread.num_finite:
        return [f"  None of the {plural(spread.num_replans, 'ratio')} is finite: {left_out}."]
    lines = [
        f"  Mean:   {spread.mean:.3f} ± {spread.std:.3f}",
        f"  Median: {spread.median:.3f}",
        f"  Range:  [{spread.min:.3f}, {spread.max:.3f}]",
        f"  IQR:    [{spread.q25:.3f}, {spread.q75:.3f}]",
    ]
    if left_out:
        lines.append(f"  Left out of {spread.num_replans}: {left_out}")
    return [*lines, f"  → {_VERDICTS[verdict(spread.mean)]}"]


def _baseline(rows: pl.DataFrame, spread: Spread) -> list[str]:
    """The ratio of uniform attention, what the guide calls it, and the lift over it, where the files have them."""
    known = rows.filter(pl.col("ratio").is_finite() & uniform_ratios().is_finite())
    if spread.num_finite == 0 or known.height < spread.num_finite:
        return []
    uniform, lift = (
        _float(known.select(values.mean()).item()) for values in (uniform_ratios(), pl.col("ratio") / uniform_ratios())
    )
    keys = " over ".join(format_number(_float(known[f"{side}_keys"].mean())) for side in ("visual", "linguistic"))
    word, of_uniform = verdict(spread.mean), verdict(uniform)
    same = "the same: here the word means nothing" if word == of_uniform else f"'{of_uniform}'"
    return wrap(
        f"Uniform attention: {format_number(uniform)} ({keys} keys), which the guide calls {same}. Mean of ratio / "
        f"uniform: {format_number(lift)} (arithmetic, as the mean above; the lift of vla-analyze is a geometric mean).",
        first="    ",
        rest="    ",
    )


def _over_episodes(tables: ResultsTables, layer: str) -> list[str]:
    """Replans of an episode are correlated: the interval is over episodes within tasks."""
    rows = overall(tables.tasks).filter(pl.col("layer") == layer)
    if rows.is_empty() or rows["geometric_mean"][0] is None:
        return []
    row = rows.row(0, named=True)
    taking_part = int(row["num_episodes"]) - int(row["episodes_without_ratio"])
    text = f"  Geometric mean over episodes (n = {taking_part}): {format_number(row['geometric_mean'])}"
    if row["geometric_mean_low"] is None:
        return [f"{text}; no interval"]
    interval = f"[{format_number(row['geometric_mean_low'])}, {format_number(row['geometric_mean_high'])}]"
    about = "tasks like these" if row["num_tasks"] > 1 else "episodes like these"
    tasks = tables.episodes.select("suite", "task_id", "instruction").unique(maintain_order=True)
    related = related_instructions(tasks["instruction"].to_list())
    warning = wrap(f"WARNING: {related}", first="    ", rest="    ") if related else []
    return [f"{text}, 95% interval {interval} (about {about})", *warning]


def _fractions(rows: pl.DataFrame) -> list[str]:
    lines = []
    for name in ("visual", "linguistic", "action"):
        if f"{name}_fraction" in rows.columns:
            known = rows[f"{name}_fraction"].cast(pl.Float64).drop_nulls()
            text = (
                f"{_percent(_float(known.mean()))} ± {_percent(_float(known.std(ddof=0)))}"
                if len(known)
                else "undefined"
            )
            lines.append(f"  {name.capitalize() + ':':<12}{text}")
    return lines


def _spread_columns(spread: Spread) -> dict[str, Any]:
    return {
        "replans": spread.num_replans, "mean ± std": _mean_std(spread), "median": spread.median, "min": spread.min,
        "max": spread.max, "infinite": spread.num_infinite, "undefined": spread.num_undefined,
    }  # fmt: skip


_SPREAD = (Column("replans", "count"), Column("mean ± std", "count"), Column("median"), Column("min"),
           Column("max"), Column("infinite", "count"), Column("undefined", "count"))  # fmt: skip


def _per_layer(files: Sequence[ResultsFile]) -> str:
    rows = []
    for layer in _layers(files):
        steps = pl.concat([file.steps.filter(pl.col("layer") == layer) for file in files])
        shares = {name: _float(steps[f"{name}_fraction"].cast(pl.Float64).mean()) for name in ("visual", "linguistic")}
        rows.append({"layer": layer, **_spread_columns(spread_of(steps["ratio"])), **shares})
    columns = [Column("layer", "text"), *_SPREAD, Column("visual", "percent"), Column("linguistic", "percent")]
    return table_text(Table("layers", pl.DataFrame(rows, infer_schema_length=None), columns))


def _per_task(episodes: pl.DataFrame, files: Sequence[ResultsFile], layer: str) -> str:
    steps, rows = pl.concat(_rows_of(files, layer)), []
    for (file, task), part in episodes.partition_by("file", "task_id", as_dict=True, maintain_order=True).items():
        steps_of_task = steps.filter((pl.col("file") == file) & pl.col("episode").is_in(part["episode"].implode()))
        rows.append(
            {
                "task": str(task) if len(files) == 1 else f"{files[int(str(file))].suite} {task}",
                "n": part.height,
                **_spread_columns(spread_of(steps_of_task["ratio"])),
                "success": _float(part["success"].cast(pl.Float64).mean()),
                "instruction": str(part["instruction"][0]),
            }
        )
    columns = [Column("task", "text"), Column("n", "count"), *_SPREAD[:1], Column("success", "percent"), _SPREAD[1],
               Column("instruction", "prose")]  # fmt: skip
    return table_text(Table("tasks", pl.DataFrame(rows, infer_schema_length=None), columns))


def _notes(file: ResultsFile, layer: str, named: bool) -> list[str]:
    of = f"{file.path}: " if named else ""
    notes = []
    if layer not in layers_of(file) or (layer != LAYERS_AVG and not named and len(layers_of(file)) > 1):
        shown = overall_layer(file)
        notes.append(f"{of}There is no {LAYERS_AVG}; layer {shown} is used instead, as in the published parser.")
    lacking = (
        file.episodes.filter(pl.col("num_replans") > 0).height
        - file.steps.filter(layer=overall_layer(file))["episode"].n_unique()
    )
    if lacking:
        notes.append(f"{of}{plural(lacking, 'episode')} with steps, but without any in {_named(overall_layer(file))}.")
    if file.counts_actions:
        notes.append(
            f"{of}num_steps is the number of executed actions in this file, which does not say so because it is an old "
            "one of this tool; the waiting steps (the step of the first replan) are added here, and the action that "
            "solves a task is not counted, as in the published scripts."
        )
    if file.zeros:
        notes.append(
            f"{of}{file.zeros} ratios of 0 stand for 'no ratio' (nothing on either side, or no layer with a finite "
            "ratio) and are read as undefined; the published parser counts them as 0."
        )
    disagreeing = disagreements(file)
    for reason in sorted({item.reason for item in disagreeing if item.reason}):
        count = sum(item.reason == reason for item in disagreeing)
        notes.append(f"{of}Differs from the file's own summary in {plural(count, 'number')}: {reason}.")
    unexplained = [item for item in disagreeing if not item.reason]
    if unexplained:
        first = unexplained[0]
        episode = file.episodes.row(first.stated.episode, named=True)
        notes.append(
            f"{of}The file's own summary disagrees with its steps in {plural(len(unexplained), 'number')}; the first: "
            f"task {episode['task_id']} episode {episode['episode_index']}, {_named(first.stated.layer)}, "
            f"{first.stated.measure} {first.stated.statistic}: summary {format_number(first.stated.value)}, from the "
            f"steps {format_number(first.computed)}. Everything here is computed from the steps."
        )
    if file.unused:
        notes.append(f"{of}Fields that are not used: {listing(file.unused, 20)}.")
    return notes


def _mean_std(spread: Spread) -> str:
    return f"{format_number(spread.mean)} ± {format_number(spread.std)}" if spread.num_finite else "none finite"


def _named(layer: str) -> str:
    return layer_name(layer, LAYERS_AVG)


def _float(value: object) -> float | None:
    return value if isinstance(value, float) else None
