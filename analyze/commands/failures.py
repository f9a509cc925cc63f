"""Why did it fail? What failed episodes did instead, and where they left solved ones that began like them."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from typing import Any

import polars as pl

from vla_attention.analyze.core.about import about
from vla_attention.analyze.core.behaviour import OTHER_GOAL, TOLD_SO, UNFINISHED, behaviour
from vla_attention.analyze.core.camera_maps import stored_picture
from vla_attention.analyze.core.courses import LOOK, Leaving, beside, leavings, strip_of
from vla_attention.analyze.core.result import Column, Figure, Finding, Result, Table
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.measures.tables import EPISODE_ID
from vla_attention.schemas.errors import BadArgument, listing, plural
from vla_attention.schemas.safe_text import visible

_OUTCOME = ("suite", "task_id", "instruction", "solved", "num_steps")
#: Columns that only `behaviour` and joins need.
_KEYS = ("goals", "scene", "state", "as_told", "told_goal", "own_goal", "scene_goal", "twin_index", "twin_replan")
_WHY = "Why did it fail?"
_UNKNOWN = (
    "An episode is solved or failed where a simulator or the recording code says so, or vla-attention store outcomes "
    "tells it later; a replay runs nothing."
)
_WHERE = "Where did it leave the solved ones?"
_BEFORE = "What tells beforehand?"
_FEW = 10  # failures; fewer are described, one by one


def failures(question: Question, twins: Question | None = None) -> Result:
    """What failed episodes did instead, where they left solved ones, and what task and length say of the outcome.

    twins: of a store that holds episodes with the same tasks and initial states; else the solved episodes of the same
    store with the nearest initial states are held against the failed ones.

    Raises:
        BadArgument: a store is a rerun of stored calls, or no episode of `twins` is like a failed one.
    """
    for store in question.stores:
        if (source := store.attributes.rerun_of) is not None:
            raise BadArgument(
                f"{store.path} is a rerun of stored calls, nothing was executed; ask its base '{visible(source.name)}'."
            )
    known = [(*i.task, i.episode.attributes) for i in question.selected if i.episode.attributes.success is not None]
    outcomes = pl.DataFrame(
        [(suite, task, visible(one.instruction), one.success, one.num_steps) for suite, task, one in known],
        schema=dict(zip(_OUTCOME, (pl.String, pl.Int64, pl.String, pl.Boolean, pl.Int64), strict=True)),
        orient="row",
    )
    failed = [item for item in question.selected if item.episode.attributes.success is False]
    shown = behaviour(question.episodes)
    lost = shown.filter(~pl.col("outcome"))
    left = [*leavings(failed, (twins or question).selected, twins is not None)]
    if twins is not None and failed and not left:
        raise BadArgument(
            f"None of the {len(failed)} failed episodes has a twin in {listing(s.path for s in twins.stores)}: no "
            "solved episode there has the same task and initial state, as far as these are known; give one of the same "
            "suite, tasks and seed."
        )
    places = beside(question, twins or question, left)
    rows = lost.join(places, on=EPISODE_ID, how="left", maintain_order="left").drop(_KEYS)
    tables = [_instead(lost), Table("failures", rows, _FAILURES, "Failure by failure")] if lost.height else []
    where = _where(places, len(failed), twins is not None) if failed else []
    return Result(
        "Why did it fail? What was done instead",
        about(question),
        [*_why(question, failed, outcomes.height, lost), *where, *foretold(outcomes)],
        [*tables, _by_task(outcomes, bool(failed))],
        _strip(left),
        [*question.skipped, *(twins.told if twins else ())],
    )


def _instead(lost: pl.DataFrame) -> Table:
    told = pl.format("'{}'", "told").unique()
    many = pl.format("{} other things", told.len())
    several = pl.when(told.len() > 3).then(many).otherwise(told.sort().str.join(" or "))
    rows = lost.group_by("how", "did", "touched").agg(pl.len().alias("episodes"), pl.median("touched_at"), told=several)
    columns = [
        Column("how", "text", "what it did"),
        Column("did", "text", "goal reached"),
        Column("touched", "text", "touched first"),
        Column("touched_at", "number", "at step", "median over the episodes"),
        Column("episodes", "count"),
        Column("told", "text"),
    ]
    rows = rows.sort("episodes", "how", "did", "touched", descending=[True, False, False, False], nulls_last=True)
    return Table("instead", rows, columns, "What failed episodes did")


def _why(question: Question, failed: Sequence[SelectedEpisode], num_known: int, lost: pl.DataFrame) -> list[Finding]:
    if not failed:
        said = f"Nothing failed: all {num_known} episodes were solved." if num_known else "No outcome is known."
        return [Finding(said, _WHY, {"failed": 0, "n": num_known}, "" if num_known else _UNKNOWN)]
    numbers = {"failed": len(failed), "n": num_known}
    places = shlex.join(str(store.path) for store in question.stores)
    begin = f"{len(failed)} of {plural(num_known, 'episode')} failed"
    few = f"Fewer than {_FEW} failures: this describes them and says nothing of others." if len(failed) < _FEW else ""
    if lost.is_empty():
        said = f"{begin}. Nobody knows what they did: the store holds no steps (positions, touches, goals), which our "
        return [Finding(f"{said}simulators record.", _WHY, numbers, few, f"vla-attention view {places}")]
    groups = _instead(lost).shown
    parts = [_group(row) for row in groups.head(3).iter_rows(named=True)]
    parts += [f"{rest} did other things"] if (rest := groups["episodes"][3:].sum()) else []
    return [Finding(f"{begin}. {'; '.join(parts)}.", _WHY, numbers, few, f"vla-attention language {places}")]


def _group(row: dict[str, Any]) -> str:
    """How many episodes did the same, and what; of a single one, when."""
    at = f" at step {row['touched_at']:.0f}" if row["episodes"] == 1 and row["touched"] is not None else ""
    first = "touched nothing" if row["touched"] is None else f"touched the {row['touched']} first{at}"
    told, reached = f" (told {row['told']})", f" and reached the goal of '{row['did']}'"
    so, unfinished = f"{reached}, as it was told, which is not its task", f", as told, and did not finish{told}"
    then = {OTHER_GOAL: reached + told, UNFINISHED: unfinished, TOLD_SO: so}.get(row["how"], told)
    return f"{row['episodes']} {first}{then}"


def _where(places: pl.DataFrame, num_failed: int, given: bool) -> list[Finding]:
    if places.is_empty():
        said = "Not known: the tasks that failed have fewer than two solved episodes to compare with"
        return [Finding(f"{said}.", _WHERE, {}, "Give a store in which the same states are solved, as --twins.")]
    gone = places.drop_nulls("replan")
    which = "with the same initial state" if given else "of the same task with the nearest initial states"
    numbers = {"left": gone.height, "n": places.height}
    begin = f"{gone.height} of {places.height} failed episodes leave the solved ones {which}"
    if gone.is_empty():
        return [Finding(f"{begin}; to the end they are as near as those are.", _WHERE, numbers)]
    row = gone.row(0, named=True)
    than = "1 cm" if given else f"they are from each other ({row['within']:.1f} cm)"
    said = f"Episode {row['episode_index']} of task {row['task_id']} does at step {row['step']}: from there on its hand"
    said += f" is {row['apart']:.1f} cm from theirs, more than {than}"
    if row["looked"] and row["twin_looked"]:
        numbers |= {name: row[name] for name in LOOK}
        rest = "" if row["background"] is None else f", the background {row['background']:.0%}"
        said += f". For its size the {row['looked']} gets most attention then ({row['times']:.2g} times what its area "
        said += f"gives; {row['share']:.0%} of the attention to the pictures{rest}), "
        said += "in both" if row["looked"] == row["twin_looked"] else f"of the solved one the {row['twin_looked']}"
    alone = num_failed - places.height
    limit = f"{plural(alone, 'failed episode')} had none to compare with. " if alone else ""
    limit += "" if given else f"By chance alone one of {row['num_solved'] + 1} episodes would be the farthest. "
    limit += "Where an episode begins to differ is not yet what made it differ."
    return [Finding(f"{begin}. {said}.", _WHERE, numbers, limit)]


def foretold(outcomes: pl.DataFrame) -> list[Finding]:
    """What the task alone says of the outcome, guessed from the task's other episodes, beside always one guess."""
    task, solved = ["suite", "task_id"], pl.col("solved").cast(pl.Int64)
    rest, of = solved.sum().over(task) - solved, pl.len().over(task) - 1
    guess = pl.when(2 * rest == of).then(0.5).otherwise(((2 * rest > of) == pl.col("solved")).cast(pl.Float64))
    frame = outcomes.select("solved", "num_steps", of=of, right=guess).filter(pl.col("of") > 0)
    if frame["solved"].n_unique() < 2:
        return []
    right, n, solved_ones = float(frame["right"].sum()), frame.height, int(frame["solved"].sum())
    always = max(solved_ones, n - solved_ones)
    said = f"Knowing the task alone predicts {right:g} of {n} outcomes (always the more frequent guess: {always})"
    steps = frame["num_steps"].to_list()
    if min(steps):  # 0 where a loop that is not ours did not say it
        lost, won = (frame.filter(pl.col("solved") == solved)["num_steps"] == max(steps) for solved in (False, True))
        said += f"; {lost.sum()} of {len(lost)} failures and {won.sum()} of {len(won)} solved episodes lasted the most "
        said += f"steps of all ({max(steps)})"
    return [Finding(f"{said}.", _BEFORE, {"right": right, "n": n, "solved": solved_ones})]


def _by_task(outcomes: pl.DataFrame, shown: bool) -> Table:
    tasks = outcomes.group_by("suite", "task_id", "instruction").agg(
        pl.len().alias("episodes"),
        failed=(~pl.col("solved")).sum(),
        steps=pl.col("num_steps").filter("solved", pl.col("num_steps") > 0).median(),
    )
    columns = [
        Column("task_id", "count", "task"),
        Column("instruction", "text"),
        Column("failed", "count"),
        Column("episodes", "count", "of"),
        Column("steps", "number", "steps if solved", "median"),
    ]
    order = tasks.sort("failed", "suite", "task_id", descending=[True, False, False])
    return Table("failures_by_task", order, columns if shown else (), "Task by task")


def _strip(left: Sequence[Leaving]) -> list[Figure]:
    """Pictures of the first episode that leaves, above those of its twin, around the replan at which it does."""
    gone = next((one for one in left if one.replan is not None), None)
    if gone is None or (rows := strip_of(gone)).is_empty():
        return []
    title = f"'{visible(gone.item.episode.attributes.instruction)}': a failed episode, a solved one that began like it"
    look = {"picture": lambda a: stored_picture((gone.item, gone.twin)[a["row"]], a["camera"], a["replan"])}
    return [Figure("failure", "pictures", rows, title, options=look)]


_FAILURES = [
    Column("task_id", "count", "task"),
    Column("episode_index", "count", "episode"),
    Column("told", "text"),
    Column("touched", "text", "touched first"),
    Column("touched_at", "count", "at step"),
    Column("did", "text", "goal reached"),
    Column("step", "count", "leaves at", "step from which on the hand is farther off than solved episodes are"),
    Column("looked", "text", "looks at", "the object with most attention for its size, in that call of the policy"),
    Column("twin_looked", "text", "solved: looks at"),
    Column("read", "text", "reads", "the word with most attention per token", screen=False),
]
