"""What a store says of an episode's steps: names once, moments that exist, goals that belong to the episode."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kit.examples import examples
from tests.kit.stores import StoreSpec, expected_arrays, reseal, root_attributes, small_steps, write_store
from vla_attention.schemas.episode_steps import HAND, POSES, EpisodeSteps, TaskGoal
from vla_attention.schemas.jsonable import from_json, to_json
from vla_attention.schemas.stores.content_rules import Block, value_problems
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

GOAL = TaskGoal(0, "lift", "lift the bowl", ("up bowl",), None)
STEPS = EpisodeSteps((HAND, "bowl", "plate"), (None, 4, None), (GOAL,))


@given(st.lists(st.none() | st.integers(0, 30), max_size=6))
@settings(max_examples=examples(100))
def test_what_was_touched_is_in_the_order_of_the_touches(moments):
    names = tuple(f"thing_{i}" for i in range(len(moments)))
    steps = EpisodeSteps((HAND, *names), (None, *moments), ())
    known = [(moment, i) for i, moment in enumerate(moments) if moment is not None]
    assert steps.touched == tuple(names[i] for _, i in sorted(known))
    assert from_json(EpisodeSteps, json.loads(json.dumps(to_json(steps)))) == steps


def test_poses_are_finite_and_turns_have_length_one():
    root = root_attributes(StoreSpec(plant_steps=small_steps))

    def problem(poses: np.ndarray, first: int = 0) -> str | None:
        return next(value_problems(Block(root, 0, POSES, poses, {}.__getitem__, first)), None)

    poses = np.zeros((3, 2, 7), np.float32)
    poses[..., 3] = 1
    assert problem(poses) is None
    poses[2, 1, 3] = 0.9
    assert [number for number in ("steps/poses", "0.9", "12", "1") if number not in str(problem(poses, 10))] == []
    poses[1, 0, 0] = np.nan
    assert re.search(r"steps/poses .*\b1\b.*\b0\b", str(problem(poses)))
    assert re.search("float64.*float32", str(problem(poses.astype(np.float64))))


@pytest.fixture
def path(tmp_path) -> Path:
    return write_store(tmp_path / "a.zarr", tasks=(0, 1), episodes=2, plant_steps=small_steps)


def test_a_store_gives_them_back(path):
    spec = StoreSpec(tasks=(0, 1), episodes=2, plant_steps=small_steps)
    assert verify_store(open_store(path)) == []
    for episode in open_store(path).episodes:
        attributes = episode.attributes
        steps = attributes.steps
        assert steps is not None
        own = steps.goal_of(attributes.task_id)
        assert own is not None
        assert own.first_held == (attributes.num_steps if attributes.success else None)
        assert steps.goal_of(7) is None
        expected = expected_arrays(spec, attributes.task_id, attributes.episode_index)
        for name in ("steps/poses", "steps/gripper", "steps/actions"):
            np.testing.assert_array_equal(episode.read(name), expected[name])
        assert episode.array("steps/poses").metadata.axes == ("moment", "body", "pose")


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda a: a.update(steps=None), r"steps/poses .*\(16, 3, 7\).*\(3,\)"),
        (lambda a: a.update(num_steps=14), r"steps/actions .*\(15, 7\).*\(14,\)"),
        (lambda a: a["arrays"].pop("steps/gripper"), "steps/gripper"),
    ],
)
def test_steps_that_contradict_the_rest_are_a_fault(path, change, problem):
    folder = path / "episodes/task000_episode000"
    document = json.loads((folder / "zarr.json").read_text())
    change(document["attributes"])
    (folder / "zarr.json").write_text(json.dumps(document))
    reseal(folder)
    assert re.search(problem, " ".join(fault.problem for fault in verify_store(open_store(path))))
