"""An exchange: tasks told in the scenes of others. What was done, told by told and scene by scene.

Two rates, which LIBERO-CF (Fang et al. 2026, arXiv 2602.17659) reports of instructions exchanged in LIBERO's scenes:
language following, whether the policy turns to what it was told about, and success, whether it reaches the told goal.
"""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from vla_attention.analyze.core.behaviour import ALONE
from vla_attention.analyze.core.estimate import estimate
from vla_attention.analyze.core.result import Column, Figure, Finding, Table
from vla_attention.analyze.statistics.exact_tests import share_interval
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.groupings.words import folded_words, stop_words

OWN, EXCHANGED = "its own", "another task's"
KINDS = ("verb", "object", "colour", "place")
_COLOURS = {"black", "white", "grey", "gray", "red", "green", "blue", "yellow", "orange", "pink", "purple", "brown"}
_PLACES = {
    "left", "right", "front", "back", "rear", "middle", "center", "centre", "top", "bottom", "leftmost", "rightmost",
    "upper", "lower", "inside", "next", "between", "near", "under", "above", "behind", "side",
}  # fmt: skip


def exchanged(asked: pl.DataFrame, sampling: Sampling) -> tuple[list[Finding], list[Table], list[Figure]]:
    """What an exchange showed, of the rows of `with_choices`; nothing of episodes that began with their own scene.

    sampling: what intervals are about. Left out are episodes that cannot show it: the told goal held at the beginning,
    or is a part of another told goal.
    """
    rows = asked.drop_nulls("scene_task_id")
    if rows.is_empty():
        return [], [], []
    rows = rows.with_columns(
        sentence=pl.when(pl.col("told_goal") == pl.col("scene_goal")).then(pl.lit(OWN)).otherwise(pl.lit(EXCHANGED)),
        did_told="as_told",
        did_scene=(pl.col("did") == pl.col("scene_instruction")) & ~pl.col("as_told"),
        counted=pl.col("left_out").is_null() | (pl.col("left_out") == ALONE),
    ).with_columns(pl.col("did_told", "did_scene").fill_null(False))
    # An own sentence has no other one that could have been done instead.
    shown = rows.filter("counted").with_columns(did_scene=pl.when(pl.col("sentence") != OWN).then("did_scene"))
    rates = _rates(shown, "sentence", ("did_told", "followed", "did_scene"), sampling).sort("sentence", descending=True)
    others = shown.filter(sentence=EXCHANGED)
    kinds = _rates(_heard(others), "kind", ("as_told", "as_scene"), sampling)
    cells = (
        rows.group_by("task_id", "scene_task_id", "told", "scene_instruction", maintain_order=True)
        .agg(
            pl.len().alias("rollouts"),
            pl.col("counted", "did_told", "did_scene").sum(),
            pl.col("did").is_null().sum().alias("nothing"),
        )
        .sort("task_id", "scene_task_id")
    )
    tables = [
        Table("exchange", rates, _RATES, "Told which sentence"),
        Table("exchange_kinds", kinds, _OF_KINDS, "Told another sentence: which of its words are in what it did"),
        Table("exchange_matrix", cells),
    ]
    return [_finding(rates, kinds, rows.filter(~pl.col("counted"))["left_out"])], tables, [_matrix(cells)]


def words_by_kind(sentence: str) -> dict[str, frozenset[str]]:
    """The words of a sentence by kind: verb, object, colour, place.

    A verb is the first word, and one behind "and". Colours and places are of fixed lists; words without a meaning of
    their own do not count, and all others are of objects.
    """
    words, found = folded_words(sentence), {kind: set[str]() for kind in KINDS}
    for place, word in enumerate(words):
        if word not in stop_words() - _PLACES:
            is_verb = place == 0 or words[place - 1] == "and"
            kind = "colour" if word in _COLOURS else "place" if word in _PLACES else "object"
            found["verb" if is_verb else kind].add(word)
    return {kind: frozenset(of_kind) for kind, of_kind in found.items()}


def _heard(others: pl.DataFrame) -> pl.DataFrame:
    """A row for each rollout and kind of word in which told sentence and scene's own differ: whose words were done."""
    rows = []
    for row in others.iter_rows(named=True):
        told, scene = words_by_kind(row["told"]), words_by_kind(row["scene_instruction"])
        did = {} if row["did"] is None else words_by_kind(row["did"])
        rows += [
            (row["suite"], row["task_id"], kind, did.get(kind) == told[kind], did.get(kind) == scene[kind])
            for kind in KINDS
            if told[kind] != scene[kind]
        ]
    schema = {"suite": pl.String, "task_id": pl.Int64, "kind": pl.String, "as_told": pl.Boolean, "as_scene": pl.Boolean}
    return pl.DataFrame(rows, schema=schema, orient="row")


def _rates(rows: pl.DataFrame, by: str, shares: Sequence[str], sampling: Sampling) -> pl.DataFrame:
    """Shares of the rollouts with each value of a column, with intervals; of the first and last also the number.

    seen: how many have a value of the second.
    """
    numbers = rows.with_columns(pl.col(*shares).cast(pl.Float64))
    found = estimate(numbers, [by], dict.fromkeys(shares, "share"), sampling)
    counts = rows.group_by(by).agg(
        right=pl.col(shares[0]).sum(), scenes=pl.col(shares[-1]).sum(), seen=pl.col(shares[1]).count()
    )
    return found.join(counts, on=by, how="left", maintain_order="left")


def _finding(rates: pl.DataFrame, kinds: pl.DataFrame, left_out: pl.Series) -> Finding:
    """How often another task's sentence was followed, beside the scene's own. left_out: reasons for not counting."""
    known = {row["sentence"]: row for row in rates.iter_rows(named=True)}
    other, own = known.get(EXCHANGED), known.get(OWN)
    reasons = [f"{plural(number, 'rollout')} ({why})" for why, number in left_out.value_counts(sort=True).rows()]
    limit = f"Not counted: {listing(reasons)}." if reasons else ""
    if other is None:
        return Finding("No rollout with another task's sentence shows anything.", _ASKS, {}, limit)
    right, n = other["right"], other["num_episodes"]
    ends = (other["did_told_low"], other["did_told_high"])
    # All or none has no spread between tasks: the exact interval over these rollouts.
    ends = share_interval(right, n) if right in (0, n) else ends
    interval = "" if None in ends else f" [{100 * ends[0]:.0f} to {100 * ends[1]:.0f} %]"
    beside = f" (told the scene's own: {own['right']} of {own['num_episodes']})" if own else ""
    instead = f"; in {other['scenes']} it did the scene's own task" if other["scenes"] else ""
    sentence = f"Told another task's sentence, it did that in {right} of {n} rollouts{interval}{beside}{instead}."
    if other["followed"] is not None:
        sentence += f" Success {100 * other['did_told']:.0f} %, language following {100 * other['followed']:.0f} %"
        sentence += f" (of the {other['seen']} whose sentences name different things)."
    heard = {row["kind"]: f"{row['right']} of {row['num_episodes']}" for row in kinds.iter_rows(named=True)}
    words = listing([f"{kind} {heard[kind]}" for kind in KINDS if kind in heard])
    limit = f"Where told and scene's own differ in a word, what it did has the told one: {words}. {limit}".strip()
    numbers = {"right": right, "n": n, "low": ends[0], "high": ends[1], "following": other["followed"]}
    return Finding(sentence, _ASKS, numbers, limit)


def _matrix(cells: pl.DataFrame) -> Figure:
    share = pl.when(pl.col("counted") > 0).then(pl.col("did_told") / pl.col("counted"))
    frame = cells.with_columns(
        share=share, scene=pl.col("scene_task_id").cast(pl.String), told=pl.format("{} ({})", "told", "task_id")
    )
    frame = frame.sort("task_id", "scene_task_id", descending=[True, False])
    options = {"x": "scene", "y": "told", "value": "share", "share": True, "label": "did what it was told",
               "xlabel": "in the scene and initial state of task"}  # fmt: skip
    n = f"{plural(int(cells['rollouts'].sum()), 'rollout')}; grey: not counted, the told goal held at the beginning."
    return Figure(
        "exchange_matrix",
        "heat_map",
        frame,
        "Did it do what it was told? By the task in whose scene it began",
        n,
        options,
    )


_ASKS = "Does it follow other sentences?"
_SHARES = (
    Column("num_episodes", "count", "rollouts"),
    Column("did_told", "percent", "success", "reached the told goal"),
    Column(
        "followed",
        "percent",
        "language following",
        "first touched a thing that the told sentence names and the scene's own does not, or reached the told goal; "
        "of rollouts whose sentences name different things",
    ),
    Column("did_scene", "percent", "did the scene's own", "reached the goal of the scene's own sentence instead"),
)
_RATES = [Column("sentence", "text"), *_SHARES]
_OF_KINDS = [
    Column("kind", "text", "word"),
    Column("num_episodes", "count", "rollouts", "in which told sentence and scene's own differ in words of the kind"),
    Column("as_told", "percent", "did as told", "what was done has these words of the told sentence"),
    Column("as_scene", "percent", "did as the scene's own", "or those of the scene's own"),
]
