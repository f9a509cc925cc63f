"""Other sentences by what they are to the task's own: how far they move the action, and towards what."""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from vla_attention.analyze.commands.effects.items import MORE, WITHOUT_NOISE, beside_noise
from vla_attention.analyze.core.about import with_interval
from vla_attention.analyze.core.action_changes import ActionUnits
from vla_attention.analyze.core.directions import directions, things_of_sentences
from vla_attention.analyze.core.estimate import estimate
from vla_attention.analyze.core.result import Column, Finding, Table
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.tables import EPISODE_ID
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.schemas.errors import listing, plural

#: All kinds of sentences that name another thing.
_ANY = "any of these"


def other_sentences(
    question: Question, episodes: pl.DataFrame, units: ActionUnits, looks: Sequence[Column] = ()
) -> tuple[list[Finding], list[Table]]:
    """How far each kind of sentence moves the action beside another noise seed, and whether towards what it names.

    episodes: as `RecordedEffects.episodes` gives them. looks: columns that tell cells apart; then there is no finding.
    """
    cells = [column.name for column in looks]
    rows = episodes.filter(kind="prompt").with_columns(sentence=pl.col("item_kind").replace("exchange", "exchanged"))
    if not {*rows["sentence"]} - {"exchanged"}:  # single words are items like others
        return [], []
    found = beside_noise(rows, [*cells, "sentence"], question.sampling, cells)
    found = found.sort(*cells, "effect", descending=[*(False for _ in cells), True])
    shown = [*looks, *_columns(units)]
    table = Table("effects_prompts", found, shown, "Told something else, the action changes by")
    if looks:
        return [], [table]
    towards, where = _towards(question, units)
    return [_moves(found, units), *towards], [table, *where]


def _moves(found: pl.DataFrame, units: ActionUnits) -> Finding:
    sure, has_noise = found.filter(than_noise=MORE), found["over_noise"].count() > 0
    size, unit = ("over_noise", "times as much as another noise seed") if has_noise else ("effect", units.title)
    sizes = dict(found.drop_nulls(size).select("sentence", size).iter_rows())
    if sure.height:
        said = "Another sentence moves the action"
    elif has_noise:
        said = "No other sentence is shown to move the action"
    else:
        said = "Told otherwise, the action changes"
    said += f": {listing([f'{kind} {value:.3g}' for kind, value in sizes.items()], 7)} {unit}."
    limit = "" if has_noise else WITHOUT_NOISE
    limit = f"Shown to be more than noise: {listing(sure['sentence'], 7)}." if sure.height else limit
    return Finding(said, "Does another sentence move it?", sizes | {"n": found["num_episodes"].max()}, limit)


def _towards(question: Question, units: ActionUnits) -> tuple[list[Finding], list[Table]]:
    if units.centimetres is None:
        return [], []
    names_of = things_of_sentences(question.stores, question.settings.skip_corrupt)
    rows, unknown = directions(question.selected, names_of, units.centimetres / 100)
    if rows.is_empty():
        return [], []
    names = ("changed", "unchanged", "closer")
    rows = pl.concat([rows, rows.with_columns(sentence=pl.lit(_ANY))]).with_columns(pl.col(*names) * 100)  # in cm
    rows = rows.group_by(*EPISODE_ID, "sentence", maintain_order=True).agg(pl.mean(*names))
    found = estimate(rows, ["sentence"], dict.fromkeys(names, "plain"), question.sampling, {"closer": 0.0})
    row = found.row(by_predicate=pl.col("sentence") == _ANY, named=True)
    sure = row["closer_q"] is not None and row["closer_q"] <= NAMED_AT and row["closer"] > 0
    said = f"{'Told' if sure else 'Not shown to go where the words say: told'} of another thing, the next steps go "
    said += f"{with_interval(row, 'changed')} cm closer to it (unchanged: {row['unchanged']:.2g} cm)."
    numbers = {"estimate": row["closer"], "low": row["closer_low"], "high": row["closer_high"], "q": row["closer_q"],
               "n": row["num_episodes"], "left_out": unknown}  # fmt: skip
    left = f"{plural(unknown, 'sentence')} left out: they are no task's, or name several things."
    table = Table("effects_directions", found, _DIRECTIONS, "Told of another thing, the next steps go")
    return [Finding(said, "Towards what the words name?", numbers, left if unknown else "")], [table]


def _columns(units: ActionUnits) -> list[Column]:
    return [
        Column("sentence", "text", "told", "what the sentence is to the task's own"),
        Column("effect", "number", units.title, units.said("so much")),
        Column("over_noise", "factor", "times noise", "that, over how far another noise seed moves it"),
        Column("than_noise", "text", "than noise", "whether that is shown to be more than another noise seed does"),
        Column("noise", "number", "another noise", screen=False),
        Column("num_episodes", "count", "episodes"),
    ]


_DIRECTIONS = [
    Column("sentence", "text", "told"),
    Column("changed", "signed", "cm closer", "to the thing that the words name, summed over the executed steps"),
    Column("unchanged", "signed", "unchanged", "the same of the call with the task's own sentence"),
    Column("closer", "signed", "difference"),
    Column("closer_q", "p", "q", "p of no difference, adjusted for the number of rows"),
    Column("num_episodes", "count", "episodes"),
]
