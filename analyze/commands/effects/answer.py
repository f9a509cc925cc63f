"""What the action depends on: how it changes without a word, a picture, an object, beside the attention to these."""

from __future__ import annotations

from collections.abc import Collection

import polars as pl

from vla_attention.analyze.commands.effects.data_set import deviation, has_dataset_actions
from vla_attention.analyze.commands.effects.items import (
    FEW,
    IS_WORD,
    LESS,
    MORE,
    NO_NOISE,
    OPEN,
    UNIT,
    by_item,
    columns_of_items,
    exchanged,
    figures_of_items,
    with_untested,
)
from vla_attention.analyze.commands.effects.prompts import other_sentences
from vla_attention.analyze.core.about import about, enough, how_to_record_effects, notes, with_interval
from vla_attention.analyze.core.action_changes import GRIPPER, ActionSpread
from vla_attention.analyze.core.axes import check_axes, columns_of
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.recorded_effects import ITEM, RecordedEffects, recorded_effects, summary_of
from vla_attention.analyze.core.result import Figure, Finding, Result, Table
from vla_attention.analyze.measures.frames import EPISODE_ID
from vla_attention.analyze.measures.question import Question
from vla_attention.schemas.errors import BadArgument, listing, plural

_MISSING = "What if a word is left out?"
#: Of the items, so many are named, and drawn over time.
_MOST_NAMED, _MOST_DRAWN = 5, 4
#: From this part of a squared effect on, it is said that it is the gripper's.
_HALF = 0.5
_SIDES = ("pictures", "text")
_OF_SIDE = pl.col("item_kind").is_in(_SIDES)


def effects(question: Question, by: Collection[str] = ()) -> Result:
    """Recorded effects of every item, and how far the actions are from a data set's where the stores hold it.

    Raises:
        BadArgument: the stores hold neither.
    """
    check_axes(by, ("task", "family", "episode", "replan", "time"))
    found = recorded_effects(question)
    of_data = deviation(question) if has_dataset_actions(question) else ([], [], [])
    if found is None and not of_data[0]:
        raise BadArgument(
            f"{question.stores[0].path} holds neither effects nor a data set's actions; its calls can be made again "
            f"without each word and each picture: {how_to_record_effects(question)}"
        )
    findings, tables, figures = ([], [], []) if found is None else _recorded(found, by)
    left_out = () if found is None else (*found.notes, *_left_out(found.spread))
    return Result(
        "What the action depends on",
        about(question),
        [*findings, *of_data[0]],
        [*tables, *of_data[1]],
        [*figures, *of_data[2]],
        [*left_out, *notes(question)],
    )


def word_effects(question: Question) -> tuple[list[Finding], list[Table]]:
    """How the action changes with words exchanged, and without each: the first findings of `effects`, and a table."""
    try:
        found = recorded_effects(question, attention=False)
    except BadArgument as error:
        return [Finding(f"Not shown: {error}", _MISSING)], []
    if found is None:
        said = "Not recorded: how the action changes without a word."
        return [Finding(said, _MISSING, next_step=how_to_record_effects(question))], []
    episodes = found.episodes()
    items = with_untested(question, by_item(summary_of(episodes, question.sampling)))
    table = items.filter(IS_WORD)
    columns = [column for column in columns_of_items(table) if column.name != "lift"]
    otherwise, tables = other_sentences(question, episodes)
    findings = [*exchanged(question, episodes), *otherwise, deciding(table, found.spread)]
    return findings, [*tables, Table("word_effects", table, columns, "What the action does without a word")]


def _recorded(found: RecordedEffects, by: Collection[str]) -> tuple[list[Finding], list[Table], list[Figure]]:
    """Findings, tables and figures of recorded effects."""
    question, looks, episodes = found.question, columns_of(by), found.episodes(by)
    names = [column.name for column in looks]
    summary = summary_of(episodes, question.sampling, names)
    items = by_item(summary, names)
    files = [
        Table("effects_summary", summary),
        Table("effects_episodes", episodes.drop("square", "gripper_square")),
        Table("effects", found.rows()),
    ]
    shown = [*looks, *columns_of_items(items)]
    otherwise, of_prompts = other_sentences(question, episodes, looks)
    if by:
        said = f"Below, a row for each item and {' and '.join(by)}."
        return (
            [Finding(said, "What does the action depend on?")],
            [Table("effects_items", items, shown), *of_prompts, *files],
            [],
        )
    items = with_untested(question, items)
    of_words = pl.col("item_kind").is_in(["word", "exchange"])
    words, others = items.filter(IS_WORD), items.filter(~of_words)
    findings = [*exchanged(question, episodes), *otherwise, deciding(words, found.spread)]
    findings += [*_sides(question, episodes, items), *_others(others), *_ways(words)]
    findings += _unlike_attention(words)
    course = _over_time(found, items)
    tables = [Table("effects_items", items, shown, "Without it, the action changes by", rows=16), *files]
    return findings, [*of_prompts, *tables, Table("effects_time", course)], figures_of_items(items, course, summary)


def deciding(words: pl.DataFrame, spread: ActionSpread) -> Finding:
    """The words without which the action changes most, of the rows of `by_item` that are words."""
    tested = words.drop_nulls("effect").sort("effect", descending=True)
    untested = words.height - tested.height
    limits = [f"{plural(untested, 'word')} of the instructions not tested."] if untested else []
    if tested.is_empty():
        return Finding("Not tested: no effect of a single word was recorded.", _MISSING, {}, " ".join(limits))
    sure, few = tested.filter(than_noise=MORE), tested.filter(than_noise=FEW)
    top = (sure if sure.height else tested).row(0, named=True)
    without = f"{'Without' if top['reader'] == 'total' else 'Hidden from the action tokens,'} {top['label']}"
    size = f"{with_interval(top, 'effect')} {UNIT}"
    noise = "" if top["noise"] is None else f" (another noise seed: {top['noise']:.2g})"
    if sure.height:
        said = f"{without} the action changes most: by {size}{noise}."
        if sure.height > 1:
            said += f" Also shown to change it by more than another noise seed does: {_named(sure[1:])}."
        if (larger := tested.filter(pl.col("effect") > top["effect"])).height:
            limits.insert(0, f"Larger, but not shown for other episodes: {_named(larger)}.")
    elif few.height < tested.height:
        said = f"No word is shown to change the action by more than another noise seed does. {without} it changes most "
        said += f"here: by {size}{noise}."
    else:
        said = f"{without} the action changes most in these episodes: by {size}{noise}."
        said += f" Next: {_named(tested[1:])}." if tested.height > 1 else ""
    if few.height:
        limits.insert(0, f"Too few episodes to say more of {listing(few['label'], _MOST_NAMED)}.")
    numbers = {"word": top["item"], "estimate": top["effect"], "low": top["effect_low"], "high": top["effect_high"],
               "noise": top["noise"], "shown": sure.height, "tested": tested.height}  # fmt: skip
    if (top["grip_part"] or 0.0) >= _HALF:
        said += f" The change without {top['label']} is {top['grip_part']:.0%} gripper: it is told the opposite in "
        said += f"{top['grip']:.0%} of the steps, and as its commands hardly vary here (standard deviation "
        said += (
            f"{spread.spread[GRIPPER]:.2g}), that counts much; the hand's direction turns by {top['turn'] or 0.0:.0f} "
        )
        said += "degrees."
        turn = tested.sort("turn", descending=True, nulls_last=True).row(0, named=True)
        if turn["label"] != top["label"] and turn["turn"] is not None:
            said += f" The hand's direction turns most without {turn['label']}: by {turn['turn']:.0f} degrees."
    return Finding(said, _MISSING, numbers, " ".join(limits))


def _named(rows: pl.DataFrame, value: str = "effect") -> str:
    return listing([f"{item} ({size:.2g})" for item, size in rows.select("label", value).iter_rows()], _MOST_NAMED)


def _sides(question: Question, episodes: pl.DataFrame, items: pl.DataFrame) -> list[Finding]:
    """Without all pictures against without all text, in the episodes that have both."""
    rows = episodes.filter(_OF_SIDE, kind="without", reader="total")
    both = rows.pivot("item_kind", index=EPISODE_ID, values="effect").with_columns(side=pl.lit("pictures / text"))
    if not {*_SIDES} <= set(both.columns):
        return []
    sizes: dict[str, Scale] = dict.fromkeys(_SIDES, "positive")
    row = estimate(both.drop_nulls(), ["side"], sizes, question.sampling, quotients={"ratio": _SIDES})
    one = row.row(0, named=True)
    if one["ratio"] is None:
        return []
    said = (
        f"Without all pictures the action changes {with_interval(one, 'ratio')} times as much as without all text "
        f"({one['pictures']:.2g} and {one['text']:.2g})."
    )
    mostly = items.filter(_OF_SIDE, pl.col("grip_part") >= _HALF, kind="without")["label"].to_list()
    said += (
        f" Without {mostly[0] if len(mostly) == 1 else 'either'}, most of the change is the gripper's."
        if mostly
        else ""
    )
    numbers = {"estimate": one["ratio"], "low": one["ratio_low"], "high": one["ratio_high"], "n": one["num_episodes"]}
    return [Finding(said, "Pictures or text?", numbers, enough(question))]


def _others(items: pl.DataFrame) -> list[Finding]:
    """Pictures, parts, objects and exchanges that are shown to exceed another noise seed, and those below it."""
    items = items.filter(pl.col("than_noise") != NO_NOISE)
    if items.is_empty():
        return []
    sure, less = items.filter(than_noise=MORE), items.filter(than_noise=LESS)
    rest = items.height - sure.height - less.height
    parts = [f"Changed by more than by another noise seed: without {_named(sure)}"] if sure.height else []
    parts += [f"Changed less: without {_named(less)}"] if less.height else []
    parts += [f"Not shown to be changed by more: {plural(rest, 'other item') if parts else 'any item'}"] if rest else []
    numbers = {"shown": sure.height, "smaller": less.height, "open": rest}
    return [Finding(f"{'. '.join(parts)}.", "And without something else?", numbers)] if parts else []


def _ways(words: pl.DataFrame) -> list[Finding]:
    """Which of the shown words the action tokens read themselves, and which act through what has read them."""
    words = words.filter(than_noise=MORE).drop_nulls(["total", "direct"])
    half = 2 * pl.col("direct") >= pl.col("total")
    own, rest = words.filter(half), words.filter(~half)
    seen = (2 * pl.col("pictures") >= pl.col("total")).fill_null(False)
    parts = [f"the action tokens read {listing(own['label'], _MOST_NAMED)} themselves"] if own.height else []
    for is_it, through in ((seen, "the pictures, which have read it"), (~seen, "other tokens")):
        part = rest.filter(is_it)
        if part.height:
            sizes = sorted(part["direct"].to_list())
            alone = f"hidden from the action tokens alone: {sizes[0]:.2g}"
            alone += f" to {sizes[-1]:.2g}" if part.height > 1 else ""
            parts.append(f"{listing(part['label'], _MOST_NAMED)} acts through {through} ({alone})")
    said = "; ".join(parts)
    return [Finding(f"{said[0].upper()}{said[1:]}.", "How do these words reach the action?")] if parts else []


def _unlike_attention(words: pl.DataFrame) -> list[Finding]:
    """Words whose attention says something else than their effect."""
    silent = words.filter(pl.col("lift") < 1, than_noise=MORE)
    idle = words.filter(pl.col("lift") > 1, pl.col("than_noise").is_in([OPEN, LESS]))
    parts = (
        [f"less than its share, and the action changes without it: {_named(silent, 'lift')}"] if silent.height else []
    )
    parts += [f"more than its share, and no change is shown without it: {_named(idle, 'lift')}"] if idle.height else []
    said = "; ".join(parts)
    limit = "In brackets: attention to the word, evenly spread over all tokens = 1."
    return [Finding(f"{said[0].upper()}{said[1:]}.", "Does attention tell?", limit=limit)] if parts else []


def _left_out(spread: ActionSpread) -> list[str]:
    """The dimensions of the action that are not compared, and why."""
    parts = [f"{i} ({why})" for i, why in enumerate(spread.reasons) if why]
    return [f"Dimensions of the action that are not compared: {listing(parts, 20)}."] if parts else []


def _over_time(found: RecordedEffects, items: pl.DataFrame) -> pl.DataFrame:
    """Effects over the parts of an episode's time: of pictures, text, the largest words or other items, and noise."""
    of_side = _OF_SIDE & pl.col("kind").is_in(["without", "only"])
    words = items.filter(IS_WORD).drop_nulls("effect")
    largest = (words if words.height else items.filter(~of_side)).head(_MOST_DRAWN)
    drawn = pl.concat([items.filter(of_side, kind="without"), largest])["condition"].drop_nulls().to_list()
    rows = found.episodes(["time"]).filter(pl.col("condition").is_in(drawn) | (pl.col("kind") == "noise"))
    course = estimate(rows, ["condition", *ITEM, "reader", "phase"], {"effect": "positive"}, found.question.sampling)
    order = pl.col("condition").replace_strict({name: i for i, name in enumerate(drawn)}, default=len(drawn))
    return course.sort(order, "condition", "phase")
