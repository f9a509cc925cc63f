"""Where hands and things were, step by step, and where failed episodes left solved ones that began like them.

A path is (moment, quantity) in metres: where the hand is as seen from every named object, and these objects as seen
from one another, so that it is the same wherever on the table they lie. Episodes differ in pace: a moment is held
against the nearest one of another path at most `SLACK` steps before or after it. A path that has ended stays where it
ended.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.measure import look_at, table_of
from vla_attention.analyze.core.object_shares import ALL_CAMERAS, look_at_objects, object_times, positions_with_coverage
from vla_attention.analyze.core.word_items import items_of
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.scan import scan
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.measures.tables import EPISODE_ID
from vla_attention.schemas.episode_steps import HAND, POSES

Array = NDArray[np.float64]

#: Steps by which another episode may be ahead or behind.
SLACK = 10
#: Episodes nearer than 1 cm are together, however alike the others are.
TOGETHER = 0.01
#: An episode that is elsewhere in fewer replans than these, at its end, has not left.
FEWEST = 3
#: Solved episodes of the task whose initial states are nearest.
_TWINS = 3
#: Replans of a strip, from the one at which an episode leaves.
_SHOWN = (-1, 0, 1, 2)


_PLACES: dict[str, Any] = {
    "suite": pl.String, **dict.fromkeys(("task_id", "episode_index"), pl.Int64), "twin": pl.String,
    **dict.fromkeys(("twin_index", "replan", "twin_replan", "step", "num_solved"), pl.Int64),
    "apart": pl.Float64, "within": pl.Float64,
}  # fmt: skip
#: Of the object with most attention for its size.
LOOK = ("times", "share", "background")


@dataclass(frozen=True)
class Course:
    """The steps of an episode.

    Attributes:
        item: the episode.
        starts: (replan,) steps executed before each replan.
        path: (moment, quantity), of the things that the task names; of all if it names none.
        start: where all bodies are at the beginning, (body, 3) in metres.
    """

    item: SelectedEpisode
    starts: NDArray[np.int64]
    path: Array
    start: Array


@dataclass(frozen=True)
class Leaving:
    """A failed episode beside its twins.

    Attributes:
        item, twin: the episode, and its nearest twin.
        starts: (replan,) as in `Course`.
        apart: (replan,) how far it is from its twins, in metres.
        within: (replan,) how far twins are from one another.
        replan: from which on it is farther apart than that, to its end; None: it never is.
        num_solved: solved episodes that this is known from; 1 where the twin has the same state.
    """

    item: SelectedEpisode
    twin: SelectedEpisode
    starts: NDArray[np.int64]
    apart: Array
    within: Array
    replan: int | None
    num_solved: int


def course_of(item: SelectedEpisode) -> Course | None:
    """The steps of an episode; None where they are not known."""
    steps = item.episode.attributes.steps
    if steps is None:
        return None
    poses = item.episode.read(POSES).astype(np.float64)[..., :3]
    starts, _ = item.timing(item.episode.read("env_step").astype(np.int64))
    named = {thing.name for thing in item.episode.attributes.objects if thing.of_interest}
    things = [i for i, name in enumerate(steps.bodies) if name != HAND]
    things = [i for i in things if steps.bodies[i] in named] or things
    hand = poses[:, steps.bodies.index(HAND)]
    return Course(item, starts, path_of(hand, [poses[:, i] for i in things]), poses[0])


def leavings(
    failed: Sequence[SelectedEpisode], others: Iterable[SelectedEpisode], same_state: bool
) -> Iterator[Leaving]:
    """Each failed episode that has twins among the solved ones of `others`, beside them.

    same_state: twins have the same initial state, and one of them is enough. Else they are those of the task with the
    nearest states, of which two are needed to know how far twins are apart.
    """
    tasks = {item.task for item in failed}
    solved = [one for one in others if one.task in tasks and one.episode.attributes.success]
    for task in sorted(tasks):
        courses = [course for one in solved if one.task == task and (course := course_of(one)) is not None]
        own = [_apart(one, near) for one in courses if (near := _nearest(one, courses))]
        for item in failed:
            course = course_of(item) if item.task == task else None
            if course is None:
                continue
            state = item.episode.attributes.initial_state_digest
            alike = [one for one in courses if state and one.item.episode.attributes.initial_state_digest == state]
            near = _nearest(course, alike if same_state else courses if own else [])
            if near:
                apart = _apart(course, near)
                within = band([np.zeros(1)] if same_state else own, len(apart))
                number = 1 if same_state else len(own)
                yield Leaving(item, near[0].item, course.starts, apart, within, leaves_at(apart, within), number)


def _nearest(course: Course, others: Sequence[Course]) -> list[Course]:
    """The nearest others in whose scenes there are as many bodies and named things; with others no path compares."""

    def shape(one: Course) -> tuple[int, int]:
        return len(one.start), one.path.shape[1]

    other = [one for one in others if one is not course and shape(one) == shape(course)]
    return sorted(other, key=lambda one: float(((one.start - course.start) ** 2).sum()))[:_TWINS]


def _apart(course: Course, others: Sequence[Course]) -> Array:
    return by_replan(np.min([distance(course.path, one.path) for one in others], axis=0), course.starts)


def strip_of(one: Leaving) -> pl.DataFrame:
    """The `strip` of the failed episode, and below it of its twin, around the replan at which the first leaves."""
    items, last = (one.item, one.twin), one.item.episode.attributes.num_replans - 1
    moments = [replan for shift in _SHOWN if 0 <= (replan := (one.replan or 0) + shift) <= last]
    shown = []
    for who, item in zip(("failed", "solved"), items, strict=True):
        end = item.episode.attributes.num_replans - 1
        marks = {one.replan: ", leaves"} if item is one.item else {}
        labels = {at: f"{who}, step {int(one.starts[at])}{marks.get(at, '')}" for at in moments}
        shown.append([(at, text) if at <= end else (end, f"{who}, at its end") for at, text in labels.items()])
    return strip(items, shown)


def strip(items: Sequence[SelectedEpisode], shown: Sequence[Sequence[tuple[int, str]]]) -> pl.DataFrame:
    """Where stored pictures of episodes lie, below each other; of an episode without pictures none.

    shown: of each episode its replans, and what stands above their pictures.

    Returns:
        One row per picture: row, column, above, replan, camera.
    """
    rows: list[tuple[int, int, str, int, str]] = []
    for row, (item, moments) in enumerate(zip(items, shown, strict=True)):
        cameras = [camera.name for camera in item.store.attributes.policy.cameras]
        camera = next((name for name in cameras if item.episode.has(f"frames/{name}")), None)
        rows += [(row, column, above, at, camera) for column, (at, above) in enumerate(moments) if camera is not None]
    schema = {"row": pl.Int64, "column": pl.Int64, "above": pl.String, "replan": pl.Int64, "camera": pl.String}
    return pl.DataFrame(rows, schema=schema, orient="row")


def path_of(hand: Array, things: Sequence[Array]) -> Array:
    """The path (moment, quantity) of the hand and of things, each (moment, 3)."""
    seen = [hand - thing for thing in things] or [hand]
    seen += [other - thing for i, thing in enumerate(things) for other in things[i + 1 :]]
    return np.concatenate(seen, axis=1)


def distance(path: Array, other: Array) -> Array:
    """How far a path is from another one at each of its moments (moment,): root mean square over positions, metres."""
    at = np.arange(len(path))[:, None] + np.arange(-SLACK, SLACK + 1)
    apart = ((path[:, None] - other[at.clip(0, len(other) - 1)]) ** 2).sum(axis=2).min(axis=1)
    root: Array = np.sqrt(apart / (path.shape[1] / 3))
    return root


def by_replan(moments: Array, starts: NDArray[np.int64]) -> Array:
    """Means (replan,) of values (moment,) over the moments behind the steps that each replan executed."""
    ends = np.append(starts[1:], len(moments) - 1)
    return np.array([moments[begin + 1 : end + 1].mean() for begin, end in zip(starts, ends, strict=True)])


def band(distances: Sequence[Array], length: int) -> Array:
    """How far apart episodes are that do the same, (replan,): the largest of theirs at each replan and beside it.

    distances: (replan,) each, from one such episode to its own nearest.
    """
    held = np.stack([one[np.arange(length).clip(0, len(one) - 1)] for one in distances])
    largest = np.pad(held.max(axis=0), 1, mode="edge")
    beside: Array = np.maximum(np.max([largest[:-2], largest[1:-1], largest[2:]], axis=0), TOGETHER)
    return beside


def leaves_at(apart: Array, within: Array) -> int | None:
    """The replan from which on an episode is farther apart than `within`, each (replan,), to its end; None: never.

    Being outside in fewer than `FEWEST` last replans is no leaving.
    """
    inside = np.flatnonzero(apart <= within)
    first = int(inside[-1]) + 1 if len(inside) else 0
    return first if first + min(FEWEST, len(apart)) <= len(apart) else None


def beside(question: Question, other: Question, left: Sequence[Leaving]) -> pl.DataFrame:
    """Where each failed episode left its twins, and what both had most attention on in that replan.

    Returns:
        `EPISODE_ID`, twin, replan and step (null: it does not leave), apart and within (centimetres), num_solved;
        looked and read (the object with most attention for its size, the word with most per token), twin_looked,
        twin_read; times (attention to the object, over that of its area), share and background (parts of the attention
        to the pictures).
    """
    rows = []
    for one in left:
        at, twin = one.replan, one.twin.episode
        own = (*one.item.task, one.item.episode.attributes.episode_index, at, one.num_solved)
        row: dict[str, object] = dict(zip((*EPISODE_ID, "replan", "num_solved"), own, strict=True))
        row |= {"twin": twin.name, "twin_index": twin.attributes.episode_index}
        if at is not None:
            row |= {"step": int(one.starts[at]), "twin_replan": min(at, twin.attributes.num_replans - 1)}
            row |= {"apart": 100 * float(one.apart[at]), "within": 100 * float(one.within[at])}
        rows.append(row)
    places = pl.DataFrame(rows, schema=_PLACES)
    mine = _attention(question, [one.item for one in left if one.replan is not None])
    theirs = _attention(other, [one.twin for one in left if one.replan is not None]).drop(LOOK)
    theirs = theirs.rename({"episode_index": "twin_index"} | {n: f"twin_{n}" for n in ("replan", "looked", "read")})
    places = places.join(mine, on=[*EPISODE_ID, "replan"], how="left", maintain_order="left")
    return places.join(theirs, on=["suite", "task_id", "twin_index", "twin_replan"], how="left", maintain_order="left")


def _attention(question: Question, items: Sequence[SelectedEpisode]) -> pl.DataFrame:
    """Per replan of these episodes, what `beside` says of the attention in it."""
    place = [*EPISODE_ID, "replan"]
    schema = {**{name: _PLACES[name] for name in place}, **dict.fromkeys(("looked", "read"), pl.String)}
    found = pl.DataFrame(schema={**schema, **dict.fromkeys(LOOK, pl.Float64)})
    if not items:
        return found
    part = replace(question, selected=tuple({(item.task, item.episode.name): item for item in items}.values()))
    having = positions_with_coverage(part)
    objects = [look_at_objects(part, positions=having)] if having else []
    words, *rest = scan(part, [look_at(part, items_of), *objects])
    lifts = table_of(words, {"replan"}).filter(pl.col("kind") == "word").collect()
    most = lifts.drop_nulls("lift").sort("lift", "item", descending=[True, False])
    read = most.group_by(place, maintain_order=True).agg(read=pl.first("item"))
    if not rest:  # no object is marked in the pictures: `objects` says why
        return pl.concat([found, read], how="diagonal")
    times = object_times(rest[0]).collect()
    times = times.filter(camera=ALL_CAMERAS).with_columns(times=pl.col("share") / pl.col("even_share"))
    most = times.filter(pl.col("times").is_finite(), kind="object").sort("times", "item", descending=[True, False])
    looked = most.group_by(place, maintain_order=True).agg(
        pl.first("times", "share"), looked=pl.first("item").str.replace_all("_", " ")
    )
    background = times.filter(kind="class", item="background").select(*place, background="share")
    looked = looked.join(background, on=place, how="left")
    return looked.join(read, on=place, how="full", coalesce=True).select(found.columns)
