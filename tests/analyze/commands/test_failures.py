"""`failures`: what was done instead, and where failed episodes leave solved ones, on planted truths."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

import vla_attention as va
from tests.kit.archives import example_store
from tests.kit.made_up_behaviour import COLOURS, did, goals_of
from tests.kit.questions import question_about
from tests.kit.stores import StoreSpec, rerun_source, small_steps, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.commands.failures import failures, foretold
from vla_attention.analyze.core.behaviour import NO_TOUCH, OTHER_GOAL, OTHER_TOUCH, TOLD_SO, UNFINISHED
from vla_attention.analyze.core.camera_maps import upright
from vla_attention.analyze.core.courses import FEWEST, TOGETHER, band, by_replan, distance, leaves_at, path_of
from vla_attention.analyze.render.figures import draw
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.reader import open_store

REPLANS, TURN = 8, 3
SPEC = StoreSpec(tasks=(0, 1), episodes=6, replans=REPLANS, layers=(0,), heads=(0,), denoise_steps=(9,))
PAIR = [example_store(name) for name in ("cubes_one_colour", "cubes")]


def turning(spec, task, episode, steps, turns=True, spread=0.001):
    """Hands that go straight to the first object; those of failed episodes (even ones) turn away at one replan."""
    made = small_steps(spec, task, episode, steps)
    generator = np.random.default_rng([task, episode, 3])
    poses = made.poses.copy()
    place = generator.uniform(-0.1, 0.1, 3)
    poses[:, 1:, :3] = (place + 0.1 * np.arange(1, made.poses.shape[1])[:, None])[None]
    away = np.linspace(0.3, 0.0, steps + 1)[:, None] * np.array([1.0, 0.0, 0.0])
    poses[:, 0, :3] = poses[:, 1, :3] + away + generator.normal(0, spread, (steps + 1, 3))
    if turns and not spec.plant_success(task, episode):
        turn = TURN * steps // REPLANS
        poses[turn:, 0, 1] += 0.05 * np.arange(steps + 1 - turn)
    return replace(made, poses=poses.astype(np.float32))


def odd(task, episode):
    return episode % 2 == 1


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    spec = replace(SPEC, plant_steps=turning, plant_success=odd)
    return write_store(tmp_path_factory.mktemp("failures") / "a.zarr", spec=spec)


def test_the_planted_moment_is_found(planted):
    found = failures(question_about(planted))
    assert found["failures"]["replan"].is_between(TURN - 1, TURN + 1).all()
    assert found["failures"].height == 6
    assert (found.findings[1].numbers["left"], found.findings[1].numbers["n"]) == (6, 6)
    assert (found["failures"]["apart"] > found["failures"]["within"]).all()
    assert found["failures"].select("looked", "read", "twin_looked", "twin_read").null_count().sum_horizontal()[0] == 0


def test_a_failed_episode_whose_hand_does_as_those_of_solved_ones_does_not_leave(tmp_path):
    spec = replace(SPEC, plant_success=odd, plant_steps=partial(turning, turns=False, spread=0.03))
    found = failures(question_about(write_store(tmp_path / "a.zarr", spec=spec)))
    assert found.findings[1].numbers == {"left": 0, "n": 6}


def test_a_store_of_twins_with_the_same_states():
    base, twins = (question_about(path) for path in PAIR)
    found = failures(base, twins)
    assert found.findings[0].numbers == {"failed": 4, "n": 6}
    assert "'touch the blue cube'" in found.findings[0].sentence
    assert "10 failures" in found.findings[0].limit
    rows = found["failures"]
    assert rows["twin"].to_list() == [f"task00{task}_episode00{i}" for task in (0, 1) for i in (0, 1)]
    assert rows["looked"].to_list() == ["blue cube"] * 4
    # For its size it gets most; of the attention to the pictures, the background has most.
    numbers = found.findings[1].numbers
    objects = va.open(PAIR[0]).objects(tasks=0, by="replan", iou=False)["objects_episodes"]
    of_call = objects.filter(episode_index=0, replan=rows["replan"][0], camera="all", item="blue_cube", kind="object")
    own = of_call.select(pl.mean("share", "enrichment")).row(0, named=True)
    assert numbers["share"] == pytest.approx(own["share"])
    assert numbers["times"] == pytest.approx(own["enrichment"], rel=0.2)  # weighs cameras otherwise
    assert numbers["background"] > 5 * numbers["share"]
    assert rows["twin_looked"].to_list() == ["red cube"] * 2 + ["green cube"] * 2
    (strip,) = found.figures
    assert strip.frame["row"].unique().to_list() == [0, 1]
    assert failures(base).findings[1].numbers == {}
    assert va.open(PAIR[0]).failures(twins=PAIR[1])["failures"].equals(rows)


def test_the_strip_shows_the_stored_pictures_upright():
    (strip,) = failures(*(question_about(path) for path in PAIR)).figures
    shown = [image.get_array() for image in draw(strip).axes[0].images]
    assert len(shown) == strip.frame.height
    one = strip.frame.row(-1, named=True)
    twin = open_store(PAIR[1]).episodes[0]
    frame = twin.read(f"frames/{one['camera']}", one["replan"])
    (view,) = (view for view in open_store(PAIR[1]).attributes.policy.cameras if view.name == one["camera"])
    np.testing.assert_array_equal(shown[-1], upright(frame, view))


def test_what_it_did_instead():
    """Touching what is named may be a goal of its own, and is none of another task."""
    goals = [*COLOURS, *goals_of({3: "lift the red cube"})]
    plan = [(0, {2: 5}), (0, {}), (3, {0: 4}), (3, {0: 4, 3: 9}), (3, {2: 6})]
    bodies = {**{task: task for task in range(3)}, 3: 0}
    frame = did(plan, goals, "", named=bodies)
    assert frame["how"].to_list()[:3] == [OTHER_GOAL, NO_TOUCH, UNFINISHED]
    assert frame["how"][4] == OTHER_GOAL
    assert frame["outcome"].to_list() == [False, False, False, True, False]
    other = did([(0, {2: 5})], goals, "", named=bodies, told="touch the blue cube")
    assert (other["how"][0], other["outcome"][0]) == (TOLD_SO, False)
    touched = did([(0, {})], goals, "", named=bodies, touches={1: 7})
    assert (touched["how"][0], touched["touched"][0], touched["touched_at"][0]) == (OTHER_TOUCH, "thing 1", 7)


def touching_nothing(spec, task, episode, steps):
    made = small_steps(spec, task, episode, steps)
    untouched = structs.replace(made.attributes, first_touch=(None,) * len(made.attributes.bodies))
    return replace(made, attributes=untouched)


def test_a_single_failure_that_touched_nothing(tmp_path):
    spec = replace(SPEC, tasks=(0,), episodes=1, plant_steps=touching_nothing, plant_success=lambda *_: False)
    found = failures(question_about(write_store(tmp_path / "a.zarr", spec=spec)))
    assert found["failures"]["how"].to_list() == [NO_TOUCH]


def test_what_the_task_alone_tells():
    found = failures(question_about(PAIR[0])).findings[-1]
    assert (found.numbers["right"], found.numbers["n"]) == (6, 6)


def test_lengths_are_compared_with_those_of_solved_episodes_and_only_where_they_are_known():
    for steps, said in (((25, 25, 25, 25), "2 of 2 failures and 2 of 2 solved"), ((25, 9, 0, 25), "")):
        outcomes = pl.DataFrame(
            {"suite": "s", "task_id": [0, 0, 1, 1], "solved": [True, False, False, True], "num_steps": steps}
        )
        (finding,) = foretold(outcomes)
        assert said in finding.sentence
        assert ("failures" in finding.sentence) == bool(said)


def test_nothing_failed_is_said():
    found = failures(question_about(PAIR[1]))
    assert found.findings[0].numbers == {"failed": 0, "n": 6}
    assert [table.name for table in found.tables] == ["failures_by_task"]


def test_without_steps_the_next_step_is_named(tmp_path):
    found = failures(question_about(write_store(tmp_path / "a.zarr")))
    assert found.findings[0].numbers == {"failed": 2, "n": 4}
    assert found.findings[0].next_step.startswith("vla-attention view")


def test_mistakes(tmp_path, planted, capsys):
    rerun = write_store(tmp_path / "rerun.zarr", rerun_of=rerun_source(planted))
    with pytest.raises(BadArgument, match="executed"):
        failures(question_about(rerun))
    assert analyze(["failures", str(PAIR[0]), "--twins", str(planted), "--output", str(tmp_path / "out")]) == 2
    assert str(planted) in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


STEPS, EVERY = 100, 5
STARTS = np.arange(0, STEPS, EVERY)


def path(seed: int) -> np.ndarray:
    """A hand that goes straight to a thing 30 cm away, with a slow wobble of a few millimetres."""
    wobble = np.cumsum(np.random.default_rng(seed).normal(0, 3e-4, (STEPS + 1, 3)), axis=0)
    return path_of(np.linspace(0, 1, STEPS + 1)[:, None] * np.array([0.3, 0, 0]) + wobble, [np.zeros((STEPS + 1, 3))])


def apart(one, others):
    return by_replan(np.min([distance(one, other) for other in others if other is not one], axis=0), STARTS)


@pytest.mark.parametrize(("turn", "expected"), [(20, 4), (60, 12), (101, None)])
def test_a_hand_that_turns_away_leaves_where_it_does(turn, expected):
    solved = [path(seed) for seed in range(6)]
    failed = path(99)
    failed[turn:, 1] += 0.005 * np.arange(max(STEPS + 1 - turn, 0))
    found = leaves_at(apart(failed, solved[:3]), band([apart(one, solved) for one in solved], len(STARTS)))
    assert found == expected or (expected is not None and 0 <= found - expected <= 2)


@given(st.integers(0, 10), st.integers(0, 2**16))
def test_pace_and_place_do_not_count(shift, seed):
    """A path that is ahead by at most ten steps is the same; so is one in another place of the table."""
    generator = np.random.default_rng(seed)
    hand, thing = generator.normal(size=(40, 3)), generator.normal(size=(40, 3))
    one = path_of(hand, [thing])
    np.testing.assert_allclose(one, path_of(hand + 1, [thing + 1]), atol=1e-12)
    assert distance(one[shift:], one).max() == 0


@given(st.lists(st.floats(0, 1), min_size=1, max_size=20), st.floats(0.01, 0.9))
def test_from_there_on_it_is_outside(values, height):
    found, within = np.array(values), np.full(len(values), height)
    at, outside = leaves_at(found, within), [value > height for value in values][::-1]
    last = outside.index(False) if False in outside else len(outside)
    assert at == (len(values) - last if last >= min(FEWEST, len(values)) else None)


def test_the_last_replans_alone_are_no_leaving():
    apart = np.array([0, 0.1, 0, 0, 0.1, 0.1, 0.1])
    assert leaves_at(apart, np.full(7, 0.02)) == 4
    assert leaves_at(apart[:-1], np.full(6, 0.02)) is None
    assert leaves_at(np.full(2, 0.1), np.full(2, 0.02)) == 0


def test_a_band_holds_where_an_episode_ended_and_looks_one_replan_aside():
    np.testing.assert_allclose(band([np.array([0.0, 0.05]), np.array([0.02, 0.0, 0.0, 0.0])], 4), 0.05)
    np.testing.assert_allclose(band([np.array([0.03, 0.0, 0.0, 0.0])], 4), [0.03, 0.03, TOGETHER, TOGETHER])
