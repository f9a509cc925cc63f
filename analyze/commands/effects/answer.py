"""What the action depends on: how it changes without a word, a picture, an object, beside the attention to these."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import polars as pl

from vla_attention.analyze.commands.effects.data_set import deviation, has_dataset_actions
from vla_attention.analyze.commands.effects.items import (
    FEW,
    GRIPPER_MORE,
    IS_WORD,
    LESS,
    MORE,
    MOST_NAMED,
    NO_NOISE,
    NOT_EXCHANGED,
    WITHOUT_NOISE,
    by_item,
    columns_of_items,
    exchanged,
    figures_of_items,
    gripper_flips,
    named_sizes,
    with_exchanges,
    with_noise_row,
    with_untested,
)
from vla_attention.analyze.commands.effects.maps import of_maps
from vla_attention.analyze.commands.effects.prompts import other_sentences
from vla_attention.analyze.commands.effects.ways import unlike_attention, ways_of_words
from vla_attention.analyze.core.about import about, enough, how_to_record_effects, notes, with_interval
from vla_attention.analyze.core.action_changes import ActionUnits, small_size
from vla_attention.analyze.core.axes import check_axes, columns_of
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.recorded_effects import ITEM, RecordedEffects, recorded_effects, summary_of
from vla_attention.analyze.core.result import Figure, Finding, Result, Table
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.tables import EPISODE_ID
from vla_attention.schemas.errors import BadArgument, listing, plural

_MISSING = "What if a word is left out?"
#: Of the items, so many are drawn over time.
_MOST_DRAWN = 4
#: The logarithm of the largest effect, over another noise seed's, of which it is worth saying that it would be shown.
_MOST_TIMES = math.log(100)
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
    left_out = () if found is None else found.notes
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
    episodes, units = found.episodes(), found.units
    summary = summary_of(episodes, units, question.sampling)
    table = with_exchanges(question, episodes, with_untested(question, by_item(summary, units))).filter(IS_WORD)
    columns = [column for column in columns_of_items(table, units) if column.name != "lift"]
    otherwise, tables = other_sentences(question, episodes, units)
    findings = [*exchanged(question, episodes, units), *otherwise, deciding(table, units, summary)]
    table = with_noise_row(table, summary)
    return findings, [*tables, Table("word_effects", table, columns, "What the action does without a word")]


def _recorded(found: RecordedEffects, by: Collection[str]) -> tuple[list[Finding], list[Table], list[Figure]]:
    """Findings, tables and figures of recorded effects."""
    question, looks, episodes = found.question, columns_of(by), found.episodes(by)
    names = [column.name for column in looks]
    units = found.units
    summary = summary_of(episodes, units, question.sampling, names)
    items = by_item(summary, units, names)
    files = [Table("effects_summary", summary), Table("effects_episodes", episodes), Table("effects", found.rows())]
    otherwise, of_prompts = other_sentences(question, episodes, units, looks)
    if by:
        said = f"Below, a row for each {'item and ' * bool(items.height)}{' and '.join(by)}."
        _, maps = of_maps(question, units, by)
        if maps and "time" in by:
            said += " Maps of patches are not divided by time."
        columns = [*looks, *columns_of_items(items, units)] if items.height else []
        return (
            [Finding(said, "What does the action depend on?")],
            [Table("effects_items", items, columns), *maps, *of_prompts, *files],
            [],
        )
    of_patches, maps = of_maps(question, units)
    if of_patches and items.is_empty():
        return of_patches, [*maps, Table("effects_items", items), *files], []
    items = with_exchanges(question, episodes, with_untested(question, items))
    of_words = pl.col("item_kind").is_in(["word", "exchange"])
    words, others = items.filter(IS_WORD), items.filter(~of_words)
    findings = [*exchanged(question, episodes, units), *otherwise, deciding(words, units, summary)]
    findings += [*_sides(question, episodes, units), *_others(others), *ways_of_words(question, episodes, words)]
    findings += [*unlike_attention(words), *of_patches]
    course, shown = _over_time(found, items), with_noise_row(items, summary)
    columns = columns_of_items(shown, units)
    tables = [Table("effects_items", shown, columns, "Without it, the action changes by", rows=16), *files]
    figures = figures_of_items(items, course, summary, units)
    return findings, [*of_prompts, *tables, *maps, Table("effects_time", course)], figures


def deciding(words: pl.DataFrame, units: ActionUnits, summary: pl.DataFrame) -> Finding:
    """The words without which the action changes most, of the rows of `with_exchanges` that are words.

    A word that is `NOT_EXCHANGED` is none of them. summary: for what another noise seed does.
    """
    tested = words.drop_nulls("effect").sort("effect", descending=True)
    limits = [f"{plural(n, 'word')} of the instructions not tested."] if (n := words.height - tested.height) else []
    if tested.is_empty():
        return Finding("Not tested: no effect of a single word was recorded.", _MISSING, {}, " ".join(limits))
    held, few, far = (tested.filter(than_noise=kind) for kind in (NOT_EXCHANGED, FEW, MORE))
    sure = tested.filter(pl.col("than_noise").is_in([MORE, GRIPPER_MORE]))
    counted = tested.filter(pl.col("than_noise") != NOT_EXCHANGED)
    top = next(rows for rows in (far, counted, tested) if rows.height).row(0, named=True)
    size = units.said(with_interval(top, "effect"))
    noise = "" if top["noise"] is None else f" (another noise seed: {units.short(top['noise'])})"
    if far.height:
        said = f"{_without(top)} {size}{noise}."
        said += f" Also more than noise: {named_sizes(far[1:])}." if far.height > 1 else ""
    elif counted.is_empty():
        said = "No word is shown to move the action."
    elif tested["noise"].count() == 0:
        said = f"Most without {top['label']}: {size}."
        limits.insert(0, WITHOUT_NOISE)
    elif few.height < tested.height:
        said = f"No word is shown to do more than another noise seed. Most without {top['label']}: {size}{noise}."
        limits += _would_be_shown(tested, units)
    else:
        said = f"{_without(top)} {size}{noise}, in these episodes."
        said += f" Next: {named_sizes(tested[1:])}." if tested.height > 1 else ""
    said += _of_gripper(sure, summary)
    if few.height:
        limits.insert(0, f"Too few episodes to say more of {listing(few['label'], MOST_NAMED)}.")
    if sure.height and tested["exchanged"].count() and (alone := sure.filter(pl.col("exchanged").is_null())).height:
        limits.insert(0, f"Only left out; no other word was tried in its place: {listing(alone['label'], MOST_NAMED)}.")
    if held.height:
        pairs = [
            f"{row['label']} ({row['effect']:.2g}; exchanged {small_size(row['exchanged'])})" for row in held.to_dicts()
        ]
        limits.insert(0, f"Not counted, since another word in its place is not shown to do anything: "
                         f"{listing(pairs, MOST_NAMED)}.")  # fmt: skip
    numbers = {"word": top["item"], "estimate": top["effect"], "low": top["effect_low"], "high": top["effect_high"],
               "noise": top["noise"], "shown": sure.height, "tested": tested.height}  # fmt: skip
    return Finding(said, _MISSING, numbers, " ".join(limits))


def _would_be_shown(words: pl.DataFrame, units: ActionUnits) -> list[str]:
    """How large the effect of a word must be so that 80 % of runs of this size show it, of the median word."""
    times, noise = (words[name].drop_nulls() for name in ("detectable", "noise"))
    middle, beside = (one.median() if len(one) else None for one in (times, noise))
    if not isinstance(middle, float) or not isinstance(beside, float):
        return []
    if middle > _MOST_TIMES:
        return ["A run of this size shows the effect of hardly any word: record more episodes."]
    size = units.said(f"{beside * math.exp(middle):.2g}")
    return [f"In 80% of runs of this size a word is shown without which {size}."]


def _without(row: Mapping[str, Any]) -> str:
    return f"{'Without' if row['reader'] == 'total' else 'Hidden from the action tokens,'} {row['label']}"


def _of_gripper(words: pl.DataFrame, summary: pl.DataFrame) -> str:
    """The words without which the gripper's command is shown to flip more often than with other noise."""
    if "gripper" not in words.columns:
        return ""
    sure = words.filter(gripper_flips("gripper_q")).sort("gripper")
    if sure.is_empty():
        return ""
    noise = summary.filter(kind="noise")["gripper"].drop_nulls().to_list()
    beside = f" (another noise seed: {noise[0]:.0%})" if noise else ""
    named = [f"{row['label']} in {row['gripper']:.0%}" for row in reversed(sure.to_dicts())]
    return f" The gripper command flips without {listing(named, MOST_NAMED)} of the steps{beside}."


def _sides(question: Question, episodes: pl.DataFrame, units: ActionUnits) -> list[Finding]:
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
    said = f"Without all pictures {units.said(with_interval(one, 'pictures'))}, without all text "
    said += f"{with_interval(one, 'text')}: {with_interval(one, 'ratio')} times as much."
    numbers = {"estimate": one["ratio"], "low": one["ratio_low"], "high": one["ratio_high"], "n": one["num_episodes"]}
    return [Finding(said, "Pictures or text?", numbers, enough(question))]


def _others(items: pl.DataFrame) -> list[Finding]:
    """Pictures, parts, objects and exchanges that are shown to exceed another noise seed, and those below it."""
    items = items.filter(pl.col("than_noise") != NO_NOISE)
    if items.is_empty():
        return []
    kinds = [items.filter(than_noise=kind) for kind in (MORE, GRIPPER_MORE, LESS)]
    sure, flips, less = kinds
    rest = items.height - sum(kind.height for kind in kinds)
    sizes = ((sure, "More than with another noise seed", "effect"), (flips, "The gripper alone", "gripper"),
             (less, "Less than with another noise seed", "effect"))  # fmt: skip
    parts = [f"{said}: {_without_and_with(rows, value)}" for rows, said, value in sizes if rows.height]
    parts += [f"Not shown to be either: {plural(rest, 'other item') if parts else 'any item'}"] if rest else []
    numbers = {"shown": sure.height, "gripper": flips.height, "smaller": less.height, "open": rest}
    return [Finding(f"{'. '.join(parts)}.", "And without something else?", numbers)] if parts else []


def _without_and_with(rows: pl.DataFrame, value: str) -> str:
    left = pl.col("kind").is_in(["image", "only"])
    sides = (("without", rows.filter(~left)), ("with", rows.filter(left)))
    return "; ".join(f"{word} {named_sizes(part, value)}" for word, part in sides if part.height)


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
