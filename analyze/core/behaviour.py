"""What the policy was told and what it did, episode by episode, from the episodes' attributes alone.

A goal is known by its conditions: two tasks with the same ones have one goal. A scene is the set of goals that the
simulator watched; episodes with the same set could have been told each other's tasks.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import polars as pl

from vla_attention.analyze.stores.contents import read_one_by_one
from vla_attention.analyze.stores.run_notes import same_words, told_instruction
from vla_attention.schemas.episode_steps import EpisodeSteps, TaskGoal
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import EpisodeAttributes

_TEXTS = (
    "suite", "instruction", "told", "told_goal", "own_goal", "family", "scene", "state", "touched", "did", "before",
    "how",
)  # fmt: skip
SCHEMA: dict[str, Any] = {
    **dict.fromkeys(_TEXTS, pl.String),
    **dict.fromkeys(("scene_instruction", "scene_goal"), pl.String),
    **dict.fromkeys(("task_id", "episode_index", "num_steps", "touched_at", "did_at", "scene_task_id"), pl.Int64),
    "outcome": pl.Boolean,
    **dict.fromkeys(("as_told", "followed"), pl.Boolean),
    "goals": pl.List(pl.Struct({"goal": pl.String, "instruction": pl.String, "held": pl.Int64})),
}
OTHER_GOAL, OTHER_TOUCH, NO_TOUCH = "reached another goal", "touched something else first", "touched nothing"
UNFINISHED, TOLD_SO = "touched what the task names, did not finish", "did what it was told, not its task"
#: Why an episode cannot show whether the policy listens.
_NO_GOAL = "the told sentence names no goal of the scene"
_AT_START = "the told goal held at the beginning of an episode"
_PART = "the told goal is a part of another told goal"
ALONE = "nothing else was told in the scene"
#: Between the conditions of a goal, in its key; no condition has one.
_AND = "\x1f"


def behaviour(episodes: Iterable[tuple[Store, StoredEpisode]]) -> pl.DataFrame:
    """One row per episode whose steps are known and that was run: a rerun of stored calls did nothing of its own.

    Returns:
        suite, task_id, episode_index
        instruction, own_goal      of its task; the goal is a key that is the same for tasks with the same goal
        told, told_goal            the sentence that the policy was given, and the goal of the scene that it names;
                                   null where it names none
        family                     the task's sentence template; empty where none is known
        scene, state               keys of the watched goals and of the initial state
        outcome, num_steps         success (null: not known) and executed actions
        touched, touched_at        the body that the gripper touched first, and the step; null: none
        did, did_at                instruction of the goal that it reached, see `_done`, and the step; null: none
        as_told                    whether that is the told goal, whichever words name it
        how                        what it did, if its task was not solved: a sentence without its subject
        before                     a goal like the told one that held before the told one was reached; null: none
        goals                      of the scene: goal, instruction, held (step at which it first held; null: never)
        scene_task_id, scene_instruction, scene_goal
                                   in an exchange, the task whose scene and initial state it began with; else null
        followed                   in an exchange, see `_followed`; else null
    """
    pairs = [(store, episode) for store, episode in episodes if store.attributes.rerun_of is None]
    opened = read_one_by_one(episode for _, episode in pairs)
    rows = [
        row_of(store.suite, one.attributes, told_instruction(store, one.attributes), one.attributes.steps, _same(store))
        for (store, _), one in zip(pairs, opened, strict=True)
        if one.attributes.steps is not None
    ]
    return pl.DataFrame(rows, schema=SCHEMA)


def _same(store: Store) -> bool:
    """Whether other words were used for the task's own goal."""
    change = store.attributes.interventions.prompt
    return change is not None and change.kind == "synonyms"


def row_of(
    suite: str, attributes: EpisodeAttributes, told: str, steps: EpisodeSteps, same: bool = False
) -> dict[str, object]:
    """The row of `behaviour` of one episode that was told a sentence; `same`: with other words for its own goal."""
    own = steps.goal_of(attributes.task_id)
    aim = told_goal(attributes, steps, told, same)
    done, before = _done(steps.goals, aim, attributes.task_family)
    touched = steps.touched[0] if steps.touched else None
    touched_at = None if touched is None else steps.first_touch[steps.bodies.index(touched)]
    named = touched in named_things(attributes, aim)
    # Who pushes what is named has touched it, and may have reached the goal of touching it.
    elsewhere = done is not None and not (named and done.first_held == touched_at)
    told_so = done is not None and aim is not None and key_of(done) == key_of(aim)
    reasons = (
        (told_so, TOLD_SO), (elsewhere, OTHER_GOAL), (touched is None, NO_TOUCH), (named, UNFINISHED),
        (True, OTHER_TOUCH),
    )  # fmt: skip
    how = next(reason for holds, reason in reasons if holds)
    scene = None if attributes.scene_task_id is None else steps.goal_of(attributes.scene_task_id)
    return {
        "suite": suite,
        "task_id": attributes.task_id,
        "episode_index": attributes.episode_index,
        "instruction": visible(attributes.instruction),
        "told": visible(told),
        "told_goal": None if aim is None else key_of(aim),
        "own_goal": None if own is None else key_of(own),
        "family": attributes.task_family,
        "scene": "\n".join(sorted({key_of(goal) for goal in steps.goals})),
        "state": attributes.initial_state_digest or f"not known: {attributes.task_id}/{attributes.episode_index}",
        "outcome": attributes.success,
        "num_steps": attributes.num_steps,
        "touched": None if touched is None else visible(touched.replace("_", " ")),
        "touched_at": touched_at,
        "did": None if done is None else visible(done.instruction),
        "did_at": None if done is None else done.first_held,
        "as_told": told_so,
        "how": None if attributes.success else how,
        "before": None if before is None else visible(before.instruction),
        "scene_task_id": attributes.scene_task_id,
        "scene_instruction": None if scene is None else visible(scene.instruction),
        "scene_goal": None if scene is None else key_of(scene),
        "followed": None if scene is None else _followed(attributes, scene, touched, told_so),
        "goals": [
            {"goal": key_of(goal), "instruction": visible(goal.instruction), "held": goal.first_held}
            for goal in steps.goals
        ],
    }


def _followed(attributes: EpisodeAttributes, scene: TaskGoal, touched: str | None, told_so: bool) -> bool | None:
    """Whether it turned to what it was told about: reached the told goal, or first touched a thing of it alone.

    None where that cannot be seen: told sentence and scene's own name the same things, or it touched one of both.
    """
    named = named_things(attributes, None)
    if named == {*scene.things}:
        return None
    return True if told_so else None if touched in named & {*scene.things} else touched in named


class Verdict(NamedTuple):
    """What an episode came to, in a line; and whether it did or touched something else than it was told."""

    sentence: str
    other: bool = False


def verdict(store: Store, attributes: EpisodeAttributes) -> Verdict:
    """As ``Failed: told 'touch the red cube', touched blue cube first (step 17).``"""
    if store.attributes.rerun_of is not None:
        return Verdict("Outcome not run: the policy calls of another run were made again, and nothing was executed.")
    told, steps = told_instruction(store, attributes), attributes.steps
    begin = {True: "Solved", False: "Failed", None: "Outcome not known"}[attributes.success]
    begin += f": told '{visible(told)}'"
    if steps is None:
        return Verdict(f"{begin}, {attributes.num_steps} steps." if attributes.num_steps else f"{begin}.")
    if attributes.success:
        return Verdict(f"{begin}, done after {attributes.num_steps} steps.")
    row = row_of(store.suite, attributes, told, steps, _same(store))
    if row["how"] == TOLD_SO:
        task = visible(attributes.instruction)
        return Verdict(f"Failed the task '{task}': told '{visible(told)}', did that (step {row['did_at']}).")
    did, touched = f"'{row['did']}' (step {row['did_at']})", f"{row['touched']} first (step {row['touched_at']})"
    came_to = {
        OTHER_GOAL: f"did {did}",
        OTHER_TOUCH: f"touched {touched}",
        UNFINISHED: f"touched {touched}, did not finish",
        NO_TOUCH: NO_TOUCH,
    }
    return Verdict(f"{begin}, {came_to[str(row['how'])]}.", row["how"] in (OTHER_GOAL, OTHER_TOUCH))


def told_goal(attributes: EpisodeAttributes, steps: EpisodeSteps, told: str, same: bool = False) -> TaskGoal | None:
    """The goal of the scene that a sentence names; `same`: it is the task's own in other words. None: it names none."""
    own = steps.goal_of(attributes.task_id)
    if own is not None and (same or same_words(told, attributes.instruction)):
        return own
    return next((goal for goal in steps.goals if same_words(goal.instruction, told)), None)


def named_things(attributes: EpisodeAttributes, aim: TaskGoal | None) -> set[str]:
    """The objects that the policy was told about; none where it was told another sentence and nobody knows them.

    aim: of `told_goal`; None: the sentence is the task's own, as far as anybody knows.
    """
    if aim is None or aim.task_id == attributes.task_id:
        return {thing.name for thing in attributes.objects if thing.of_interest}
    return {*aim.things}


def key_of(goal: TaskGoal) -> str:
    """What goals with the same conditions share."""
    return _AND.join(sorted(set(goal.conditions)))


def is_part(goal: str, other: str) -> bool:
    """Whether whoever reaches the other goal has reached this one on the way; goals by `key_of`."""
    return set(goal.split(_AND)) < set(other.split(_AND))


def _done(goals: Iterable[TaskGoal], aim: TaskGoal | None, family: str) -> tuple[TaskGoal | None, TaskGoal | None]:
    """The goal that was reached, and one like the told goal that held before it.

    The told goal where it was reached; else the first goal of the told sentence's template that was; else the first of
    all. A goal that held at the beginning, or is part of the told one or of another that was reached, is not counted.
    """
    held = [goal for goal in goals if goal.first_held]
    whole = [*held, *([aim] if aim is not None else [])]
    held = [goal for goal in held if not any(is_part(key_of(goal), key_of(other)) for other in whole)]
    held.sort(key=lambda goal: (goal.first_held or 0, key_of(goal)))
    alike = [goal for goal in held if _fits(goal.instruction, family)]
    reached = None if aim is None else next((goal for goal in held if key_of(goal) == key_of(aim)), None)
    if reached is None:
        return next(iter([*alike, *held]), None), None
    before = alike[0] if alike and (alike[0].first_held or 0) < (reached.first_held or 0) else None
    return reached, before


def _fits(instruction: str, family: str) -> bool:
    """Whether a sentence fits a template, in which capitals stand for words: "touch the COLOUR cube"."""
    pattern = "".join(".+" if part.isupper() else re.escape(part) for part in re.split(r"\b([A-Z]+)\b", family))
    return bool(family) and re.fullmatch(pattern, instruction) is not None


def with_choices(frame: pl.DataFrame) -> pl.DataFrame:
    """The rows of `behaviour` with what tells listening from not.

    Instructions are shuffled within a stratum: the episodes of one scene that were told sentences of one template;
    those of templates with one told goal share one. An episode ends when its task is done, so that what comes later is
    not seen: what counts is which of the stratum's told goals held first, and that is the same whatever was told.

    In a block only the words say what to do: it is a stratum, where every state was told everything equally often, else
    the stratum's episodes of one initial state, as a picture that one task has alone says what to do, too.

    Returns:
        further columns: stratum; first (of the stratum's told goals, the one reached first; null: none, or several
        at once); left_out (why the episode shows nothing; null: it does); block.
    """
    of_kind = pl.col("told_goal").n_unique().over("suite", "scene", "family")
    kind = pl.when((pl.col("family") != "") & (of_kind > 1)).then("family").otherwise(pl.lit(""))
    frame = frame.with_columns(stratum=pl.concat_str(["suite", "scene", kind], separator="\t"))
    parts = [_of_stratum(part) for part in frame.partition_by("stratum", maintain_order=True)]
    empty = frame.clear().with_columns(pl.lit(None, pl.String).alias(name) for name in ("first", "left_out", "block"))
    return pl.concat([empty, *parts])


def _of_stratum(part: pl.DataFrame) -> pl.DataFrame:
    episode = ["suite", "task_id", "episode_index"]
    goals = part.select(*episode, "goals").explode("goals").unnest("goals")
    told = {*part["told_goal"].drop_nulls(), *part["own_goal"].drop_nulls()}
    begun = told & {*goals.filter(held=0)["goal"]}
    parts = {one for one in told if any(is_part(one, other) for other in told)}
    held = goals.filter(pl.col("goal").is_in([*(told - begun - parts)])).group_by(*episode, "goal").agg(pl.min("held"))
    earliest = held.drop_nulls("held").filter(pl.col("held") == pl.min("held").over(episode))
    first = earliest.group_by(episode).agg(first=pl.when(pl.len() == 1).then(pl.first("goal")))
    left_out = (
        pl.when(pl.col("told_goal").is_null())
        .then(pl.lit(_NO_GOAL))
        .when(pl.col("told_goal").is_in([*begun]))
        .then(pl.lit(_AT_START))
        .when(pl.col("told_goal").is_in([*parts]))
        .then(pl.lit(_PART))
    )
    part = part.join(first, on=episode, how="left", maintain_order="left").with_columns(left_out=left_out)
    left = part.filter(pl.col("left_out").is_null())
    crossed = left.group_by("state", "told_goal").len()
    of_state, of_goal = (pl.sum("len").over(column) for column in ("state", "told_goal"))
    # With as many of all pairs as the state's and the goal's own numbers give, the state says nothing of the goal.
    even = crossed.select((pl.col("len") * left.height == of_state * of_goal).all()).item()
    even = even and crossed.height == crossed["state"].n_unique() * crossed["told_goal"].n_unique()
    part = part.with_columns(block="stratum" if even else pl.concat_str(["stratum", "state"], separator="\t"))
    alone = left["told_goal"].n_unique() == 1
    return part.with_columns(pl.coalesce("left_out", pl.lit(ALONE)).alias("left_out")) if alone else part
