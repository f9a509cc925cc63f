"""Recorded effects item by item: the table that is shown, and the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import polars as pl

from vla_attention.analyze.core.about import with_interval
from vla_attention.analyze.core.action_changes import ActionUnits
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.recorded_effects import ITEM, times
from vla_attention.analyze.core.result import Column, Figure, Finding
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.tables import EPISODE_ID
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.errors import listing
from vla_attention.schemas.interventions import PromptKind

#: Whether an item is shown to change the action by more than another noise seed does: what ranks it, or the gripper.
MORE, GRIPPER_MORE, OPEN, LESS, FEW, UNTESTED, NO_NOISE = (
    "more", "the gripper's is", "not shown to be more", "less", "too few episodes", "not tested", "not recorded"
)  # fmt: skip
#: A word without which it is more, and with another word in its place is not shown to be.
NOT_EXCHANGED = "more, but not with another word"
_SHOWN_KINDS = ("without", "only", "prompt", "image")
#: Points and courses in pictures: of items that are `MORE`, and of the others.
_SHOWN, _NOT_SHOWN = "more than another noise seed", "not shown to be more"
#: In the order of tables and pictures.
_KINDS = ("word", "pictures", "camera", "object", "group", "text", "part", "token", "exchange")
_READERS = ("total", "direct", "pictures", "text")
_ALWAYS = ("label", "than_noise")
#: Said where no call was made with another noise seed.
WITHOUT_NOISE = "No call was made with other noise. If the policy draws none, none of it is chance."
#: The rows of calls without a word.
IS_WORD = (pl.col("kind") == "without") & (pl.col("item_kind") == "word")


#: Of the items, so many are named.
MOST_NAMED = 5


def named_sizes(rows: pl.DataFrame, value: str = "effect") -> str:
    """Items with a value of theirs in brackets: "'red' (4.3), 'blue' (6.9) and 3 more"."""
    return listing([f"{item} ({size:.2g})" for item, size in rows.select("label", value).iter_rows()], MOST_NAMED)


def by_item(summary: pl.DataFrame, units: ActionUnits, looks: Sequence[str] = ()) -> pl.DataFrame:
    """One row per item (and cell of the columns `looks`), words first, the largest effects of each kind first.

    Returns:
        looks, `ITEM`, condition, reader; effect: that of the reader `total`, or where it was not recorded of `direct`;
        in its row of `summary_of` the further parts (turn, gripper, ...), lift, lift_q, noise, q, gripper_q and
        num_episodes; than_noise; and the effect of every reader. Effects have intervals.
    """
    names = [*looks, *ITEM]
    # Other sentences are no items: `prompts` has them, by what they are.
    is_item = pl.col("kind").is_in(_SHOWN_KINDS) & ~pl.col("item_kind").is_in(get_args(PromptKind))
    rows = summary.filter(is_item).with_columns(pl.col("reader").fill_null("total"))
    of_total = rows.filter(reader="total")
    direct = rows.filter(reader="direct").join(of_total, on=names, how="anti", nulls_equal=True)
    gripper = {"gripper_q": "gripper_minus_noise_q", "gripper_minus_noise": "gripper_minus_noise"}
    gripper = gripper if "gripper_minus_noise_q" in summary.columns else {}
    found = pl.concat([of_total, direct]).select(
        *names, "condition", "reader", *_with_ends("effect"), *units.names[1:], "lift", "lift_q", "noise",
        than_noise=against_noise(bool(gripper)), q="times_noise_q", detectable="times_noise_detectable",
        num_episodes="num_episodes", **gripper,
    )  # fmt: skip
    for reader in _READERS:
        part = rows.filter(reader=reader).select(*names, *_with_ends("effect", reader))
        found = found.join(part, on=names, how="left", nulls_equal=True, maintain_order="left")
    order = pl.col("item_kind").replace_strict({kind: i for i, kind in enumerate(_KINDS)}, default=len(_KINDS))
    down = [*(False for _ in looks), False, True]
    return found.sort(*looks, order, "effect", descending=down, nulls_last=True, maintain_order=True)


def against_noise(gripper: bool = False) -> pl.Expr:
    """Whether the effect of a row is shown to be more, or less, than that of another noise seed.

    gripper: whether rows have the gripper's test beside.
    """
    # On the scale of the effects themselves, which differ by factors: a difference would be of the largest episodes.
    q, above = pl.col("times_noise_q"), pl.col("times_noise")
    return (
        pl.when(above.is_null()).then(pl.lit(NO_NOISE))
        .when((q <= NAMED_AT) & (above > 0)).then(pl.lit(MORE))
        .when(gripper_flips("gripper_minus_noise_q") if gripper else pl.lit(False)).then(pl.lit(GRIPPER_MORE))
        .when(q.is_null()).then(pl.lit(FEW))
        .when(q <= NAMED_AT).then(pl.lit(LESS))
        .otherwise(pl.lit(OPEN))
    )  # fmt: skip


def gripper_flips(q: str) -> pl.Expr:
    """Whether the gripper's command is shown to flip more often than with another noise seed; q: the column."""
    return (pl.col(q) <= NAMED_AT) & (pl.col("gripper_minus_noise") > 0)


def _with_ends(name: str, to: str = "") -> list[pl.Expr]:
    return [pl.col(f"{name}{end}").alias(f"{to or name}{end}") for end in ("", "_low", "_high")]


def with_untested(question: Question, items: pl.DataFrame) -> pl.DataFrame:
    """The items with the words of the instructions that were not tested, behind the others."""
    spoken = {word.text.casefold() for one in question.selected for line in one.tokens.words for word in line}
    words, others = items.filter(IS_WORD), items.filter(~IS_WORD)
    rows = [("without", "word", word, "", f"'{word}'", UNTESTED) for word in sorted(spoken - {*words["item"]})]
    schema = dict.fromkeys((*ITEM, "than_noise"), pl.String)
    return pl.concat([words, pl.DataFrame(rows, schema=schema, orient="row"), others], how="diagonal")


def exchanged(question: Question, episodes: pl.DataFrame, units: ActionUnits) -> list[Finding]:
    """Whether it tells words apart: how far the action moves with one exchanged for another, which tasks also have."""
    rows = episodes.filter(pl.col("item_kind").is_in(["exchange", "exchanged"]), kind="prompt")
    if rows.is_empty():
        return []
    row = beside_noise(rows.with_columns(what=pl.lit("any word")), ["what"], question.sampling).row(0, named=True)
    words = rows["label"].unique().sort().to_list()
    size = units.size(row["effect"], with_interval(row, "effect"))
    said = f"with a word exchanged for another ({listing(words, 2)}) {size}"
    said += "" if row["noise"] is None else f" (another noise seed: {units.short(row['noise'])})"
    unclear = "Not shown to be more than noise." if row["noise"] is not None else WITHOUT_NOISE
    verdict, limit = {
        MORE: ("It does: ", ""), LESS: ("It does not: ", "")
    }.get(row["than_noise"], ("", unclear))  # fmt: skip
    numbers = {"estimate": row["effect"], "low": row["effect_low"], "high": row["effect_high"], "noise": row["noise"],
               "q": row["times_noise_q"], "n": row["num_episodes"]}  # fmt: skip
    said = f"{verdict}{said}." if verdict else f"{said[0].upper()}{said[1:]}."
    return [Finding(said, "Does it tell words apart?", numbers, limit)]


def with_exchanges(question: Question, episodes: pl.DataFrame, items: pl.DataFrame) -> pl.DataFrame:
    """The items; those that are words with what another word in their place does: exchanged.

    A word that moves the action where it is missing, and whose exchange is not shown to do anything, is
    `NOT_EXCHANGED`: a sentence with a missing word is new to a policy, one with another word is not.
    """
    words, rows = items.filter(IS_WORD), episodes.filter(item_kind="exchange", kind="prompt")
    if rows.is_empty():
        words = words.with_columns(exchanged=pl.lit(None, pl.Float64))
    else:
        found = beside_noise(rows, ["item"], question.sampling)
        small = (pl.col("than_noise") == OPEN) & (pl.col("effect") <= pl.col("noise"))
        idle = (pl.col("than_noise") == LESS) | small
        words = words.join(
            found.select("item", exchanged="effect", idle=idle), on="item", how="left", maintain_order="left"
        )
        moves = pl.col("than_noise").is_in([MORE, GRIPPER_MORE])
        held = pl.when(moves & pl.col("idle")).then(pl.lit(NOT_EXCHANGED)).otherwise("than_noise")
        words = words.with_columns(than_noise=held).drop("idle")
    return pl.concat([words, items.filter(~IS_WORD)], how="diagonal")


def beside_noise(rows: pl.DataFrame, by: Sequence[str], sampling: Sampling, family: Sequence[str] = ()) -> pl.DataFrame:
    """Means over the conditions of each episode and item of `by`, estimated beside another noise seed.

    Returns:
        by, effect, noise, times_noise with q, over_noise (effect / noise), than_noise, and counts; see `estimate`.
    """
    rows = rows.group_by(*dict.fromkeys((*EPISODE_ID, *by)), maintain_order=True).agg(pl.mean("effect", "noise"))
    rows = rows.with_columns(times_noise=times("effect", "noise"))
    sizes: dict[str, Scale] = {"effect": "positive", "noise": "positive", "times_noise": "plain"}
    quotients = {"over_noise": ("effect", "noise")}
    found = estimate(rows, by, sizes, sampling, {"times_noise": 0.0}, family, quotients)
    return found.with_columns(than_noise=against_noise())


def figures_of_items(
    items: pl.DataFrame, course: pl.DataFrame, summary: pl.DataFrame, units: ActionUnits
) -> list[Figure]:
    """Effects by item; over time; and beside attention."""
    noise = summary.filter(kind="noise")["effect"].drop_nulls().mean()
    n = "Means over episodes, every task weighing the same; {}: 95% intervals."
    floor = {} if noise is None else {"baseline": noise, "baseline_name": "another noise seed"}
    items = items.with_columns(color=pl.col("item_kind").replace({"camera": "pictures", "part": "text"}))
    by_kind, change = {"color": "color"}, units.title
    forest = {"value": "effect", "label": "label", "xlabel": change, "log": True, **floor, **by_kind}
    title = "How the action changes without it, or with it exchanged"
    found = [Figure("effects_by_item", "forest", items, title, n.format("bars"), forest)]
    shown = pl.when(pl.col("than_noise") == MORE).then(pl.lit(_SHOWN)).otherwise(pl.lit(_NOT_SHOWN))
    by_noise = {"color": "shown", "colors": {_SHOWN: "#0072B2", _NOT_SHOWN: "#8F8F8F"}}
    if course.filter(pl.col("kind") != "noise")["phase"].n_unique() > 1:
        found_of = items.select("condition", shown=shown).unique("condition")
        course = course.join(found_of, "condition", "left", maintain_order="left")
        look = {"x": "phase", "value": "effect", "label": "label", "reference": "another noise seed", "ylabel": change,
                "xlabel": "each strip: from the first policy call to the end", **by_noise}  # fmt: skip
        title = "How the action changes without it, over an episode"
        found.append(Figure("effects_over_time", "courses", course, title, n.format("bands"), look))
    rows = items.filter(pl.col("item_kind").is_in(["word", "object"]), kind="without").drop_nulls("lift")
    if rows.height > 1:
        points = {"x": "lift", "y": "effect", "label": "label", "x_baseline": 1.0, **floor, **by_noise,
                  "xlabel": "attention per token, evenly spread = 1", "ylabel": change}  # fmt: skip
        title = "Attention to it, and how the action changes without it"
        rows = rows.with_columns(shown=shown)
        found.append(Figure("attention_and_effect", "scatter", rows, title, n.format("bars"), points))
    return found


def columns_of_items(items: pl.DataFrame, units: ActionUnits) -> list[Column]:
    """The columns of the rows of `by_item` that are shown; those that nothing was recorded of are not."""
    columns = [
        Column("label", "text", "without, or changed"),
        Column("total", "number", units.title, f"where nobody reads it, {units.said('so much')}"),
        Column("direct", "number", "action tokens do not", "the same, while others may read it"),
        *units.further_columns,
        Column("than_noise", "text", "than noise", "whether that is shown to be more than another noise seed does"),
        Column("exchanged", "number", "exchanged", "the same with the word exchanged for another one"),
        Column("lift", "factor", "attention", "per token, evenly spread = 1"),
        Column("noise", "number", "another noise", "how far another seed moves it there", False),
        Column("num_episodes", "count", "episodes"),
        Column("pictures", "number", "pictures do not", "the same if the tokens of pictures do not read it", False),
        Column("text", "number", "text does not", "the same if the tokens of the prompt do not read it", False),
        Column("q", "p", "q", "p of no difference from another noise seed, adjusted for the number of rows", False),
    ]
    having = [column for column in columns if column.name in items.columns]
    return [column for column in having if column.name in _ALWAYS or items[column.name].drop_nulls().len()]


def with_noise_row(items: pl.DataFrame, summary: pl.DataFrame) -> pl.DataFrame:
    """The items, and what another noise seed alone does behind them."""
    noise = summary.filter(kind="noise")
    if noise.is_empty():
        return items
    row = noise.select([name for name in noise.columns if name in items.columns]).with_columns(total="effect")
    return pl.concat([items, row.select(pl.exclude("lift", "lift_q", "noise", "q"))], how="diagonal")
