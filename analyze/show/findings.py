"""Sentences on many rows: which may be named after looking at all of them, and whose intervals are about less."""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from vla_attention.analyze.show.numbers import plural
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.analyze.statistics.units import FEWEST_FAMILIES, Units
from vla_attention.schemas.errors import listing


def findings(
    q_values: Sequence[float | None], names: Sequence[str], kind: str, what: str, num_sentences: int = 1
) -> str:
    """`Of 10 tasks, 2 show a difference (q <= 0.05): task 3, task 7.`, or that none does.

    Args:
        q_values: adjusted p-values (`many_looks.adjusted_p_values`), one per name; None is never named.
        names: what could be named.
        kind: what they are, singular: "task".
        what: what they show: "a difference".
        num_sentences: such sentences in the text; the level is shared out between them, so that a text about nothing
            names anything in at most 5 % of cases.
    """
    level = NAMED_AT / num_sentences
    tested = [q for q in q_values if q is not None]
    if not tested:
        return f"None of {plural(len(names), kind)} can be tested."
    named = [name for name, q in zip(names, q_values, strict=True) if q is not None and q <= level]
    shared = f": {NAMED_AT:g} shared by {num_sentences} sentences" if num_sentences > 1 else ""
    bound = f"(q <= {level:g}{shared})"
    # Items of a single task, or without a second episode, have no interval.
    of = plural(len(tested), kind)
    if len(tested) < len(names):
        of = f"the {len(tested)} of {plural(len(names), kind)} that can be tested"
    if not named:
        return f"Of {of}, none shows {what} {bound}."
    verb = "shows" if len(named) == 1 else "show"
    return f"Of {of}, {len(named)} {verb} {what} {bound}: {listing(named, 8)}."


def few_families_note(table: pl.DataFrame, name: str, units: Units) -> str:
    """Which rows have intervals about these tasks, where those of the others are about tasks like these; or nothing.

    Args:
        table: with `num_tasks`, `intervals` (`episode_intervals.ABOUT_COLUMNS`) and a column that names a row.
        name: that column.
        units: what intervals over all tasks are about.
    """
    if not units.estimand.of_other_tasks:
        return ""
    # Of a single task, it is said elsewhere.
    few = table.filter(pl.col("intervals") != units.estimand.value, pl.col("num_tasks") > 1)
    if few.is_empty():
        return ""
    names = listing(dict.fromkeys(few[name]))
    return f"In tasks of fewer than {FEWEST_FAMILIES} families, and so about these tasks: {names}."
