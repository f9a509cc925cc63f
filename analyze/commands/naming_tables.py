"""What `objects` says, tabulates and draws of `core.naming`: the answer, its rows, the later policy calls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import polars as pl

from vla_attention.analyze.core.about import enough
from vla_attention.analyze.core.naming import ALL_NAMED, Naming
from vla_attention.analyze.core.result import Column, Figure, Finding, Table
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.schemas.errors import listing

ASKS = "What does it look at?"
_OWN_SCENES = (
    "Each task has scenes of its own: attention to whatever stands where the named object does would look the same. "
    "Tasks that are told in each other's scenes tell the two apart (vla-attention capture exchange)."
)


def of_naming(question: Question, named: Naming) -> Finding | None:
    """Whether what is named gets more attention than where it is not named; None where nothing shows it."""
    if named.form is None:
        return None
    row, limits = named.answer, [enough(question)]
    shown = row["ratio_q"] is not None and row["ratio_q"] <= NAMED_AT
    verdict = "It looks for what the instruction names" if row["ratio"] > 1 else "It looks less at what is named"
    verdict = verdict if shown else "It is not shown to look for what the instruction names"
    if named.form == "same state":
        said = f"an object gets {times(row, 'ratio')} as much attention when it is named as when another is, in the "
        said += "same pictures"
    else:
        said = f"a kind of object gets {times(row, 'ratio')} as much attention where it is named as in other tasks, "
        said += "beyond what its place explains"
        limits.append(_OWN_SCENES)
    limits += [f"Always named, so nothing is said of it: {listing(named.always)}."] if named.always else []
    numbers = {"form": named.form, "shown": int(shown), **{key: value for key, value in row.items() if key != "camera"}}
    sentence = f"{verdict}: at the first policy call, {said}."
    return Finding(sentence, ASKS, numbers, " ".join(filter(None, limits)))


def of_runs(runs: Mapping[str, Sequence[Naming]], named_at: float) -> list[Finding]:
    """What is named against what is not, of each of several runs by itself; none where nothing shows it."""
    said, numbers = [], dict[str, float | int | str | None]()
    for name, row in ((name, one.answer) for name, each in runs.items() for one in each):
        shown = row["ratio_q"] is not None and row["ratio_q"] <= named_at
        said.append(f"{name} {times(row, 'ratio')}{'' if shown else ' (nothing is shown)'}")
        numbers |= {f"{name}_{key}": row[key] for key in ("ratio", "ratio_low", "ratio_high", "ratio_q")}
    what = "attention to a thing when it is named over when it is not, at the first policy call"
    return [Finding(f"{listing(said)}: {what}.", "Do they look for what is named?", numbers)] if said else []


def of_objects(question: Question, named: Naming, row: dict[str, Any]) -> Finding:
    """What objects get, named or not; and why it is not known whether what is named gets more."""
    if not row:
        return Finding("The pictures of the first policy calls show robot and background alone.", ASKS, {"shown": 0})
    place = row["over_place"] is not None
    low = row["over_place_low" if place else "over_area_low"]
    verdict = (
        "It looks at objects, named or not" if low is not None and low > 1 else "It is not shown to look at objects"
    )
    said = f"at the first policy call they get {times(row, 'over_area')} the attention that their area would give"
    said += f", {times(row, 'over_place')} what their places explain" if place else ""
    why = "in these episodes no sentence names a thing that another task shows and does not name"
    why = why if place else "no task has two episodes, so what places explain is not known"
    why = f"{listing(named.always)}: always named in this suite" if named.always else why
    limit = f"Whether it looks for what is named is not known: {why}. {enough(question)}".strip()
    return Finding(f"{verdict}: {said}.", ASKS, {"shown": 0, **row}, limit)


def times(row: Mapping[str, Any], name: str) -> str:
    """`7.2 times [5.2, 10]`; the value alone without an interval."""
    size, low, high = (
        None if value is None else f"{value:.0f}" if value >= 99.5 else f"{value:.2g}"
        for value in (row[name], row[f"{name}_low"], row[f"{name}_high"])
    )  # fmt: skip
    return f"{size} times" + ("" if low is None else f" [{low}, {high}]")


def tables_of_naming(named: Naming, later: pl.DataFrame) -> tuple[list[Table], list[Table]]:
    """The numbers of the answer by camera, to stand first; the later policy calls, to stand last.

    Files have the first for every object too; of few episodes their intervals are too wide for a screen.
    """
    if named.form is None:
        return [], []
    title = "Policy call by policy call: after the first one, attention may follow the hand alone"
    first = Table("naming", named.rows, _NAMING, "What is named, over the same when it is not named", _IS_ANSWER)
    return [first], [Table("naming_course", later, _COURSE, title)]


def figures_of_naming(named: Naming, later: pl.DataFrame) -> list[Figure]:
    """What the sentence quotes, and the later policy calls."""
    if named.form is None:
        return []
    return [
        Figure("naming", "forest", named.rows.filter(_IS_ANSWER), *_NAMING_SAYS, _NAMING_BARS),
        Figure("naming_course", "lines", later, *_COURSE_SAYS, _COURSE_LINES),
    ]


_IS_ANSWER = pl.col("item") == ALL_NAMED
_NAMING = (
    Column("camera", "text"),
    Column("ratio", "factor", "named / not", "attention at the first policy call to an object when it is named, over "
           "when it is not"),
    Column("ratio_q", "p", "q", "p of no difference"),
    Column("num_episodes", "count", "episodes"),
)  # fmt: skip
_COURSE = (
    Column("replan", "count", "policy call"),
    Column("which", "text", "objects"),
    Column("enrichment", "factor", "over its area"),
    Column("num_episodes", "count", "episodes"),
)
_NAMING_SAYS = (
    "Attention to an object when it is named, over when it is not",
    "At the first policy call. Points: geometric means, every task weighing the same; bars: 95% intervals.",
)
_NAMING_BARS = {
    "value": "ratio", "label": "camera", "baseline": 1.0, "baseline_name": "as when not named", "log": True,
    "xlabel": "attention when named / when not (logarithmic)",
}  # fmt: skip
_COURSE_SAYS = (
    "Attention to named and to other objects, over their area",
    "By policy call; from the second one on the hand has moved, and attention that follows the hand follows the name.",
)
_COURSE_LINES = {"x": "replan", "value": "enrichment", "color": "which", "log": True, "xlabel": "policy call",
                 "ylabel": "attention / area"}  # fmt: skip
