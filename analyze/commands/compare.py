"""What changed between runs? Success, whose goal, the actions of a rerun; then what is looked at and read."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import polars as pl

from vla_attention.analyze.commands.compare_tables import ALL, figures_of, perturbed, tables_of
from vla_attention.analyze.commands.naming_tables import of_runs
from vla_attention.analyze.core.about import UNTRAINED, notes, solved, with_interval
from vla_attention.analyze.core.action_changes import ROUNDING, ActionUnits
from vla_attention.analyze.core.behaviour import behaviour, with_choices
from vla_attention.analyze.core.compared import Compared, RunValues, by_themselves, compared
from vla_attention.analyze.core.listening import IN_PART, listens, whatever
from vla_attention.analyze.core.pairs import PAIR
from vla_attention.analyze.core.patch_maps import any_map
from vla_attention.analyze.core.reruns import held_by_one, is_noise, moved, moved_episodes
from vla_attention.analyze.core.result import Column, Finding, Result, Table
from vla_attention.analyze.core.runs import Run, check_comparable, noted_differences
from vla_attention.analyze.measures.tables import EPISODE_ID, LAYERS_AVG
from vla_attention.analyze.measures.task_families import sampling_of
from vla_attention.analyze.statistics.exact_tests import mcnemar
from vla_attention.analyze.statistics.many_looks import NAMED_AT, SHOWN_AT
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.safe_text import visible

_BETTER, _LISTEN, _MOVED, _NEEDS, _ATTENTION = (
    "Which does better?", "Do they listen?", "How far do the actions move?", "What do the actions depend on?",
    "And the attention?",
)  # fmt: skip
#: Kinds whose differences are named: effects, maps, groups, objects, words, heads; and of each run what it looks for.
NAMED_KINDS = 7
_SURE = pl.col("difference_q") <= NAMED_AT / NAMED_KINDS
_MOST_NAMED = 3  # differences of a kind


def compare(runs: Sequence[Run], allow_mismatch: Collection[str] = ()) -> Result:
    """Every other run against the first one.

    Args:
        runs: two or more, of `core.runs.open_runs`.
        allow_mismatch: in which fields they may differ, of `core.runs.FIELDS`.

    Raises:
        MixedPolicies, RunsDiffer: see `core.runs.check_comparable`.
    """
    allowed = [*check_comparable(runs, list(allow_mismatch)), *noted_differences(runs)]
    first, *others = runs
    selected = [item for run in runs for item in run.question.selected]
    sampling = sampling_of(first.question.settings.intervals, selected)
    base, *rest = (RunValues.of(run, "seed" in allow_mismatch) for run in runs)
    parts = [compared(base, one, sampling) for one in rest]
    findings, tables = _how_far(first, [run for run in others if run.repeats(first)], sampling)
    told = {run.name: with_choices(behaviour(run.question.episodes)) for run in runs}
    for part in parts:
        if not part.other.run.repeats(first):
            findings += _behaved(part, told[first.name], told[part.name])
        findings += [*_needs(part), _attention(part)]
    findings += of_runs({one.run.name: one.named for one in (base, *rest)}, NAMED_AT / NAMED_KINDS)
    about = [f"{run.name}: {_outcome(run, first)}." for run in runs]
    about += [line for part in parts for line in _how_alike(part)]
    about += dict.fromkeys(line for run in runs for line in run.question.told)
    about += [UNTRAINED] if any(run.question.untrained for run in runs) else []
    beside = dict.fromkeys(line for run in runs for line in notes(run.question) if line not in about)
    of_pairs = [_pairing(part, "seed" in allow_mismatch) for part in parts]
    of_pairs += [
        f"Only one of {first.name} and {run.name} holds the {listing(missing)}: not compared."
        for run in others
        if run.repeats(first) and (missing := held_by_one(first, run))
    ]
    cells, groups = by_themselves(base, rest, sampling)
    columns = [column for column in _RUNS if column.name in cells.columns]
    whole = (pl.col("layer") == LAYERS_AVG) & (pl.col("scope") != "task")
    by_change, of_changes = perturbed(base, parts, told)
    findings = [*by_change, *findings]
    tables += [*of_changes, *tables_of(parts, told)]
    tables += [Table("runs", cells, columns, "Each run", whole), Table("runs_groups", groups)]
    figures = [figure for part in parts for figure in figures_of(part, told)]
    return Result("What changed between runs", about, findings, tables, figures, [*of_pairs, *allowed, *beside])


def _outcome(run: Run, first: Run) -> str:
    """What a run is, and how many episodes were solved; a rerun has no outcome of its own."""
    if run is not first and run.repeats(first):
        calls = f"the policy calls of {plural(len(run.question.selected), 'episode')} of {first.name} again"
        return f"{calls}, with {run.changed}; outcome not run"
    policy = run.stores[0].attributes.policy.name
    return f"{policy} on {listing(run.suites)}, {solved(_outcomes(run), run.question.num_tasks)}"


def _outcomes(run: Run) -> list[bool | None]:
    return [item.episode.attributes.success for item in run.question.selected]


def _how_alike(part: Compared) -> list[str]:
    """What says that pairs begin alike, where it is not the initial state."""
    runs, seen = f"{part.other.run.name} and {part.first.run.name}", part.pairs.filter(~pl.col("stated"))
    by_number, apart = seen.filter(pl.col("pictures_apart").is_null()).height, part.refuted["pictures_apart"]
    said = []
    if len(apart):
        said.append(
            f"Not paired: {plural(len(apart), 'episode')} of {runs} with the same task and number, since they begin "
            f"with other pictures (a pixel differs by {min(apart):.0f} of 255 or more on average)."
        )
    if by_number:
        said.append(
            f"Paired by number only: nothing says that {plural(by_number, 'pair')} of episodes of {runs} with the same "
            "task and number begin alike; give run.episode(initial_state=...) when you record."
        )
    if rest := seen.height - by_number:
        said.append(
            f"Paired by number, since the initial states of {runs} are not all known: in {plural(rest, 'pair')} the "
            "first pictures hardly differ (a pixel by at most 2 of 255 on average). Small objects may stand elsewhere."
        )
    return said


def _pairing(part: Compared, any_seed: bool) -> str:
    """How episodes were paired, and which have no partner."""
    first, other = part.first.run, part.other.run
    stated = [bool(one.episodes["stated"].all()) for one in (part.first, part.other)]
    start = "initial state" if all(stated) else "number" if not any(stated) else "start"
    what = f"the same task and {start}" if any_seed else f"the same task, {start} and seed"
    what = "the same policy calls" if other.repeats(first) else what
    if part.pairs.is_empty():
        why = "" if any_seed else " Where seeds alone differ, --allow-mismatch seed pairs them."
        if any(stated) and not all(stated):
            why = f" Only {(first, other)[stated[1]].name} says in which states its episodes begin."
        return (
            f"NOT PAIRED: no episodes of {other.name} and {first.name} have {what}, so means of independent episodes "
            f"are compared; differences between scenes are in them.{why}"
        )
    text = f"{plural(part.pairs.height, 'pair')} of episodes of {other.name} and {first.name} with {what}"
    text += f"{'' if part.pairs['seed'].null_count() == 0 else ' (seeds are not all known)'}."
    for (run,), rows in part.alone().group_by("run", maintain_order=True):
        named = [f"task {task} episode {episode}" for _, task, episode in rows.select(EPISODE_ID).iter_rows()]
        text += f" {plural(rows.height, 'episode')} of {run} without a partner: {listing(named, 4)}."
    return text


def _how_far(first: Run, reruns: Sequence[Run], sampling: Sampling) -> tuple[list[Finding], list[Table]]:
    """How far the actions of reruns are from the base's, beside another noise seed."""
    if not reruns:
        return [], []
    episodes, units = moved_episodes(first, reruns)
    table, findings = moved(episodes, units, sampling), []
    for run, row in zip(reruns, table.iter_rows(named=True), strict=True):
        beside = "than in" if units.centimetres is not None else "against"
        said = f"{run.name}: {units.said(with_interval(row, 'effect'))} {beside} {first.name}"
        limit, times = "", row["over_noise"]
        if is_noise(run):
            said += ", by another noise seed alone"
        elif times is None:
            limit = "How much of it is chance, a rerun with another noise seed says (--noise-seed)."
        elif times < 1:
            said += f"; that is smaller than what another noise seed does ({with_interval(row, 'noise')})"
        else:
            shown = "" if (row["minus_noise_q"] or 1.0) <= NAMED_AT else ", which is not shown to be more"
            said += f"; another noise seed: {with_interval(row, 'noise')}{shown}"
        for part in units.parts[1:]:
            size = f"{row[part.name]:.0%}" if part.how == "opposite" else f"{row[part.name]:.2g}"
            said += f"; {part.said.format(size)}"
        findings.append(Finding(f"{said}.", _MOVED, {**row}, limit))
    return findings, [
        Table("moved", table, _moves(units), "How far the actions move"),
        Table("moved_episodes", episodes),
    ]


def _behaved(part: Compared, told_first: pl.DataFrame, told_other: pl.DataFrame) -> list[Finding]:
    """Which run solves more, and whether both do what they are told; the deaf one is told first."""
    success = _success(part)
    heard = [listens(asked).numbers if not asked.is_empty() else {} for asked in (told_first, told_other)]
    if not all("p" in numbers for numbers in heard):
        return [success]
    first, name = part.first.run.name, part.name
    does = [float(str(numbers["p"])) <= SHOWN_AT for numbers in heard]
    said = []
    for run, asked, numbers, hears in zip((first, name), (told_first, told_other), heard, does, strict=True):
        p = "p < 0.001" if float(str(numbers["p"])) < 0.001 else f"p = {numbers['p']:.2g}"
        counts = f"{numbers['right']} of {numbers['n']} episodes, shuffled instructions: {p}"
        often = whatever(asked.filter(pl.col("left_out").is_null())).removesuffix("; ")
        of = " in part" if numbers["verdict"] == IN_PART else ""
        said.append(f"{run} does what it is told{of} ({counts})" if hears else
                    f"{run} is not shown to listen ({counts}){f': {often}' if often else ''}")  # fmt: skip
    verdict = f"{said[0]}; {said[1]}." if does != [False, True] else f"{said[1]}; {said[0]}."
    listening = Finding(verdict, _LISTEN, {f"{key}_{side}": value for side, numbers in zip(("first", "other"), heard,
                        strict=True) for key, value in numbers.items()})  # fmt: skip
    return [listening, success] if does[0] != does[1] else [success, listening]


def _success(part: Compared) -> Finding:
    """Won and lost with the exact test, and what the pairs could have shown; without pairs, both shares."""
    first, name = part.first.run.name, part.name
    unknown = [run.name for run in (part.first.run, part.other.run) if all(one is None for one in _outcomes(run))]
    if unknown:
        later = "vla-attention store outcomes STORE FILE.csv tells outcomes that a scorer or a person gives later."
        return Finding(f"No outcome is known of {listing(unknown)}.", _BETTER, limit=later)
    if part.pairs.is_empty():
        row = part.rows["groups"].filter(ALL, quantity="success").head(1).to_dicts()
        shares = f"{name} solves {row[0]['mean_other']:.0%} of {row[0]['num_other']} episodes, {first} "
        shares += f"{row[0]['mean_first']:.0%} of {row[0]['num_first']}"
        shown = (row[0]["difference_q"] or 1.0) <= NAMED_AT
        return Finding(f"{'' if shown else 'Not shown to differ: '}{shares}.", _BETTER, row[0])
    pairs = part.values["groups"].filter(pl.col("difference").is_not_null(), quantity="success").unique(PAIR)
    if pairs.is_empty():
        return Finding("There is no pair of episodes of which both outcomes are known.", _BETTER)
    lost, won = int((pairs["difference"] < 0).sum()), int((pairs["difference"] > 0).sum())
    n, p, fewest = pairs.height, mcnemar(won, lost), next(k for k in range(1, 99) if mcnemar(0, k) <= NAMED_AT)
    verdict = "Not shown to differ" if p > NAMED_AT else f"{name} does {'better' if won > lost else 'worse'}"
    said = f"{verdict}: {name} solves {pairs['other'].sum():.0f} of {n} episodes, {first} {pairs['first'].sum():.0f}"
    said += f"; {lost} lost, {won} won (exact p = {p:.2g})."
    limit = "" if p <= NAMED_AT else f"To show a difference, {fewest} pairs or more must change, all in one direction; "
    limit += f"here {won + lost} of {n} changed." if limit else ""
    left = part.pairs.height - n
    limit = f"Not counted: {plural(left, 'pair')} without a known outcome. {limit}".strip() if left else limit
    return Finding(said, _BETTER, {"won": won, "lost": lost, "n": n, "p": p}, limit)


def _needs(part: Compared) -> list[Finding]:
    """The items without which, or with which exchanged, the action changes more or less than in the first run."""
    if "effects" not in part.rows:
        return []
    rows = part.rows["effects"].filter(ALL, reader="total")
    assert part.units is not None
    said = []
    # Of two effects that are rounding, neither is more.
    sizes = rows.filter(pl.max_horizontal("mean_first", "mean_other") > math.log2(ROUNDING))
    for row in _largest(sizes).iter_rows(named=True):
        moved_by = part.units.size(2.0 ** row["mean_other"])
        without = "without" if row["kind"] == "without" else "with"
        said.append(f"{without} {row['label']} {moved_by} (against {2.0 ** row['mean_first']:.2g})")
    numbers = {"items": rows.height, "shown": sizes.filter(_SURE).height}
    maps = part.rows["maps"].filter(ALL) if "maps" in part.rows else rows.clear()
    for row in _largest(maps).iter_rows(named=True):
        on = {"named": "what the sentence names", "robot": "the robot", "other": "neither named things nor the robot"}
        said.append(
            f"{100 * row['difference']:+.0f} points of what blocks of the pictures do to it lie on {on[row['item']]}"
        )
    none = "no item's effect is shown to differ" if rows.height else "the maps are not shown to differ"
    text = "; ".join(said) if said else none
    limit = "Trust exchanged words more than missing ones: a sentence with a missing word is new to the policy."
    limit = limit if rows.height else ""
    if "maps" not in part.rows and all(any_map(run.run.question) for run in (part.first, part.other)):
        limit = f"{limit} Maps are not compared: blocks, readers or steps differ, or no coverage is known.".strip()
        text = text if rows.height else "not compared"
    return [Finding(f"{part.name} against {part.first.run.name}: {text}.", _NEEDS, numbers, limit)]


def _attention(part: Compared) -> Finding:
    """The groups, words and heads whose attention is shown to differ, the largest differences first."""
    groups = _overall(part).filter(pl.col("quantity") != "success")
    said = [_of_group(row) for row in _largest(groups).iter_rows(named=True)]
    for kind, quote in (("objects", ""), ("words", "'")):
        items = _largest(part.rows[kind].filter(ALL)) if kind in part.rows else groups.clear()
        for row in items.iter_rows(named=True):
            named = f"{quote}{visible(row['item'].replace('_', ' '))}{quote}"
            said.append(f"{2.0 ** row['difference']:.2g} times as much attention to {named}")
    heads = part.rows["heads"].filter(ALL)
    if sure := heads.filter(_SURE).height:
        top = _largest(heads).row(0, named=True)
        most = f"most in layer {top['layer']}, head {top['head']}: {100 * top['difference']:+.1f} points"
        said.append(f"{sure} of {plural(heads.height, 'head')} differ ({most})")
    against = f"{part.name} against {part.first.run.name}"
    counted = {kind: part.rows[kind].filter(ALL) for kind in ("objects", "words", "heads") if kind in part.rows}
    numbers = {kind: rows.filter(_SURE).height for kind, rows in {"groups": groups, **counted}.items()}
    limit = "Equal attention is not equal use: a word may change the action without more attention."
    return Finding(f"{against}: {'; '.join(said) if said else 'no difference is shown'}.", _ATTENTION, numbers, limit)


def _largest(rows: pl.DataFrame) -> pl.DataFrame:
    return rows.filter(_SURE).sort(pl.col("difference").abs(), descending=True, nulls_last=True).head(_MOST_NAMED)


def _of_group(row: Mapping[str, Any]) -> str:
    if row["quantity"] == "log2_ratio":
        return f"the ratio is {2.0 ** row['difference']:.2g} times as high"
    name = row["quantity"].removesuffix("_fraction")
    return f"{100 * row['difference']:+.1f} points of the attention on {name}"


def _overall(part: Compared) -> pl.DataFrame:
    """The differences of groups over all tasks, and over all layers or in the only one."""
    rows = part.rows["groups"].filter(ALL)
    average = rows.filter(layer=LAYERS_AVG)
    return average if average.height else rows


def _moves(units: ActionUnits) -> list[Column]:
    return [
        Column("run", "text"),
        Column("effect", "number", units.title, units.said("so much")),
        Column("noise", "number", "another noise"),
        Column("over_noise", "factor", "times noise"),
        *units.further_columns,
        Column("num_episodes", "count", "episodes"),
    ]


_RUNS = [
    Column("run", "text"),
    Column("num_episodes", "count", "episodes"),
    Column("success_rate", "percent", "solved"),
    Column("geometric_mean", "factor", "ratio"),
    Column("ratio_lift", "factor", "per token", "the ratio over what evenly spread attention would give"),
]
