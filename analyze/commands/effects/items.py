"""Recorded effects item by item: the table that is shown, and the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import polars as pl

from vla_attention.analyze.core.about import with_interval
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.recorded_effects import ITEM
from vla_attention.analyze.core.result import Column, Figure, Finding
from vla_attention.analyze.measures.frames import EPISODE_ID
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.schemas.errors import listing
from vla_attention.schemas.interventions import PromptKind

#: Whether an item is shown to change the action by more than another noise seed does.
MORE, OPEN, LESS, FEW, UNTESTED, NO_NOISE = (
    "more", "not shown to be more", "smaller", "too few episodes", "not tested", "not recorded"
)  # fmt: skip
_SHOWN_KINDS = ("without", "only", "prompt", "image")
#: In the order of tables and pictures.
_KINDS = ("word", "pictures", "camera", "object", "group", "text", "part", "token", "exchange")
_READERS = ("total", "direct", "pictures", "text")
_ALWAYS = ("label", "than_noise")
UNIT = "standard deviations of the run's actions"


#: The rows of calls without a word.
IS_WORD = (pl.col("kind") == "without") & (pl.col("item_kind") == "word")


def by_item(summary: pl.DataFrame, looks: Sequence[str] = ()) -> pl.DataFrame:
    """One row per item (and cell of the columns `looks`), words first, the largest effects of each kind first.

    Returns:
        looks, `ITEM`, condition, reader; effect: that of the reader `total`, or where it was not recorded of
        `direct`; in its row of `RecordedEffects.summary` turn, grip, grip_part, lift, noise, q and num_episodes;
        than_noise; and the effect of every reader. Effects have intervals.
    """
    names = [*looks, *ITEM]
    # Other sentences are no items: `prompts` has them, by what they are.
    is_item = pl.col("kind").is_in(_SHOWN_KINDS) & ~pl.col("item_kind").is_in(get_args(PromptKind))
    rows = summary.filter(is_item).with_columns(pl.col("reader").fill_null("total"))
    of_total = rows.filter(reader="total")
    direct = rows.filter(reader="direct").join(of_total, on=names, how="anti", nulls_equal=True)
    found = pl.concat([of_total, direct]).select(
        *names, "condition", "reader", *_with_ends("effect"), turn="angle", grip="gripper_flips",
        grip_part="gripper_part", lift="lift", noise="noise", than_noise=against_noise(), q="times_noise_q",
        num_episodes="num_episodes",
    )  # fmt: skip
    for reader in _READERS:
        part = rows.filter(reader=reader).select(*names, *_with_ends("effect", reader))
        found = found.join(part, on=names, how="left", nulls_equal=True, maintain_order="left")
    order = pl.col("item_kind").replace_strict({kind: i for i, kind in enumerate(_KINDS)}, default=len(_KINDS))
    down = [*(False for _ in looks), False, True]
    return found.sort(*looks, order, "effect", descending=down, nulls_last=True, maintain_order=True)


def against_noise() -> pl.Expr:
    """Whether the effect of a row is shown to be more than that of another noise seed, from times_noise and its q."""
    # On the scale of the effects themselves, which differ by factors: a difference would be of the largest episodes.
    q, above = pl.col("times_noise_q"), pl.col("times_noise")
    return (
        pl.when(above.is_null()).then(pl.lit(NO_NOISE))
        .when(above <= 0).then(pl.lit(LESS))
        .when(q.is_null()).then(pl.lit(FEW))
        .when(q <= NAMED_AT).then(pl.lit(MORE))
        .otherwise(pl.lit(OPEN))
    )  # fmt: skip


def _with_ends(name: str, to: str = "") -> list[pl.Expr]:
    return [pl.col(f"{name}{end}").alias(f"{to or name}{end}") for end in ("", "_low", "_high")]


def with_untested(question: Question, items: pl.DataFrame) -> pl.DataFrame:
    """The items with the words of the instructions that were not tested, behind the others."""
    spoken = {word.text.casefold() for one in question.selected for line in one.tokens.words for word in line}
    words, others = items.filter(IS_WORD), items.filter(~IS_WORD)
    rows = [("without", "word", word, "", f"'{word}'", UNTESTED) for word in sorted(spoken - {*words["item"]})]
    schema = dict.fromkeys((*ITEM, "than_noise"), pl.String)
    return pl.concat([words, pl.DataFrame(rows, schema=schema, orient="row"), others], how="diagonal")


def exchanged(question: Question, episodes: pl.DataFrame) -> list[Finding]:
    """Whether it tells words apart: how far the action moves with one exchanged for another, which tasks also have."""
    is_exchange = pl.col("item_kind").is_in(["exchange", "exchanged"])
    rows = episodes.filter(is_exchange, kind="prompt").group_by(*EPISODE_ID, maintain_order=True)
    of_episodes = rows.agg(pl.mean("effect", "noise"), words=pl.col("label"))
    if of_episodes.is_empty():
        return []
    of_episodes = of_episodes.with_columns(
        what=pl.lit("any word"), times_noise=(pl.col("effect") / pl.col("noise")).log()
    )
    sizes: dict[str, Scale] = {"effect": "positive", "noise": "positive", "times_noise": "plain"}
    row = estimate(of_episodes, ["what"], sizes, question.sampling, {"times_noise": 0.0}).row(0, named=True)
    words = of_episodes["words"].explode().unique().sort().to_list()
    said = (
        f"with a word exchanged for another ({listing(words, 2)}) the action moves by {with_interval(row, 'effect')} "
    )
    said += f"{UNIT}" + ("" if row["noise"] is None else f"; another noise seed moves it by {row['noise']:.2g}")
    verdict = ""
    if row["times_noise"] is not None and row["times_noise_q"] is not None and row["times_noise_q"] <= NAMED_AT:
        verdict = "It does: " if row["times_noise"] > 0 else "Not shown, and less than noise: "
    numbers = {"estimate": row["effect"], "low": row["effect_low"], "high": row["effect_high"], "noise": row["noise"],
               "q": row["times_noise_q"], "n": row["num_episodes"]}  # fmt: skip
    limit = "" if verdict else "Not shown to be more than noise."
    said = f"{verdict}{said}." if verdict else f"{said[0].upper()}{said[1:]}."
    return [Finding(said, "Does it tell words apart?", numbers, limit)]


def figures_of_items(items: pl.DataFrame, course: pl.DataFrame, summary: pl.DataFrame) -> list[Figure]:
    """Effects by item; over time; and beside attention."""
    noise = summary.filter(kind="noise")["effect"].drop_nulls().mean()
    n = "Means over episodes, every task weighing the same; {}: 95% intervals."
    floor = {} if noise is None else {"baseline": noise, "baseline_name": "another noise seed"}
    items = items.with_columns(color=pl.col("item_kind").replace({"camera": "pictures", "part": "text"}))
    by_kind, change = {"color": "color"}, "change (standard deviations)"
    forest = {"value": "effect", "label": "label", "xlabel": change, "log": True, **floor, **by_kind}
    title = "How the action changes without it, or with it exchanged"
    found = [Figure("effects_by_item", "forest", items, title, n.format("bars"), forest)]
    if course["phase"].n_unique() > 1:
        lines = {"x": "phase", "value": "effect", "color": "label", "log": True, "ylabel": change,
                 "xlabel": "time (0: first replan, 1: end)", "colors": {"another noise seed": "#7F7F7F"}}  # fmt: skip
        title = "How the action changes without it, over an episode"
        found.append(Figure("effects_over_time", "lines", course, title, n.format("bands"), lines))
    rows = items.filter(pl.col("item_kind").is_in(["word", "object"]), kind="without").drop_nulls("lift")
    if rows.height > 1:
        points = {"x": "lift", "y": "effect", "label": "label", "log": True, **by_kind,
                  "xlabel": "attention per token, evenly spread = 1", "ylabel": change}  # fmt: skip
        title = "Attention to it, and how the action changes without it"
        found.append(Figure("attention_and_effect", "scatter", rows, title, n.format("bars"), points))
    return found


def columns_of_items(items: pl.DataFrame) -> list[Column]:
    """The columns of the rows of `by_item` that are shown; those that nothing was recorded of are not."""
    columns = [
        Column("label", "text", "without, or changed"),
        Column("total", "number", "nobody reads it", f"how far the action moves then, in {UNIT}"),
        Column("direct", "number", "action tokens do not", "the same, while others may read it"),
        Column("than_noise", "text", "than noise", "whether that is shown to be more than another noise seed does"),
        Column("turn", "number", "turn", "of the hand's direction, in degrees"),
        Column("grip", "percent", "gripper", "steps in which it is told the opposite"),
        Column("lift", "factor", "attention", "per token, evenly spread = 1"),
        Column("noise", "number", "another noise", "how far another seed moves it there"),
        Column("num_episodes", "count", "episodes"),
        Column("pictures", "number", "pictures do not", "the same if the tokens of pictures do not read it", False),
        Column("text", "number", "text does not", "the same if the tokens of the prompt do not read it", False),
        Column("q", "p", "q", "p of no difference from another noise seed, adjusted for the number of rows", False),
    ]
    return [column for column in columns if column.name in _ALWAYS or items[column.name].drop_nulls().len()]
