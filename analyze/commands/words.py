"""Which words of the instruction are read."""

from __future__ import annotations

import shlex
from collections.abc import Collection

import polars as pl

from vla_attention.analyze.core.about import about, enough, how_to_record_effects, notes
from vla_attention.analyze.core.axes import OF_ROWS, check_axes, columns_of, with_families
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.measure import measure, table_of
from vla_attention.analyze.core.result import Column, Figure, Finding, Result, Table
from vla_attention.analyze.core.word_items import LABELS, SCALE, items_of
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.schemas.errors import BadArgument, plural
from vla_attention.schemas.groupings.vocabulary import NO_WORDS
from vla_attention.schemas.layout import Role
from vla_attention.schemas.safe_text import visible

_VALUES: dict[str, Scale] = {"keys": "positive", "mass": "positive", "lift": "positive", "share": "share"}
#: Of the words that are read more than uniform attention would, so many are named.
_MOST_NAMED = 5
LIFT = "attention to the word, over what it would get if attention were spread evenly over all tokens"


def words(question: Question, by: Collection[str] = (), named_at: float = NAMED_AT) -> Result:
    """Lift, mass and share of every word; which are read more, and which less, than evenly spread attention would.

    named_at: words with at most this q are named; a screen that names other things too asks for less.

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
    summary = estimate(rows, [*looks, *LABELS], _VALUES, question.sampling, {"lift": 1.0}, [*looks, "kind"])
    order = ("place", False) if shown == "place" else ("lift", True)
    summary = summary.drop("keys_low", "keys_high").sort(
        *looks, "kind", order[0], descending=[*(False for _ in looks), False, order[1]], nulls_last=True
    )
    columns = [*kept, *_columns(question.num_tasks)]
    is_shown = pl.col("kind") == shown
    is_scale = pl.col("kind") == "scale"
    bars = pl.concat([summary.filter(is_shown), summary.filter(is_scale)])
    bars = bars.with_columns(color=pl.when(is_scale).then(pl.lit("scale")).otherwise("word_class"))
    return Result(
        "Which words of the instruction are read",
        about(question),
        [_finding(question, summary.filter(is_shown), by, named_at)],
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
    outside = pl.col("item").is_in([SCALE[Role.STATE], SCALE[Role.IMAGE]]) & (pl.col("kind") == "scale")
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


def _columns(num_tasks: int) -> list[Column]:
    return [
        Column("item", "text", "word"),
        Column("lift", "factor", "times even", LIFT),
        Column("lift_q", "p", "q", "p of no difference, adjusted for the number of words (Benjamini-Hochberg)"),
        Column("mass", "percent", "of all attention"),
        Column("share", "percent", "of the text", "part of the attention to all language", screen=False),
        Column("keys", "number", "tokens"),
        Column("num_episodes", "count", "episodes"),
        *([Column("num_tasks", "count", "tasks")] if num_tasks > 1 else []),
        Column("word_class", "text", "class", screen=False),
    ]


def _finding(question: Question, words: pl.DataFrame, by: Collection[str], named_at: float) -> Finding:
    """Which words get more, and which less, than evenly spread attention would give them."""
    recorded = any(item.episode.attributes.effects is not None for item in question.selected)
    path = shlex.quote(str(question.stores[0].path))
    effects = f"vla-attention effects {path}" if recorded else how_to_record_effects(question)
    limit = "Being read is not deciding: a word that the pictures have read decides with hardly any attention."
    limit = f"{enough(question)} {limit}".lstrip()
    if by:
        return Finding(
            f"Below, a row for each word and {' and '.join(by)}.", "Which words are read?", {}, limit, effects
        )
    # What is shown of one task's words alone is no answer about a run of many.
    alike = pl.col("intervals") == question.units.estimand.value
    sure = words.filter(alike | (question.num_tasks == 1), pl.col("lift_q") <= named_at)
    more = sure.filter(pl.col("lift") > 1).sort("lift", descending=True)
    less = sure.filter(pl.col("lift") < 1).sort("lift")
    said = [
        f"{which}: {', '.join(_named(row) for row in part.head(_MOST_NAMED).iter_rows(named=True))}"
        + (f" and {part.height - _MOST_NAMED} more" if part.height > _MOST_NAMED else "")
        for which, part in (("more than its share of attention goes to", more), ("less than its share goes to", less))
        if part.height
    ]
    tested = words["lift_q"].len() - words["lift_q"].null_count()
    if not said:
        verdict = (
            f"No word is shown to get more, or less, than its share of attention ({plural(tested, 'word')} tested)."
        )
        few = "" if tested else "One episode of a word has no interval: record more episodes. "
        return Finding(verdict, "Which words are read?", {"tested": tested}, f"{few}{limit}", effects)
    top = (more if more.height else less).row(0, named=True)
    numbers = {"word": top["item"], "estimate": top["lift"], "low": top["lift_low"], "high": top["lift_high"]}
    sentence = "; ".join(said)
    sentence = f"{sentence[0].upper()}{sentence[1:]}."
    return Finding(sentence, "Which words are read?", {**numbers, "q": top["lift_q"]}, limit, effects)


def _named(row: dict[str, object]) -> str:
    lift = row["lift"]
    assert isinstance(lift, float)
    return f"'{row['item']}' ({lift:.2g} times)"
