"""The suite `cubes` in the real simulator: the same whatever ran before, success from the state, experts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("robosuite")

from examples.cubes_policy.experts import expert_action, read_state
from tests.kit.thorough import thorough_except
from vla_attention.capture.environments.base import EnvironmentSettings, Observation
from vla_attention.capture.environments.cubes.environment import CubesEnvironment
from vla_attention.capture.environments.cubes.tasks import COLOURS, CUBE_TASKS, CubeTask, Target, Verb
from vla_attention.capture.environments.episode_protocol import CAMERAS, OPENPI, WAIT_ACTION, WAIT_STEPS
from vla_attention.capture.environments.suites import find_suite, list_tasks

pytestmark = pytest.mark.simulator
SUITE = find_suite("cubes")
ACTIONS = np.random.default_rng(1).uniform(-1, 1, (5, 7))
SMALL = EnvironmentSettings(replace(OPENPI, image_size=64))


def _number(verb: Verb, target: Target, destination: Target | None = None, num_cubes: int = 3) -> int:
    return CUBE_TASKS.index(CubeTask(verb, target, destination, num_cubes))


@pytest.fixture(scope="module")
def environment() -> Iterator[CubesEnvironment]:
    made = CubesEnvironment(list_tasks(SUITE)[0], SMALL)
    yield made
    made.close()


def _act(environment: CubesEnvironment, index: int, seed: int = 7) -> Observation:
    environment.reset(index, seed)
    for action in ACTIONS[:-1]:
        environment.step(action, observe=False)
    observation = environment.step(ACTIONS[-1], observe=True).observation
    assert observation is not None
    return observation


def test_an_episode_is_the_same_whatever_ran_before(environment: CubesEnvironment) -> None:
    first = _act(environment, 3)
    digest = environment.initial_state_digest
    _act(environment, 4)
    assert environment.initial_state_digest != digest
    again = _act(environment, 3, seed=8)
    assert environment.initial_state_digest == digest
    fresh = CubesEnvironment(list_tasks(SUITE)[5], SMALL)
    elsewhere = _act(fresh, 3)  # another task with as many cubes has the same scenes
    fresh.close()
    for other in (again, elsewhere):
        np.testing.assert_array_equal(first.eef_pos, other.eef_pos)
        for camera in CAMERAS:
            np.testing.assert_array_equal(first.images[camera], other.images[camera])


def test_cubes_are_seen_in_their_colours(environment: CubesEnvironment) -> None:
    observation = _act(environment, 3)
    image, segmentation = observation.images["agentview"].astype(int), environment.segmentation("agentview")
    names = [thing.name for thing in environment.objects]
    assert names == ["red_cube", "green_cube", "blue_cube", "robot", "background"]
    for channel, name in enumerate(names[:3]):
        pixels = image[segmentation == names.index(name)]
        assert len(pixels) > 5
        assert pixels.mean(axis=0).argmax() == channel
    assert [thing.of_interest for thing in environment.objects] == [True, False, False, False, False]


EXPERTS = [
    _number("touch", "green"),
    _number("lift", "blue"),
    _number("push_left", "red"),
    _number("push_right", "green"),
    _number("lift", "leftmost"),
    _number("put_on", "red", "blue"),
]


@pytest.mark.parametrize("number", thorough_except((EXPERTS[0], EXPERTS[-1]), EXPERTS))
def test_experts_solve_the_tasks_and_nothing_else_does(environment: CubesEnvironment, number: int) -> None:
    task = CUBE_TASKS[number]
    environment.give_task(task)
    simulator = environment.simulator
    for index in range(2):
        environment.reset(index, 7)
        for _ in range(WAIT_STEPS):
            assert not environment.step(np.array(WAIT_ACTION), observe=False).success
        for _ in range(SUITE.max_steps):
            action = expert_action(task.verb, read_state(simulator), simulator.target, simulator.destination)
            if environment.step(action, observe=False).success:
                break
        else:
            raise AssertionError(f"the expert did not solve {task.name} from initial state {index}")
        assert simulator.first_touched == simulator.target


def test_touching_another_cube_first_is_no_success(environment: CubesEnvironment) -> None:
    environment.give_task(CUBE_TASKS[_number("touch", "red")])
    environment.reset(0, 7)
    simulator = environment.simulator
    for _ in range(SUITE.max_steps):
        wrong = expert_action("touch", read_state(simulator), 1, None)
        assert not environment.step(wrong, observe=False).success
        if environment.simulator.first_touched is not None:
            break
    assert COLOURS[environment.simulator.first_touched] == "green"
    for _ in range(60):
        right = expert_action("touch", read_state(simulator), simulator.target, None)
        assert not environment.step(right, observe=False).success


@pytest.mark.thorough
def test_a_mark_is_in_the_picture_and_in_the_segmentation() -> None:
    suite = find_suite("cubes_mark_only")
    task = list_tasks(suite)[_number("push_left", "blue")]
    assert task.instruction == "do what the mark says"
    marked, plain = CubesEnvironment(task, SMALL), CubesEnvironment(list_tasks(SUITE)[task.task_id], SMALL)
    observed, without = _act(marked, 3), _act(plain, 3)
    segmentation = marked.segmentation("agentview")
    names = [thing.name for thing in marked.objects]
    marked.close()
    plain.close()
    is_mark = segmentation == names.index("mark")
    assert is_mark.sum() == (64 // 8) ** 2
    assert is_mark[-8:].sum() == is_mark.sum()  # the bottom rows of the simulator's picture are its upper edge
    changed = (observed.images["agentview"] != without.images["agentview"]).any(axis=2)
    assert (changed <= is_mark).all()
    assert observed.images["agentview"][is_mark].mean(axis=0).argmax() == 2
    np.testing.assert_array_equal(observed.images["robot0_eye_in_hand"], without.images["robot0_eye_in_hand"])
