"""The text that `vla-attention heads` prints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import polars as pl

from vla_attention.analyze.heads.head_measures import main_group, ranked_heads
from vla_attention.analyze.heads.head_study import HeadStudy
from vla_attention.analyze.heads.row_metrics import episode_layer_means
from vla_attention.analyze.measures.aggregate import overall_rows
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG, Tables
from vla_attention.analyze.measures.sink_kinds import SMALL_VALUES, kind_name
from vla_attention.analyze.measures.sinks import SinkRule, SinkSearch, cannot_fire, merged_sinks
from vla_attention.analyze.show.answer import Section
from vla_attention.analyze.show.headings import interval_note
from vla_attention.analyze.show.numbers import format_interval, format_number, format_percent
from vla_attention.analyze.show.tables import (
    Column,
    Table,
    count,
    estimate,
    number,
    percent,
    percent_interval,
    texts,
    words,
)
from vla_attention.analyze.statistics.episode_intervals import means_with_intervals
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL, NO_LIMITS, POSITIVE
from vla_attention.schemas.errors import listing
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.layout import Role

#: Sinks that are printed; the table has all.
_MOST_SINKS = 12


def heads_sections(study: HeadStudy, top: int) -> list[Section]:
    """The whole answer; `top`: heads listed on either end."""
    sections = [_header(study), *_ranking(study, top), *_dispersion(study), _layers(study)]
    sections += [*_depth(study), *_denoise(study)]
    if study.rows is not None:
        assert study.options is not None
        assert study.search is not None
        sections += [_rows_by_layer(study), sinks_section(study.search, study.options.rule)]
    return sections


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


def _header(study: HeadStudy) -> Section:
    question, chosen = study.question, study.question.selection
    layer = LAYERS_AVG if len(chosen.layer_labels) > 1 else str(chosen.layer_labels[0])
    about = [
        f"Layers {listing(chosen.layer_labels, 40)}; denoise steps {listing(chosen.denoise_steps, 40)}; heads "
        f"{listing(chosen.head_numbers, 40)}",
        f"Grouping '{question.grouping.name}'; {_measure_name(study.heads, question.grouping)}",
        *([chosen.note] if chosen.note else []),
        interval_note(DEFAULT_LEVEL, question.units.words),
    ]
    return Section([question.header("HEADS, LAYERS, DENOISE STEPS", layer), *about])


def _measure_name(heads: Tables, grouping: Grouping) -> str:
    if grouping.ratio is None:
        return f"no ratio, so heads are compared by their fraction of '{main_group(heads, grouping)}'"
    return f"ratio = {' + '.join(grouping.ratio.numerator)} / {' + '.join(grouping.ratio.denominator)}"


def _ranking(study: HeadStudy, top: int) -> list[Section]:
    grouping = study.question.grouping
    ranked = ranked_heads(study.heads, grouping)
    if ranked.is_empty():
        return [Section([["No head has any mass on either side of the ratio."]], "HEADS")]
    order = f"fraction of '{main_group(study.heads, grouping)}'" if grouping.ratio is None else "lift of the ratio"
    shown = min(top, ranked.height)
    first, last = ranked.head(shown), ranked.tail(min(shown, ranked.height - shown)).reverse()
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
    title = f"HEADS IN ORDER OF {order}: the first {first.height} of {ranked.height}"
    if not last.height:
        return [Section([_head_table(first, study), note], title)]
    return [
        Section([_head_table(first, study)], title),
        Section([_head_table(last, study), note], f"and the last {last.height}"),
    ]


def _head_table(heads: pl.DataFrame, study: HeadStudy) -> Table:
    grouping = study.question.grouping
    columns, rows = [count("layer", "layer"), count("head", "head")], heads.to_dicts()
    if grouping.ratio is None:
        of_group, group = study.heads.by_group("layer", "head"), main_group(study.heads, grouping)
        rows = [row | of_group[row["layer"], row["head"], group] for row in rows]
        columns += [percent("fraction", "fraction"), percent_interval("fraction"), *estimate("lift", "lift")]
        return Table(columns, rows)
    sides = ("visual", "linguistic") if grouping.compares_modalities else ("above", "below")

    def ratio(row: dict[str, Any]) -> float:
        # Where no replan has a finite logarithm: infinite, or 0.
        limit: float = row["ratio_of_means"]
        return limit if row["log2_ratio"] is None else float(2 ** row["log2_ratio"])

    columns += [
        number("ratio", ratio),
        texts("interval", lambda row: _power_interval(row, "log2_ratio")),
        number("lift", lambda row: _power(row["log2_lift"])),
        texts("interval", lambda row: _power_interval(row, "log2_lift")),
        percent(sides[0], "numerator_fraction"),
        percent(sides[1], "denominator_fraction"),
    ]
    return Table(columns, rows)


def _dispersion(study: HeadStudy) -> list[Section]:
    if study.dispersion["fraction_std"].is_null().all():
        return []
    grouping = study.question.grouping
    what = "the numerator's fraction" if grouping.ratio else f"the fraction of '{main_group(study.heads, grouping)}'"
    columns = [
        count("layer", "layer"),
        count("heads", "num_heads"),
        *estimate("std", "fraction_std"),
        *estimate("std / mean", "fraction_cv"),
        *(estimate("std of log2 ratio", "log2_ratio_std") if grouping.ratio else ()),
    ]
    title = f"HOW MUCH HEADS DIFFER  spread of {what} over the heads of a layer"
    return [Section([Table(columns, study.dispersion.to_dicts())], title)]


def _layers(study: HeadStudy) -> Section:
    level = overall_rows(study.tasks).filter(pl.col("layer") != LAYERS_AVG)
    note = "ratio, uniform, lift: geometric means, so that lift is ratio / uniform."
    parts = [_profile(level, "layer", count("layer", "layer"), study.question.grouping)]
    return Section([*parts, note if study.question.grouping.ratio else ""], "LAYERS  mean over heads")


def _profile(level: Tables, along: str, label: Column, grouping: Grouping) -> Table:
    """Ratio or first fractions of cells of `task_tables`, which differ in the column `along`."""
    if grouping.ratio is not None:
        columns = [*estimate("ratio", "geometric_mean"), number("uniform", "uniform_ratio")]
        return Table([label, *columns, *estimate("lift", "ratio_lift")], level.cells.to_dicts())
    of_group, groups = level.by_group(along), level.groups_with_mass()[:3]
    rows = [
        row | {f"{group} {name}": value for group in groups for name, value in of_group[row[along], group].items()}
        for row in level.cells.iter_rows(named=True)
    ]
    fractions = ((percent(group[:18], f"{group} fraction"), percent_interval(f"{group} fraction")) for group in groups)
    return Table([label, *(column for columns in fractions for column in columns)], rows)


def _depth(study: HeadStudy) -> list[Section]:
    table = study.depth
    if table.is_empty():
        return []
    first, last, layers = (table[name][0] for name in ("first_block", "last_block", "num_layers"))
    if layers < 2:
        return [
            Section(
                [[f"A centre of gravity over layers needs two of them; this is about block {first} alone."]], "DEPTH"
            )
        ]
    columns = [
        texts("group", lambda row: row["group"][:30], left=True),
        texts("of", lambda row: "mass" if row["of"] == "mass" else "contribution", left=True),
        *estimate("centre", "centre"),
    ]
    every = study.question.stores[0].attributes.policy.num_layers
    whole = first == 0 and layers == last + 1 == every
    note = (
        "Mean block, weighted by a group's mass (or the norm of its contribution) at each, over "
        f"{'all' if whole else f'only {layers} of {every}'} blocks, {first} to {last}; the same amount everywhere "
        f"gives {format_number(table['even'][0])}."
    )
    return [Section([Table(columns, table.to_dicts()), note], "DEPTH  centre of gravity over blocks")]


def _denoise(study: HeadStudy) -> list[Section]:
    if study.denoise.cells.height < 2:
        return []
    step = texts("step", lambda row: f"{row['denoise_step']} ({row['denoise_time']:.3g})")
    table = _profile(study.denoise, "denoise_step", step, study.question.grouping)
    return [Section([table], "DENOISE STEPS  (and their times), mean over layers and heads")]


def _rows_by_layer(study: HeadStudy) -> Section:
    assert study.options is not None
    summary = row_summary(study)
    of_group = summary.by_group("layer")
    groups = summary.groups["group"].unique(maintain_order=True).to_list()[:3]
    rows = [
        row | {f"in {name}": of_group[row["layer"], name]["effective_keys"] for name in groups}
        for row in summary.cells.iter_rows(named=True)
    ]
    columns = [
        count("layer", "layer"),
        number("entropy", "entropy"),
        *estimate("eff. keys", "effective_keys"),
        *(percent(f"top {k}", f"top{k}_mass") for k in study.options.top),
        *(number(f"in {name[:14]}", f"in {name}") for name in groups),
    ]
    keys = [item.valid.sum(axis=1).mean() for item in study.question.selected]
    note = (
        "Of single rows, renormalised over valid keys (masked and padded ones excluded), then averaged. entropy: nats. "
        "eff. keys: exp(entropy), the number of keys that sharing evenly would have it, of "
        f"{format_number(sum(keys) / len(keys))}. top k: share of the k largest keys. in GROUP: effective keys of the "
        "row cut down to the group."
    )
    return Section([Table(columns, rows), note], "ROWS  how spread out attention is")


def sinks_section(search: SinkSearch, rule: SinkRule) -> Section:
    """The sinks as a table over tasks, or the key that comes nearest to being one."""
    keys, sinks, title = search.keys, search.sinks, "SINKS  keys that take far more than their share in a head"
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
        return Section([" ".join(filter(None, (text, beyond, others)))], title)
    table, more = sink_table(search), merged_sinks(sinks).height - _MOST_SINKS
    note = (
        "Searched task by task and head by head; keys of the policy's own actions are not counted. "
        f"heads: share of the layers' {int(keys['num_heads'][0]):d} heads in which the key takes {rule}; by mass: the "
        "latter. mass: mean share of the valid keys' mass; most: in the head where it is largest. values: length of "
        f"what the key adds per unit of mass, beside all other valid keys together (small: below {SMALL_VALUES:g}); ?: "
        "not recorded, or the key is one of several in a segment, and contributions are of whole segments. *: in at "
        f"least {rule.heads:.0%} of the heads; vla-attention ratios --without-sinks (with the same --sink options) "
        "takes "
        f"these out. {beyond}"
    )
    left = [f"{more} more in sinks.parquet."] if more > 0 else []
    return Section([replace(table, rows=table.rows[:_MOST_SINKS]), left, note], title)


def sink_table(search: SinkSearch, caption: str = "") -> Table:
    """Every sink, merged over tasks, in a text and on the page."""
    num_tasks = search.keys.select("suite", "task_id").n_unique()

    def values(row: dict[str, Any]) -> str:
        kind, ratio = kind_name(row["value_ratio"]), row["value_ratio"]
        return kind if ratio is None else f"{kind} ({format_number(ratio)})"

    columns = [
        texts("key", lambda row: f"{row['key']}{'*' if row['widespread'] else ''}", left=True),
        words("what it is", "description", "key", running=True),
        words("role", "role", "role"),
        texts("tasks", lambda row: f"{row['num_tasks']} of {num_tasks}"),
        count(None, "num_tasks", "tasks"),
        percent("heads", "heads_share", "heads"),
        percent("by mass", "heads_by_mass_share", "heads by mass"),
        percent(None, "share_of_rows", "rows"),
        percent("mass", "mean_mass", "mass"),
        number("x uniform", "times_uniform", "times uniform"),
        percent("most", "largest_mass"),
        texts("values", values),
        words(None, lambda row: kind_name(row["value_ratio"]), "values"),
    ]
    return Table(columns, merged_sinks(search.sinks).to_dicts(), caption)


def _power(value: float | None) -> float | None:
    return None if value is None else 2.0**value


def _power_interval(row: dict[str, Any], name: str) -> str:
    return format_interval(_power(row[f"{name}_low"]), _power(row[f"{name}_high"]))
