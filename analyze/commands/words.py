"""Which words of the instruction are read."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping, Sequence
from statistics import median
from typing import Any

import polars as pl

from vla_attention.analyze.core.about import about, enough, how_to_record_effects, notes, would_show
from vla_attention.analyze.core.axes import OF_ROWS, check_axes, columns_of, with_families
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.measure import measure, table_of
from vla_attention.analyze.core.result import Column, Figure, Finding, Result, Table
from vla_attention.analyze.core.word_items import LABELS, SCALE, items_of
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.statistics.many_looks import SHOWN_AT
from vla_attention.analyze.statistics.units import Estimand
from vla_attention.schemas.errors import BadArgument, plural
from vla_attention.schemas.groupings.vocabulary import NO_WORDS
from vla_attention.schemas.layout import Role
from vla_attention.schemas.safe_text import visible

_VALUES: dict[str, Scale] = {"keys": "positive", "mass": "share", "lift": "positive", "share": "share"}
#: Of the words that are read more than uniform attention would, so many are named.
_MOST_NAMED = 5
LIFT = "attention to the word, over what it would get if attention were spread evenly over all tokens"


def words(question: Question, by: Collection[str] = ()) -> Result:
    """Lift, mass and share of every word; which are read more, and which less, than evenly spread attention would.

    A word is named at q <= `SHOWN_AT`, about tasks like these where enough families have it, else about these tasks.

    Raises:
        BadArgument: the keys of the site spell no words.
    """
    if not question.vocabulary.words:
        raise BadArgument(f"Site '{question.site}': {NO_WORDS}.")
    check_axes(by, ("layer", "head", "denoise", "replan", "task", "family", "episode"))
    axes = [axis for axis in OF_ROWS if axis in by]
    measured = measure(question, items_of, axes)
    instructions = {visible(item.episode.attributes.instruction) for item in question.selected}
    shown = "place" if len(instructions) == 1 else "word"
    kept = columns_of(by)
    looks = [column.name for column in kept]
    rows = with_families(_without_shares(table_of(measured, axes)).collect(), question.sampling)
    num_looks = max(1, rows.filter(kind=shown).select(*LABELS).n_unique())
    summary = estimate(rows, [*looks, *LABELS], _VALUES, question.sampling, {"lift": 1.0}, [*looks, "kind"],
                       detect={"lift": SHOWN_AT / num_looks})  # fmt: skip
    order = ("place", False) if shown == "place" else ("lift", True)
    summary = summary.drop("keys_low", "keys_high").sort(
        *looks, "kind", order[0], descending=[*(False for _ in looks), False, order[1]], nulls_last=True
    )
    finding = _finding(question, summary.filter(kind=shown), by)
    summary = summary.drop("lift_detectable")
    columns = [*kept, *_columns(question.num_tasks)]
    is_shown = pl.col("kind") == shown
    is_scale = pl.col("kind") == "scale"
    bars = pl.concat([summary.filter(is_shown), summary.filter(is_scale)])
    bars = bars.with_columns(color=pl.when(is_scale).then(pl.lit("scale")).otherwise("word_class"))
    return Result(
        "Which words of the instruction are read",
        about(question),
        [finding],
        [
            Table("words", summary, columns, "Words of the instruction", is_shown),
            Table("words_scale", summary.filter(is_scale), columns, "For scale"),
            Table("words_episodes", _without_shares(table_of(measured, {"layer", *axes}))),
        ],
        [] if by else [Figure("word_bars", "forest", bars, _TITLE, _CAPTION, _BARS)],
        notes(question),
    )


def _without_shares(rows: pl.LazyFrame) -> pl.LazyFrame:
    """State digits and patches are no part of the mass of language."""
    outside = pl.col("item").is_in([SCALE[role] for role in (Role.STATE, Role.IMAGE, Role.BORDER)]) & (
        pl.col("kind") == "scale"
    )
    return rows.with_columns(share=pl.when(~outside).then("share"))


_TITLE = "Attention to each word, over what evenly spread attention would give"
_CAPTION = (
    "Points: means over episodes, every task weighing the same; bars: 95% intervals. Dashed: attention spread evenly "
    "over all tokens."
)
_BARS = {
    "value": "lift",
    "label": "item",
    "color": "color",
    "colors": {"content": "#0072B2", "stop": "#E69F00", "scale": "#9A9A9A"},
    "names": {"content": "content word", "stop": "stop word", "scale": "for scale"},
    "baseline": 1.0,
    "baseline_name": "if spread evenly",
    "log": True,
    "xlabel": "attention per token, evenly spread = 1 (logarithmic)",
}


_MEANING_OF_Q = (
    "p of no difference, adjusted for the number of words (Benjamini-Hochberg); the answer names words of q at most "
    f"{SHOWN_AT:.2g}"
)


def _columns(num_tasks: int) -> list[Column]:
    return [
        Column("item", "text", "word"),
        Column("lift", "factor", "times even", LIFT),
        Column("lift_q", "p", "q", _MEANING_OF_Q),
        Column("mass", "percent", "of all attention"),
        Column("share", "percent", "of the text", "part of the attention to all language", screen=False),
        Column("keys", "number", "tokens"),
        Column("num_episodes", "count", "episodes"),
        *([Column("num_tasks", "count", "tasks")] if num_tasks > 1 else []),
        Column("word_class", "text", "class", screen=False),
    ]


def _finding(question: Question, words: pl.DataFrame, by: Collection[str]) -> Finding:
    """Which words get more, and which less, than evenly spread attention would give them."""
    recorded = any(item.episode.attributes.effects is not None for item in question.selected)
    path = shlex.quote(str(question.stores[0].path))
    effects = f"vla-attention effects {path}" if recorded else how_to_record_effects(question)
    limit = "Attention to a word does not say that it moves the action."
    limit = f"{enough(question)} {limit}".lstrip()
    if by:
        return Finding(
            f"Below, a row for each word and {' and '.join(by)}.", "Which words are read?", {}, limit, effects
        )
    sure = words.filter(pl.col("lift_q") <= SHOWN_AT).sort("lift", descending=True).to_dicts()
    if not sure:
        return Finding(*_nothing_named(words, limit), effects)
    # A word that few families have says nothing about other tasks, but it may be what is read most in these.
    here = [row for row in sure if row["intervals"] == Estimand.THESE_TASKS]
    like = [row for row in sure if row["intervals"] != Estimand.THESE_TASKS]
    parts = [("In tasks like these, ", like), ("In these tasks, ", here)]
    few = "Words that fewer than four kinds of tasks have say nothing about other tasks. " * bool(here)
    if question.num_tasks == 1 or question.units.estimand == Estimand.THESE_TASKS:
        parts, few = [("", sure)], ""
    # What is read more comes first.
    parts = sorted((part for part in parts if part[1]), key=lambda part: part[1][0]["lift"] <= 1)
    said = [f"{begin}{_more_and_less(part)}." for begin, part in parts]
    top = parts[0][1][0] if parts[0][1][0]["lift"] > 1 else parts[0][1][-1]
    numbers = {"word": top["item"], "estimate": top["lift"], "low": top["lift_low"], "high": top["lift_high"],
               "q": top["lift_q"], "like_these": len(like), "these": len(here)}  # fmt: skip
    sentence = " ".join(f"{one[0].upper()}{one[1:]}" for one in said)
    return Finding(sentence, "Which words are read?", numbers, f"{few}{limit}", effects)


def _nothing_named(words: pl.DataFrame, limit: str) -> tuple[str, str, dict[str, float | int | str | None], str]:
    """Sentence, question, numbers and limit: how much a run of this size would have shown."""
    known = words["lift_detectable"].drop_nulls().to_list()
    tested = words["lift_q"].len() - words["lift_q"].null_count()
    could = would_show(median(known)) if known else "One episode of a word has no interval: record more episodes."
    verdict = f"No word is shown to get more, or less, than its share of attention ({plural(tested, 'word')} tested)."
    numbers: dict[str, float | int | str | None] = {"tested": tested, "detectable": median(known) if known else None}
    return verdict, "Which words are read?", numbers, f"{could} {limit}"


def _more_and_less(words: Sequence[Mapping[str, Any]]) -> str:
    """Of words that are shown, sorted downwards: those with more than their share, and those with less."""
    more, less = [row for row in words if row["lift"] > 1], [row for row in reversed(words) if row["lift"] < 1]
    said, goes = [], "share of attention goes to"
    for which, part in (("more", more), ("less", less)):
        if part:
            rest = f" and {len(part) - _MOST_NAMED} more" if len(part) > _MOST_NAMED else ""
            said.append(f"{which} than its {goes}: {', '.join(map(_named, part[:_MOST_NAMED]))}{rest}")
            goes = "share goes to"
    return "; ".join(said)


def _named(row: Mapping[str, Any]) -> str:
    return f"'{row['item']}' ({row['lift']:.2g} times)"
