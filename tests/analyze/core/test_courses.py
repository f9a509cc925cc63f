"""Paths, how far apart they are, and which solved episodes are held against a failed one, against loops."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from msgspec import structs

from tests.kit.questions import question_about
from tests.kit.stores import StoreSpec, small_steps, write_store
from vla_attention.analyze.core.courses import (
    SLACK,
    TOGETHER,
    by_replan,
    course_of,
    distance,
    leavings,
    path_of,
    strip_of,
)

#: The even ones of the episodes fail.
EPISODES, REPLANS = 8, 4
SPEC = StoreSpec(
    tasks=(0,), episodes=EPISODES, replans=REPLANS, layers=(0,), heads=(0,), denoise_steps=(9,), coverage=False
)


def walks(spec, task, episode, steps):
    """Hand, the two named objects and a cabinet wander by centimetres, from places of the episode."""
    made = small_steps(spec, task, episode, steps)
    generator = np.random.default_rng([7, episode])
    bodies = (*made.attributes.bodies, "wooden_cabinet_1")
    poses = np.ones((steps + 1, len(bodies), 7), np.float32) / 2
    start = generator.uniform(-0.2, 0.2, (len(bodies), 3))
    poses[..., :3] = start + np.cumsum(generator.normal(0, 0.01, (steps + 1, len(bodies), 3)), axis=0)
    known = structs.replace(made.attributes, bodies=bodies, first_touch=(None,) * len(bodies))
    return replace(made, attributes=known, poses=poses)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("courses") / "a.zarr", spec=replace(SPEC, plant_steps=walks))


@pytest.fixture(scope="module")
def selected(store):
    return question_about(store).selected


def raw(store: Path, episode: int) -> tuple[np.ndarray, list[int], list[str]]:
    """Places (moment, body, 3), the steps before each replan, and the bodies' names."""
    group = zarr.open_group(store, mode="r")[f"episodes/task000_episode{episode:03d}"]
    attributes = dict(group.attrs)
    return group["steps/poses"][:, :, :3].astype(float), [5 * i for i in range(REPLANS)], attributes["steps"]["bodies"]


def named_path(store: Path, episode: int) -> list[np.ndarray]:
    """At each moment the hand as seen from bowl and plate, and these from one another."""
    poses, _, bodies = raw(store, episode)
    hand, bowl, plate = (poses[:, bodies.index(name)] for name in ("hand", "akita_black_bowl_1", "plate_1"))
    return [np.stack([hand[t] - bowl[t], hand[t] - plate[t], plate[t] - bowl[t]]) for t in range(len(hand))]


def apart(one: list[np.ndarray], other: list[np.ndarray]) -> list[float]:
    """At each moment the root mean square distance of the nearest moment within the slack; a path stays at its end."""
    found = []
    for moment, place in enumerate(one):
        near = [other[min(max(moment + shift, 0), len(other) - 1)] for shift in range(-SLACK, SLACK + 1)]
        found.append(min(np.sqrt(np.mean([np.sum((a - b) ** 2) for a, b in zip(place, there)])) for there in near))  # noqa: B905
    return found


def of_replans(values: list[float], starts: list[int]) -> list[float]:
    """Means over the moments that the steps of each replan led to."""
    ends = [*starts[1:], len(values) - 1]
    return [np.mean([values[step + 1] for step in range(begin, end)]) for begin, end in zip(starts, ends, strict=True)]


def test_a_path_is_of_the_things_that_the_task_names(store, selected):
    item = selected[3]
    course, path = course_of(item), named_path(store, 3)
    poses, starts, _ = raw(store, 3)
    assert course.starts.tolist() == starts
    np.testing.assert_allclose(course.start, poses[0])
    for own, place in zip(course.path, path, strict=True):
        assert sorted(np.abs(own)) == pytest.approx(sorted(np.abs(place).ravel()))


def test_a_failed_episode_is_held_against_the_three_that_began_nearest(store, selected):
    paths = {episode: named_path(store, episode) for episode in range(EPISODES)}
    begins = {episode: raw(store, episode)[0][0] for episode in range(EPISODES)}
    starts = raw(store, 0)[1]

    def nearest(episode: int) -> list[int]:
        others = [other for other in range(1, EPISODES, 2) if other != episode]
        return sorted(others, key=lambda other: np.sum((begins[other] - begins[episode]) ** 2))[:3]

    def from_nearest(episode: int) -> list[float]:
        together = [apart(paths[episode], paths[other]) for other in nearest(episode)]
        return of_replans([min(at) for at in zip(*together, strict=True)], starts)

    found = list(leavings([one for one in selected if not one.episode.attributes.success], selected, same_state=False))
    assert [one.item.episode.attributes.episode_index for one in found] == [0, 2, 4, 6]
    solved = [from_nearest(episode) for episode in range(1, EPISODES, 2)]
    largest = np.max(solved, axis=0)
    within = [max(*largest[max(0, i - 1) : i + 2], TOGETHER) for i in range(len(largest))]
    for one in found:
        episode = one.item.episode.attributes.episode_index
        assert one.twin.episode.attributes.episode_index == nearest(episode)[0]
        assert one.num_solved == 4
        assert one.apart == pytest.approx(from_nearest(episode))
        assert one.within == pytest.approx(within)


def test_the_strip_shows_both_around_the_replan_at_which_one_leaves(store, selected):
    (one, *_) = leavings([selected[0]], selected, same_state=False)
    strip = strip_of(replace(one, replan=2))
    assert strip.select("row", "column", "replan").rows() == [
        (row, column, replan) for row in (0, 1) for column, replan in enumerate((1, 2, 3))
    ]


def test_distances_and_means_of_unequal_lengths():
    generator = np.random.default_rng(1)
    hand, things = generator.normal(size=(30, 3)), generator.normal(size=(3, 30, 3))
    one, other = path_of(hand, list(things)), path_of(hand[:17] + 0.3, list(things[:, :17]))
    assert one.shape == (30, 3 * (3 + 3))
    both = [[moment.reshape(-1, 3) for moment in path] for path in (one, other)]
    for first, second in ((0, 1), (1, 0)):
        found = distance((one, other)[first], (one, other)[second])
        assert found == pytest.approx(apart(both[first], both[second]))
    values, starts = generator.normal(size=12), np.array([0, 4, 5])
    assert by_replan(values, starts) == pytest.approx(of_replans(values.tolist(), starts.tolist()))
