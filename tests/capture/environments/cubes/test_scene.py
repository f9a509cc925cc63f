"""Scenes of the suite `cubes`: fixed by their seed, apart, and without a link between colour and place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vla_attention.capture.environments.base import initial_state_seed
from vla_attention.capture.environments.cubes import scene
from vla_attention.capture.environments.cubes.scene import (
    draw_scene,
    find_target,
    paste_mark,
)
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS, NUM_BASE_TASKS
from vla_attention.capture.environments.suites import find_suite, list_tasks

SUITE, HARDER = find_suite("cubes"), find_suite("cubes_harder")


@pytest.mark.parametrize("num_cubes", [3, 4])
def test_cubes_are_apart_within_reach_and_the_outermost_ones_stand_out(num_cubes: int) -> None:
    for seed in range(60):
        drawn = draw_scene(seed, num_cubes)
        assert drawn.positions.shape == (num_cubes, 2)
        assert (np.abs(drawn.positions) <= scene.REACH).all()
        assert (np.abs(drawn.yaws) <= scene.MAX_YAW).all()
        for one in range(num_cubes):
            for other in range(one):
                assert np.hypot(*(drawn.positions[one] - drawn.positions[other])) >= scene.MIN_DISTANCE
        sideways = sorted(drawn.positions[:, 1])
        assert sideways[1] - sideways[0] >= scene.MIN_SIDE_GAP
        assert sideways[-1] - sideways[-2] >= scene.MIN_SIDE_GAP


def test_a_seed_gives_the_same_scene_again_and_demonstrations_have_seeds_of_their_own() -> None:
    one, again = draw_scene(5, 3), draw_scene(5, 3)
    np.testing.assert_array_equal(one.positions, again.positions)
    evaluation = {initial_state_seed(scene.EVALUATION, index) for index in range(SUITE.initial_states_per_task)}
    training = {initial_state_seed(scene.TRAINING, index) for index in range(20_000)}
    assert len(evaluation) == SUITE.initial_states_per_task
    assert not evaluation & training


def test_left_is_the_robots_left() -> None:
    positions = np.array([[0.0, -0.1, 0.8], [0.0, 0.15, 0.8], [0.0, 0.02, 0.8]])
    assert find_target("leftmost", positions) == 1
    assert find_target("rightmost", positions) == 0
    assert find_target("blue", positions) == 2


def test_tasks_have_names_and_instructions_that_tell_them_apart() -> None:
    tasks = list_tasks(HARDER)
    assert len(tasks) == HARDER.num_tasks == len(CUBE_TASKS)
    assert list_tasks(SUITE) == tuple(replace(task, suite=SUITE.name) for task in tasks[: SUITE.num_tasks])
    assert len({task.name for task in tasks}) == len(tasks)
    base = tasks[:NUM_BASE_TASKS]
    assert len({task.instruction for task in base}) == NUM_BASE_TASKS
    assert all("yellow" not in task.instruction for task in tasks)
    named = {task.name: task.instruction for task in tasks}
    assert named["push_left_blue"] == "push the blue cube to the left"
    assert named["put_red_on_green"] == "put the red cube on the green cube"
    assert named["lift_leftmost"] == "lift the cube on the left"
    assert named["lift_green_of_four"] == named["lift_green"] == "lift the green cube"


def test_the_mark_is_a_square_in_the_upper_edge_and_changes_nothing_else():
    picture = np.full((64, 64, 3), 100, dtype=np.uint8)
    marked = paste_mark(picture, 1, 2)
    changed = (marked != picture).any(axis=-1)
    assert changed[:8, 24:32].all()
    assert changed.sum() == 64
    assert (picture == 100).all()
    assert marked[0, 24, 1] > marked[0, 24, 0]  # green
