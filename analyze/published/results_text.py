"""The text of `parse-attention-ratio-results`: the published parser's numbers, intervals, and notes on them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import polars as pl

from vla_attention.analyze.core.levels import overall
from vla_attention.analyze.core.result import Column, Table
from vla_attention.analyze.measures.tables import LAYERS_AVG, layer_name
from vla_attention.analyze.measures.task_families import related_instructions
from vla_attention.analyze.published.results_reader import ResultsFile, ResultsKind
from vla_attention.analyze.published.results_tables import (
    UNIFORM_RATIO,
    ResultsTables,
    disagreements,
    layers_of,
    overall_layer,
    spread,
)
from vla_attention.analyze.render.numbers import format_number
from vla_attention.analyze.render.terminal import WIDTH, table_text, wrapped
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
    f"{VISUAL_ABOVE} visual, below {LINGUISTIC_BELOW} linguistic) means little without it. `analyze` prints it "
    "beside every ratio."
)
_FRAMES_CAVEAT = (
    "Latent frames have equally many keys: uniform attention gives a ratio of 1. The usual text frame, frame0, is a "
    "blank placeholder without language: an instruction enters through cross-attention, which these masses are not of. "
    "Masses may be sums over queries."
)
_SPREAD = [
    Column("replans", "count"), Column("mean ± std", "count"), Column("median"), Column("min"), Column("max"),
    Column("infinite", "count"), Column("undefined", "count"),
]  # fmt: skip


def verdict(ratio: float | None) -> str:
    """The guide's name for a mean ratio: above 1.5, below 0.67, or between; "undefined" without a ratio."""
    if ratio is None or math.isnan(ratio):
        return "undefined"
    if ratio > VISUAL_ABOVE:
        return "visual-dominant"
    return "linguistic-dominant" if ratio < LINGUISTIC_BELOW else "balanced"


def summary_of_files(title: str, files: Sequence[ResultsFile], tables: ResultsTables) -> str:
    """The block on one file, or on several of one kind pooled ("COMBINED")."""
    numbered = list(enumerate(files))
    episodes = pl.concat([file.episodes.with_columns(file=pl.lit(i)) for i, file in numbered])
    steps = pl.concat([file.steps.with_columns(file=pl.lit(i)) for i, file in numbered])
    layers, layer = layers_of(steps), overall_layer(steps)
    # Of a pooled file without this layer, those of its overall layer.
    shown = [layer if layer in layers_of(file.steps) else overall_layer(file.steps) for file in files]
    rows = pl.concat([steps.filter(file=i, layer=one) for i, one in enumerate(shown)])
    found = rows.select(spread()).row(0, named=True)
    name, kind = _named(layer), files[0].kind
    lines = [
        "=" * WIDTH,
        f"ATTENTION RATIO ANALYSIS: {title}",
        "=" * WIDTH,
        *(f"file:   {file.path}" for file in files),
    ]
    lines += wrapped([f"masses: {kind}", *(kind.grouping[1:] if kind.grouping and kind.grouping[1] else ())])
    lines += ["", *_dataset(episodes)]
    lines += ["", f"Visual/Linguistic Ratio ({name}, {plural(rows.height, 'replan')}):", *_ratio(found, layer)]
    lines += [*_baseline(rows, found), *_over_episodes(tables, layer)]
    lines += ["", f"Attention Fractions ({name}):", *_fractions(rows)]
    if len(layers) > 1:
        shares = [pl.col(f"{side}_fraction").cast(pl.Float64).mean().alias(side) for side in ("visual", "linguistic")]
        of_layers = steps.group_by("layer", "layer_number").agg(*spread(), *shares)
        of_layers = of_layers.sort("layer_number", "layer", nulls_last=True)
        columns = [Column("layer", "text"), *_SPREAD, Column("visual", "percent"), Column("linguistic", "percent")]
        lines += ["", "Per layer", _table(of_layers, columns)]
    lines += ["", f"Per task ({name})", _per_task(episodes, rows, files)]
    known = rows.select(UNIFORM_RATIO.is_not_null().all()).item()
    notes = [_FRAMES_CAVEAT] if kind.frames else [] if known else [_CAVEAT]
    notes += [note for file in files for note in _notes(file, layer, named=len(files) > 1)]
    if notes:
        lines += ["", "Notes", *wrapped((f"- {note}" for note in notes), "  ")]
    return "\n".join(lines) + "\n"


def why_not_pooled(files: Sequence[ResultsFile], side_by_side: bool) -> str:
    """The reason why several files have no COMBINED block; empty where they have one.

    Raises:
        ResultsError: the files hold masses of different kinds, and are not to be compared `side_by_side`.
    """
    kinds: dict[ResultsKind, list[ResultsFile]] = {}
    for file in files:
        kinds.setdefault(file.kind, []).append(file)
    repeated = sorted({file.suite for file in files if sum(file.suite == other.suite for other in files) > 1})
    why = ""
    if len(kinds) > 1:
        parts = "; ".join(f"{listing([file.path for file in of_kind], 3)}: {kind}" for kind, of_kind in kinds.items())
        if not side_by_side:
            raise ResultsError(
                f"These results files hold masses of different kinds, which cannot be summarised together ({parts}); "
                "give one kind at a time, or see them side by side with --plot-comparison."
            )
        why = f"No COMBINED: the files hold masses of different kinds ({parts})."
    elif repeated:
        same, suites = listing([file.path for file in files if file.suite in repeated], 4), listing(repeated)
        why = f"No COMBINED: {same} are about the same suite ({suites}), that is, different runs of it."
    return "\n".join([*wrapped([why]), ""]) if why else ""


def _dataset(episodes: pl.DataFrame) -> list[str]:
    without = episodes.filter(pl.col("num_replans") == 0)
    known, solved = episodes["success"].drop_nulls().len(), int(episodes["success"].sum())
    rate = f"{_percent(solved / known)} ({solved} of {known})" if known else "not known"
    if 0 < known < episodes.height:
        rate += f"; of {episodes.height - known} episodes it is not known"
    steps = format_number(episodes.select(pl.col("num_steps").mean()).item())
    lines = [
        "Dataset:",
        f"  Episodes: {episodes.height}",
        f"  Tasks: {episodes.select('file', 'task_id').n_unique()}",
        f"  Success Rate: {rate}",
        f"  Steps: {steps} (mean; the loop's counter at the end, waiting steps included)",
    ]
    if without.height:
        named = [f"task {row['task_id']} episode {row['episode_index']}" for row in without.iter_rows(named=True)]
        lines.append(f"  Without a single step, and so in no ratio: {listing(named, 6)}")
    return lines


def _ratio(found: dict[str, Any], layer: str) -> list[str]:
    why = "no layer with a finite ratio" if layer == LAYERS_AVG else "no mass on either side"
    parts = {"infinite (no linguistic mass)": found["infinite"], f"undefined ({why})": found["undefined"]}
    left_out = ", ".join(f"{count} {what}" for what, count in parts.items() if count)
    if found["mean"] is None:
        return [f"  None of the {plural(found['replans'], 'ratio')} is finite: {left_out}."]
    lines = [
        f"  Mean:   {found['mean']:.3f} ± {found['std']:.3f}",
        f"  Median: {found['median']:.3f}",
        f"  Range:  [{found['min']:.3f}, {found['max']:.3f}]",
        f"  IQR:    [{found['q25']:.3f}, {found['q75']:.3f}]",
    ]
    if left_out:
        lines.append(f"  Left out of {found['replans']}: {left_out}")
    return [*lines, f"  → {_VERDICTS[verdict(found['mean'])]}"]


def _baseline(rows: pl.DataFrame, found: dict[str, Any]) -> list[str]:
    """The ratio of uniform attention, what the guide calls it, and the lift over it, where the files have them."""
    finite = rows.filter(pl.col("ratio").is_finite())
    known = finite.filter(UNIFORM_RATIO.is_finite())
    if finite.is_empty() or known.height < finite.height:
        return []
    means = (UNIFORM_RATIO, pl.col("ratio") / UNIFORM_RATIO, pl.col("visual_keys"), pl.col("linguistic_keys"))
    uniform, lift, visual, linguistic = (known.select(one.mean()).item() for one in means)
    word, of_uniform = verdict(found["mean"]), verdict(uniform)
    same = "the same: here the word means nothing" if word == of_uniform else f"'{of_uniform}'"
    keys = f"{format_number(visual)} over {format_number(linguistic)} keys"
    return wrapped(
        [
            f"Uniform attention: {format_number(uniform)} ({keys}), which the guide calls {same}. Mean of ratio / "
            f"uniform: {format_number(lift)} (arithmetic, as the mean above; the lift of `analyze` is a geometric "
            "mean)."
        ],
        "    ",
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
    warning = wrapped([f"WARNING: {related}"], "    ") if related else []
    return [f"{text}, 95% interval {interval} (about {about})", *warning]


def _fractions(rows: pl.DataFrame) -> list[str]:
    lines = []
    for name in ("visual", "linguistic", "action"):
        if f"{name}_fraction" in rows.columns:
            share = pl.col(f"{name}_fraction").cast(pl.Float64)
            mean, std = rows.select(share.mean(), share.std(ddof=0).alias("std")).row(0)
            text = "undefined" if mean is None else f"{_percent(mean)} ± {_percent(std)}"
            lines.append(f"  {name.capitalize() + ':':<12}{text}")
    return lines


def _per_task(episodes: pl.DataFrame, rows: pl.DataFrame, files: Sequence[ResultsFile]) -> str:
    identity = ["file", "task_id"]
    tasks = episodes.group_by(identity, maintain_order=True).agg(
        pl.len().alias("n"), pl.col("success").cast(pl.Float64).mean(), pl.col("instruction").first()
    )
    ratios = rows.join(episodes.select("file", "episode", "task_id"), on=["file", "episode"])
    tasks = tasks.join(ratios.group_by(identity).agg(spread()), on=identity, how="left", maintain_order="left")
    suites = pl.col("file").replace_strict(dict(enumerate(file.suite for file in files)), return_dtype=pl.String)
    task = pl.col("task_id").cast(pl.String) if len(files) == 1 else pl.format("{} {}", suites, "task_id")
    counts = pl.col("replans", "infinite", "undefined").fill_null(0)
    columns = [Column("task", "text"), Column("n", "count"), *_SPREAD[:1], Column("success", "percent"), _SPREAD[1],
               Column("instruction", "prose")]  # fmt: skip
    return _table(tasks.with_columns(counts, task.alias("task")), columns)


def _table(rows: pl.DataFrame, columns: Sequence[Column]) -> str:
    both = [
        f"{format_number(mean)} ± {format_number(std)}" if mean is not None else "none finite"
        for mean, std in rows.select("mean", "std").iter_rows()
    ]
    return table_text(Table("", rows.with_columns(pl.Series("mean ± std", both)), columns))


def _notes(file: ResultsFile, layer: str, named: bool) -> list[str]:
    of, notes = f"{file.path}: " if named else "", []
    layers, own = layers_of(file.steps), overall_layer(file.steps)
    if layer not in layers or (layer != LAYERS_AVG and not named and len(layers) > 1):
        notes.append(f"There is no {LAYERS_AVG}; layer {own} is used instead, as in the published parser.")
    with_steps = file.episodes.filter(pl.col("num_replans") > 0).height
    lacking = with_steps - file.steps.filter(layer=own)["episode"].n_unique()
    if lacking:
        notes.append(f"{plural(lacking, 'episode')} with steps, but without any in {_named(own)}.")
    if file.zeros:
        notes.append(
            f"{file.zeros} ratios of 0 stand for 'no ratio' (nothing on either side, or no layer with a finite ratio) "
            "and are read as undefined; the published parser counts them as 0."
        )
    differing = disagreements(file)
    for reason, count in differing.filter(pl.col("reason") != "").group_by("reason").len().sort("reason").iter_rows():
        notes.append(f"Differs from the file's own summary in {plural(count, 'number')}: {reason}.")
    unexplained = differing.filter(reason="")
    if unexplained.height:
        first = unexplained.row(0, named=True)
        episode = file.episodes.row(first["episode"], named=True)
        notes.append(
            f"The file's own summary disagrees with its steps in {plural(unexplained.height, 'number')}; the first: "
            f"task {episode['task_id']} episode {episode['episode_index']}, {_named(first['layer'])}, "
            f"{first['measure']} {first['statistic']}: summary {format_number(first['value'])}, from the steps "
            f"{format_number(first['computed'])}. Everything here is computed from the steps."
        )
    if file.unused:
        notes.append(f"Fields that are not used: {listing(file.unused, 20)}.")
    return [f"{of}{note}" for note in notes]


def _named(layer: str) -> str:
    return layer_name(layer, LAYERS_AVG)


def _percent(share: float) -> str:
    return f"{100 * share:.1f}%"
