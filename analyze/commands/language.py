"""Does it listen? What it did when told, what the words do to its actions, and how much it attends to them.

Three levels that are never mixed: a policy may attend to words that change nothing, and may move otherwise without
doing what it was told.
"""

from __future__ import annotations

import shlex
from dataclasses import replace

import polars as pl

from vla_attention.analyze.commands.effects import word_effects
from vla_attention.analyze.commands.effects.maps import maps_where_recorded
from vla_attention.analyze.commands.words import words
from vla_attention.analyze.core.about import about, notes
from vla_attention.analyze.core.behaviour import behaviour, with_choices
from vla_attention.analyze.core.exchanged import exchanged
from vla_attention.analyze.core.listening import ASK_THE_DATA, IN_PART, LISTENS, NOT_SHOWN, listens, table_of_parts
from vla_attention.analyze.core.naming import ObjectAttention, named_in
from vla_attention.analyze.core.perturbations import any_perturbed, by_suite, perturbations
from vla_attention.analyze.core.result import Column, Finding, Result, Table
from vla_attention.analyze.measures.question import Question
from vla_attention.schemas.errors import plural
from vla_attention.schemas.safe_text import visible

#: Of a probability, and of an action in its unit (as effects are refused from there on): smaller changes are rounding.
_ROUNDING, _SAME_ACTION = 1e-6, 1e-4


def language(question: Question) -> Result:
    """What was told and what was done, effects of the words where they were recorded, attention to the words.

    Raises:
        BadArgument: the keys of the site spell no words.
    """
    asked = with_choices(behaviour(question.episodes))
    behaved = listens(asked)
    if (source := question.stores[0].attributes.rerun_of) is not None and asked.is_empty():
        said = f"A rerun executes nothing. What was done is in the run that it came from, {visible(source.name)}."
        behaved = Finding(said, LISTENS)
    if not asked.is_empty():
        failures = f"vla-attention failures {_paths(question)}" if (~asked["outcome"]).any() else ""
        is_deaf = behaved.numbers.get("verdict") in (NOT_SHOWN, IN_PART)
        behaved = replace(behaved, next_step=ASK_THE_DATA if is_deaf else failures)
    done = _behaviour_tables(asked)
    followed, matrix, pictured = exchanged(asked, question.sampling)
    by_change, changes = _perturbed(question, asked)
    reached = words_get_through(question)
    decide, effects = word_effects(question)
    named, _ = maps_where_recorded(question, only_named=True)
    read = words(question)
    missing = len(question.selected) - asked.height
    rerun = all(store.attributes.rerun_of is not None for store in question.stores)
    left = [f"What {plural(missing, 'episode')} did is not known: no simulator of ours ran them."] * (missing > 0)
    # Where only effects can answer, they come first.
    first, last = ([], [behaved]) if asked.is_empty() and effects else ([behaved], [])
    return Result(
        "Does it listen? What was told, and what was done",
        about(question),
        [*reached, *first, *by_change, *followed, *decide, *named, *read.findings[:1], *last],
        [*changes, *matrix, *(() if matrix else done[:1]), *effects, *done[1:], *read.tables[:1]],
        [*pictured, *read.figures[:1]],
        [*([] if rerun else left), *notes(question)],
    )


def _perturbed(question: Question, asked: pl.DataFrame) -> tuple[list[Finding], list[Table]]:
    """By what LIBERO-PRO changed: success, doing what was told, attention to what the task names; none without it."""
    if not any_perturbed(store.suite for store in question.stores):
        return [], []
    objects = ObjectAttention.measured_in(question)
    finding, table = perturbations(by_suite(question, asked, [] if objects is None else named_in(objects)))
    return [finding], [table]


def words_get_through(question: Question) -> list[Finding]:
    """Whether the instruction reaches the model, its attention and its action, as the first call of a process showed.

    Of several processes, the one that shows the least; none where none was looked at.
    """
    looked = [plumbing for item in question.selected if (plumbing := item.episode.attributes.plumbing) is not None]
    if not looked:
        return []
    worst = min(looked, key=lambda one: (not one.problem, one.action_changed or 0.0, one.rows_changed or 0.0))
    other = f"'{visible(worst.other)}'"
    limit, seen = "", "" if worst.rows_changed is None else ", its attention"
    if worst.problem:
        sentence = f"No, this is plumbing, not the model: {worst.problem}"
        limit = "Look at the tokenizer, the key of the data set, the prompt's template, how a batch is put together."
    elif not worst.other:
        sentence = "The prompt's tokens spell the instruction; whether they change the action was not tried"
        sentence += f": {worst.why_not.removesuffix('.')}."
    elif worst.rows_changed is not None and not worst.rows_changed > _ROUNDING:
        sentence = f"They reach the model's input and no further: told {other}, no attention that was recorded changed."
    elif not (worst.action_changed or 0.0) > _SAME_ACTION:
        sentence = f"They reach the model{seen}, and not the action: told {other}, it is the same."
    else:
        sentence = f"Yes: told {other}, the model's input{seen} and its action change."
    numbers = {"rows": worst.rows_changed, "action": worst.action_changed, "calls": len(looked)}
    return [Finding(sentence, "Do the words get through?", numbers, limit)]


def _behaviour_tables(asked: pl.DataFrame) -> list[Table]:
    """Told and did, counted, and every episode."""
    if asked.is_empty():
        return []
    nothing = pl.col("did").fill_null("no goal of the scene")
    matrix = asked.group_by("told", nothing).agg(pl.len().alias("episodes"))
    matrix = matrix.with_columns(share=pl.col("episodes") / pl.sum("episodes").over("told"))
    matrix = matrix.sort("told", "episodes", "did", descending=[False, True, False])
    result = pl.col("outcome").replace_strict({True: "solved", False: "failed"}, default="not known")
    rows = asked.with_columns(outcome=result).drop(
        "goals", "scene", "stratum", "block", "state", "own_goal", "told_goal", "as_told", "first", "scene_goal"
    )
    return [
        Table("told_and_did", matrix, _MATRIX, "Told and did", rows=20),
        *table_of_parts(asked),
        Table("told_episodes", rows.sort("suite", "task_id", "episode_index"), _EPISODES, "Episode by episode", rows=8),
    ]


_MATRIX = [
    Column("told", "text"),
    Column("did", "text", "did", "the told goal where it was reached, else the first goal that was reached"),
    Column("episodes", "count"),
    Column("share", "percent", "of those told"),
]
_EPISODES = [
    Column("told", "text"),
    Column("touched", "text", "touched first"),
    Column("touched_at", "count", "at step"),
    Column("did", "text", "goal reached"),
    Column("did_at", "count", "at step"),
    Column("before", "text", "before it", "another goal of the same kind that held earlier", screen=False),
    Column("outcome", "text"),
    Column("left_out", "text", "left out", "why the episode cannot show listening", screen=False),
]


def _paths(question: Question) -> str:
    return shlex.join(str(store.path) for store in question.stores)
