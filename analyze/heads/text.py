"""The text that `vla-analyze heads` prints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import polars as pl

from vla_attention.analyze.heads.head_measures import main_group, ranked_heads
from vla_attention.analyze.heads.head_study import HeadStudy
from vla_attention.analyze.heads.row_metrics import episode_layer_means
from vla_attention.analyze.measures.aggregate import overall_rows
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG, Tables
from vla_attention.analyze.measures.sink_kinds import SMALL_VALUES, kind_name
from vla_attention.analyze.measures.sinks import SinkRule, SinkSearch, cannot_fire, merged_sinks
from vla_attention.analyze.show.headings import WIDTH, heading, interval_note, wrap, wrap_all
from vla_attention.analyze.show.numbers import (
    format_interval,
    format_number,
    format_percent,
    format_percent_interval,
    row_interval,
)
from vla_attention.analyze.show.text_table import text_table
from vla_attention.analyze.statistics.episode_intervals import means_with_intervals
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL, NO_LIMITS, POSITIVE
from vla_attention.schemas.errors import listing
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.layout import Role

#: Sinks that are printed; the table has all.
_MOST_SINKS = 12


def heads_text(study: HeadStudy, top: int) -> str:
    """The whole text, at most `WIDTH` columns wide; `top`: heads listed on either end."""
    parts = [_header(study), _ranking(study, top), _dispersion(study), _layers(study), _depth(study), _denoise(study)]
    if study.rows is not None:
        parts += [_rows_by_layer(study), _sinks(study)]
    return "\n\n".join(part for part in parts if part) + "\n"


def row_summary(study: HeadStudy) -> Tables:
    """Every layer: means over episodes of the columns of `rows`, with intervals."""
    assert study.rows is not None
    episodes = episode_layer_means(study.rows)
    order = study.tasks.cells.filter(pl.col("layer") != LAYERS_AVG)["layer_number"].unique().sort().to_list()
    position = pl.col("layer").replace_strict({layer: i for i, layer in enumerate(order)}, return_dtype=pl.Int64)
    return Tables(
        _row_means(episodes.cells, ("layer", "block"), study).sort(position, maintain_order=True),
        _row_means(episodes.groups, ("layer", "block", "group"), study).sort(position, maintain_order=True),
    )


def _row_means(episodes: pl.DataFrame, by: Sequence[str], study: HeadStudy) -> pl.DataFrame:
    measured = [name for name in episodes.columns if name not in (*EPISODE_ID, *by)]
    # A group may hold fewer than one key, and then its entropy is below 0.
    limits = {name: NO_LIMITS if name == "entropy" else POSITIVE for name in measured}
    return means_with_intervals(episodes, by, limits, study.question.sampling)


def _header(study: HeadStudy) -> str:
    question, chosen = study.question, study.question.selection
    layer = LAYERS_AVG if len(chosen.layer_labels) > 1 else str(chosen.layer_labels[0])
    lines = question.header("HEADS, LAYERS, DENOISE STEPS", layer)
    about = [
        f"Layers {listing(chosen.layer_labels, 40)}; denoise steps {listing(chosen.denoise_steps, 40)}; heads "
        f"{listing(chosen.head_numbers, 40)}",
        f"Grouping '{question.grouping.name}'; {_measure_name(study.heads, question.grouping)}",
        *([chosen.note] if chosen.note else []),
        interval_note(DEFAULT_LEVEL, question.units.words),
    ]
    return "\n".join([*lines, *wrap_all(about)])


def _measure_name(heads: Tables, grouping: Grouping) -> str:
    if grouping.ratio is None:
        return f"no ratio, so heads are compared by their fraction of '{main_group(heads, grouping)}'"
    return f"ratio = {' + '.join(grouping.ratio.numerator)} / {' + '.join(grouping.ratio.denominator)}"


def _ranking(study: HeadStudy, top: int) -> str:
    grouping = study.question.grouping
    ranked = ranked_heads(study.heads, grouping)
    if ranked.is_empty():
        return heading("HEADS") + "\nNo head has any mass on either side of the ratio."
    order = f"fraction of '{main_group(study.heads, grouping)}'" if grouping.ratio is None else "lift of the ratio"
    shown = min(top, ranked.height)
    first, last = ranked.head(shown), ranked.tail(min(shown, ranked.height - shown)).reverse()
    lines = [
        heading(f"HEADS IN ORDER OF {order}: the first {first.height} of {ranked.height}"),
        _head_rows(first, study),
    ]
    if last.height:
        lines += ["", heading(f"and the last {last.height}"), _head_rows(last, study)]
    note = (
        f"{ranked.height} heads. The ends of so many are extreme partly by chance: their intervals are those of heads "
        "chosen beforehand."
    )
    if grouping.ratio is not None:
        note = (
            "ratio: geometric mean over replans and episodes. lift: the same of ratio / uniform ratio, 1 = uniform "
            "attention. " + note
        )
        left_out = int(study.heads.cells.unique(["block", "head"])["num_nonfinite"].sum())
        if left_out:
            note += f" {left_out} (head, replan) ratios are infinite, undefined or 0 and in no geometric mean."
    return "\n".join([*lines, *wrap(note)])


def _head_rows(rows: pl.DataFrame, study: HeadStudy) -> str:
    grouping = study.question.grouping
    of_group, group = study.heads.by_group("layer", "head"), main_group(study.heads, grouping)
    table = []
    for row in rows.iter_rows(named=True):
        cells = [str(row["layer"]), str(row["head"])]
        if grouping.ratio is not None:
            limit = row["ratio_of_means"]  # where no replan has a finite logarithm: infinite, or 0
            cells += [
                format_number(limit if row["log2_ratio"] is None else 2 ** row["log2_ratio"]),
                _power_interval(row, "log2_ratio"),
                format_number(_power(row["log2_lift"])),
                _power_interval(row, "log2_lift"),
                format_percent(row["numerator_fraction"]),
                format_percent(row["denominator_fraction"]),
            ]
        else:
            own = of_group[row["layer"], row["head"], group]
            cells += [
                format_percent(own["fraction"]),
                _percent_interval(own, "fraction"),
                format_number(own["lift"]),
                row_interval(own, "lift"),
            ]
        table.append(cells)
    header = ["layer", "head"]
    if grouping.ratio is not None:
        sides = ["above", "below"]
        if grouping.compares_modalities:
            sides = ["visual", "linguistic"]
        header += ["ratio", "interval", "lift", "interval", *sides]
    else:
        header += ["fraction", "interval", "lift", "interval"]
    return text_table(header, table)


def _dispersion(study: HeadStudy) -> str:
    if study.dispersion["fraction_std"].is_null().all():
        return ""
    grouping = study.question.grouping
    what = "the numerator's fraction" if grouping.ratio else f"the fraction of '{main_group(study.heads, grouping)}'"
    header = ["layer", "heads", "std", "interval", "std / mean", "interval"]
    header += ["std of log2 ratio", "interval"] if grouping.ratio else []
    rows = []
    for row in study.dispersion.iter_rows(named=True):
        cells = [str(row["layer"]), str(row["num_heads"])]
        for name in ("fraction_std", "fraction_cv", *(["log2_ratio_std"] if grouping.ratio else [])):
            cells += [format_number(row[name]), row_interval(row, name)]
        rows.append(cells)
    return "\n".join(
        [heading(f"HOW MUCH HEADS DIFFER  spread of {what} over the heads of a layer"), text_table(header, rows)]
    )


def _layers(study: HeadStudy) -> str:
    grouping = study.question.grouping
    level = overall_rows(study.tasks).filter(pl.col("layer") != LAYERS_AVG)
    labels = [str(layer) for layer in level.cells["layer"]]
    lines = [heading("LAYERS  mean over heads"), _profile(level, "layer", "layer", labels, grouping)]
    if grouping.ratio is not None:
        lines += wrap("ratio, uniform, lift: geometric means, so that lift is ratio / uniform.")
    return "\n".join(lines)


def _profile(level: Tables, along: str, label: str, labels: Sequence[str], grouping: Grouping) -> str:
    """Ratio or first fractions of cells of `task_tables`, which differ in the column `along`."""
    table = []
    of_group, groups = level.by_group(along), level.groups_with_mass()[:3]
    for name, row in zip(labels, level.cells.iter_rows(named=True), strict=True):
        if grouping.ratio is not None:
            cells = [format_number(row["geometric_mean"]), row_interval(row, "geometric_mean")]
            cells += [
                format_number(row["uniform_ratio"]),
                format_number(row["ratio_lift"]),
                row_interval(row, "ratio_lift"),
            ]
        else:
            cells = [
                cell
                for own in (of_group[row[along], group] for group in groups)
                for cell in (format_percent(own["fraction"]), _percent_interval(own, "fraction"))
            ]
        table.append([name, *cells])
    if grouping.ratio is not None:
        return text_table([label, "ratio", "interval", "uniform", "lift", "interval"], table)
    return text_table([label, *(cell for group in groups for cell in (group[:18], "interval"))], table)


def _depth(study: HeadStudy) -> str:
    table = study.depth
    if table.is_empty():
        return ""
    first, last, count = (table[name][0] for name in ("first_block", "last_block", "num_layers"))
    if count < 2:
        return (
            heading("DEPTH")
            + f"\nA centre of gravity over layers needs two of them; this is about block {first} alone."
        )
    rows = [
        [
            row["group"][:30],
            "mass" if row["of"] == "mass" else "contribution",
            format_number(row["centre"]),
            row_interval(row, "centre"),
        ]
        for row in table.iter_rows(named=True)
    ]
    every = count == last - first + 1
    whole = every and first == 0 and last + 1 == study.question.stores[0].attributes.policy.num_layers
    over = "all" if whole else f"only {count} of {study.question.stores[0].attributes.policy.num_layers}"
    note = (
        f"Mean block, weighted by a group's mass (or the norm of its contribution) at each, over {over} blocks, "
        f"{first} to {last}; the same amount everywhere gives {format_number(table['even'][0])}."
    )
    return "\n".join(
        [
            heading("DEPTH  centre of gravity over blocks"),
            text_table(["group", "of", "centre", "interval"], rows, left=(0, 1)),
            *wrap(note),
        ]
    )


def _denoise(study: HeadStudy) -> str:
    rows = study.denoise.cells
    if rows.height < 2:
        return ""
    labels = [f"{step} ({time:.3g})" for step, time in rows.select("denoise_step", "denoise_time").iter_rows()]
    return "\n".join(
        [
            heading("DENOISE STEPS  (and their times), mean over layers and heads"),
            _profile(study.denoise, "denoise_step", "step", labels, study.question.grouping),
        ]
    )


def _rows_by_layer(study: HeadStudy) -> str:
    assert study.options is not None
    summary = row_summary(study)
    of_group = summary.by_group("layer")
    groups = summary.groups["group"].unique(maintain_order=True).to_list()[:3]
    header = ["layer", "entropy", "eff. keys", "interval", *(f"top {k}" for k in study.options.top)]
    header += [f"in {name[:14]}" for name in groups]
    rows = []
    for row in summary.cells.iter_rows(named=True):
        cells = [
            str(row["layer"]),
            format_number(row["entropy"]),
            format_number(row["effective_keys"]),
            row_interval(row, "effective_keys"),
        ]
        cells += [format_percent(row[f"top{k}_mass"]) for k in study.options.top]
        cells += [format_number(of_group[row["layer"], name]["effective_keys"]) for name in groups]
        rows.append(cells)
    keys = [item.valid.sum(axis=1).mean() for item in study.question.selected]
    note = (
        "Of single rows, renormalised over valid keys (masked and padded ones excluded), then averaged. entropy: nats. "
        "eff. keys: exp(entropy), the number of keys that sharing evenly would have it, of "
        f"{format_number(sum(keys) / len(keys))}. top k: share of the k largest keys. in GROUP: effective keys of the "
        "row cut down to the group."
    )
    return "\n".join([heading("ROWS  how spread out attention is"), text_table(header, rows), *wrap(note)])


def _sinks(study: HeadStudy) -> str:
    assert study.options is not None
    assert study.search is not None
    rule = study.options.rule
    lines = [heading("SINKS  keys that take far more than their share in a head"), sinks_text(study.search, rule)]
    return "\n".join(lines)


def sinks_text(search: SinkSearch, rule: SinkRule) -> str:
    """The sinks as a table over tasks, or the key that comes nearest to being one."""
    keys, sinks = search.keys, search.sinks
    num_tasks, num_heads = keys.select("suite", "task_id").n_unique(), int(keys["num_heads"][0])
    beyond = cannot_fire(search.num_valid, rule)
    if sinks.is_empty():
        counted = keys.filter(pl.col("role") != Role.ACTION.label)
        nearest = (counted if counted.height else keys).sort("largest_mass").row(-1, named=True)
        text = (
            f"No key takes {rule} (keys of the policy's own actions are not counted). The key that comes nearest, "
            f"{nearest['description']} ({nearest['role']}), takes on average "
            f"{format_percent(nearest['largest_mass'])} of a row in one head of task {nearest['task_id']}, and "
            f"{format_number(nearest['times_uniform'])} x its uniform share over all heads."
        )
        others = "Other rules: --sink-factor, --sink-share, --sink-mass."
        return "\n".join(wrap(" ".join(filter(None, (text, beyond, others)))))
    merged = merged_sinks(sinks)
    header = ["key", "role", "tasks", "heads", "by mass", "mass", "x uniform", "most", "values"]
    rows = [
        [
            f"{row['key']}{'*' if row['widespread'] else ''}",
            row["role"],
            f"{row['num_tasks']} of {num_tasks}",
            format_percent(row["heads_share"]),
            format_percent(row["heads_by_mass_share"]),
            format_percent(row["mean_mass"]),
            format_number(row["times_uniform"]),
            format_percent(row["largest_mass"]),
            kind_name(row["value_ratio"]) if row["value_ratio"] is None
            else f"{kind_name(row['value_ratio'])} ({format_number(row['value_ratio'])})",
        ]
        for row in merged.head(_MOST_SINKS).iter_rows(named=True)
    ]  # fmt: skip
    texts = merged.head(_MOST_SINKS)["description"].to_list()
    lines = [text_table(header, rows, left=(0, 1), last="what it is", texts=texts, width=WIDTH)]
    if merged.height > _MOST_SINKS:
        lines.append(f"{merged.height - _MOST_SINKS} more in sinks.parquet.")
    note = (
        "Searched task by task and head by head; keys of the policy's own actions are not counted. "
        f"heads: share of the layers' {num_heads:d} heads in which the key takes {rule}; by mass: the latter. mass: "
        "mean share of the valid keys' mass; most: in the head where it is largest. values: length of what the key "
        "adds per unit of mass, beside all other valid keys together (small: "
        f"below {SMALL_VALUES:g}); ?: not recorded, or the key is one of several in a segment, and contributions are "
        f"of whole segments. *: in at least {rule.heads:.0%} of the heads; vla-analyze ratios --without-sinks (with "
        f"the same --sink options) takes these out. {beyond}"
    )
    return "\n".join([*lines, *wrap(note)])


def _power(value: float | None) -> float | None:
    return None if value is None else 2.0**value


def _power_interval(row: dict[str, Any], name: str) -> str:
    return format_interval(_power(row[f"{name}_low"]), _power(row[f"{name}_high"]))


def _percent_interval(row: dict[str, Any], name: str) -> str:
    return format_percent_interval(row[f"{name}_low"], row[f"{name}_high"])
