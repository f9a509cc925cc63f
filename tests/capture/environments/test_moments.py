"""What environments tell after every step: where things are, what the gripper touches, whose goals hold."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("robosuite")

from examples.cubes_policy.experts import expert_action, read_state
from tests.kit.thorough import thorough_except
from vla_attention.capture.environments.base import Environment, EnvironmentSettings, Moment, TellsMoments
from vla_attention.capture.environments.cubes.environment import CubesEnvironment
from vla_attention.capture.environments.cubes.scene import find_target
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS
from vla_attention.capture.environments.episode_protocol import OPENPI, WAIT_ACTION, WAIT_STEPS
from vla_attention.capture.environments.suites import find_suite, list_tasks, make_environment
from vla_attention.schemas.episode_steps import HAND

pytestmark = pytest.mark.simulator
SMALL = EnvironmentSettings(replace(OPENPI, image_size=64))
ACTIONS = np.random.default_rng(1).uniform(-1, 1, (12, 7))


def made(suite: str, task: int, settings: EnvironmentSettings = SMALL) -> Any:
    return make_environment(find_suite(suite), task, settings)


def watched(environment: Environment, asked: bool) -> list[np.ndarray]:
    """Everything that an episode of random actions shows, with the moments asked for or not."""
    seen: list[np.ndarray] = []
    environment.reset(1, 7)
    for number, action in enumerate([np.array(WAIT_ACTION)] * WAIT_STEPS + list(ACTIONS)):
        result = environment.step(action, observe=number % 3 == 0 or number == WAIT_STEPS - 1)
        if asked:
            assert isinstance(environment, TellsMoments)
            environment.moment()
        if result.observation is not None:
            seen += [*result.observation.images.values(), result.observation.eef_pos, result.observation.gripper_qpos]
        seen.append(np.array(result.success))
    state = environment._simulator.sim.get_state().flatten()  # type: ignore[attr-defined]
    return [*seen, np.array(state)]


def assert_the_same(one: list[np.ndarray], other: list[np.ndarray]) -> None:
    assert len(one) == len(other)
    for mine, its in zip(one, other, strict=True):
        np.testing.assert_array_equal(mine, its)


@pytest.mark.parametrize(
    ("suite", "task"),
    thorough_except(
        [("cubes_harder", 18)], [("cubes", 4), ("cubes_harder", 18), ("robosuite", 1), ("robosuite", 6)], several=True
    ),
)
def test_asking_changes_nothing(suite, task):
    environment = made(suite, task)
    try:
        assert_the_same(watched(environment, asked=False), watched(environment, asked=True))
    finally:
        environment.close()


@pytest.fixture(scope="module")
def cubes() -> Iterator[CubesEnvironment]:
    environment = made("cubes_harder", 0)
    yield environment
    environment.close()


@pytest.mark.parametrize(
    "suite",
    [
        "cubes_harder",
        pytest.param("robosuite", marks=pytest.mark.thorough),
        pytest.param("libero_goal", marks=pytest.mark.libero),
    ],
)
def test_poses_are_those_of_the_simulator(suite, request):
    if suite == "libero_goal":
        environment = request.getfixturevalue("goal_suite")
    else:
        environment = request.getfixturevalue("cubes") if suite == "cubes_harder" else made(suite, 1)
    environment.reset(2, 7)
    for action in ACTIONS[:5]:  # the hand turns
        observation = environment.step(action, observe=True).observation
    moment = environment.moment()
    assert (moment.poses.dtype, moment.poses.shape) == (np.float32, (len(environment.bodies), 7))
    simulation = environment._simulator.sim
    model, data = simulation.model._model, simulation.data._data
    site = data.site("gripper0_grip_site")
    places, turns = [site.xpos], [site.xmat]
    for name in environment.bodies[1:]:
        body = data.body(environment._roots[name][0])
        places.append(body.xpos)
        turns.append(body.xmat)
    np.testing.assert_allclose(moment.poses[:, :3], places, atol=1e-6)
    w, x, y, z = moment.poses[:, 3:].T
    matrices = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    np.testing.assert_allclose(matrices, np.reshape(turns, (-1, 3, 3)), atol=1e-6)
    # A picture and its numbers are of a substep before the end of the step.
    np.testing.assert_allclose(moment.poses[0, :3], observation.eef_pos, atol=5e-3)
    np.testing.assert_allclose(moment.gripper, observation.gripper_qpos, atol=5e-3)
    assert environment.bodies[0] == HAND
    assert model.nbody > len(environment.bodies)
    if suite == "robosuite":
        environment.close()


@pytest.mark.parametrize("number", thorough_except([12], [5, 12, 17]))
def test_an_expert_reaches_its_own_goal_and_no_other_of_its_kind(cubes, number):
    task, simulator = CUBE_TASKS[number], cubes.simulator
    cubes.give_task(task)
    cubes.reset(0, 7)
    told: list[Moment] = []
    for _ in range(200):
        action = expert_action(task.verb, read_state(simulator), simulator.target, simulator.destination)
        solved = cubes.step(action, observe=False).success
        told.append(cubes.moment())
        assert told[-1].held[[goal.task_id for goal in cubes.goals].index(number)] == solved
        if solved:
            break
    assert solved
    held = {cubes.goals[place].task_id for place in np.flatnonzero(told[-1].held)}
    # Whoever lifts, pushes or puts down a cube has touched it; a place and a colour may name one cube.
    assert held <= {goal.task_id for goal in cubes.goals if meant(cubes, goal.task_id) == simulator.target}
    touched = [moment.touched for moment in told if moment.touched.any()]
    assert np.flatnonzero(touched[0]).tolist() == [1 + simulator.target]
    assert simulator.first_touched == simulator.target


def meant(cubes: CubesEnvironment, number: int) -> int:
    return find_target(CUBE_TASKS[number].target, cubes.simulator._beginning)


# ----------------------------------------------------------------------------------------------------- LIBERO


@pytest.fixture(scope="module")
def goal_suite(libero_assets: Path) -> Iterator[Any]:
    environment = made("libero_goal", 0, replace(SMALL, libero_assets=libero_assets))
    yield environment
    environment.close()


@pytest.mark.libero
@pytest.mark.parametrize(
    ("suite", "sizes", "contained"),
    [
        ("libero_goal", {10: 1}, 0),
        ("libero_spatial", {1: 10}, 0),
        ("libero_object", {1: 10}, 0),
        ("libero_90", {2: 2, 3: 1, 4: 7, 5: 6, 6: 3, 7: 1}, 10),
    ],
)
def test_which_tasks_share_a_scene(libero_assets, suite, sizes, contained):
    from vla_attention.capture.environments.libero import goals_of_scene
    from vla_attention.capture.environments.libero_installation import load_libero

    load_libero(libero_assets)
    tasks = list_tasks(find_suite(suite))
    left, found, pairs = list(tasks), dict.fromkeys(sizes, 0), 0
    while left:
        goals = goals_of_scene(left[0], left)
        found[len(goals)] += 1
        pairs += sum(set(one) <= set(other) for a, one in goals.items() for b, other in goals.items() if a != b)
        left = [task for task in left if task not in goals]
    assert (found, pairs) == (sizes, contained)


def put(environment: Any, thing: str, place: np.ndarray) -> None:
    data = environment._simulator.sim.data
    joint = f"{thing}_joint0"
    data.set_joint_qpos(joint, np.concatenate([place, data.get_joint_qpos(joint)[3:]]))
    data.set_joint_qvel(joint, np.zeros(6))


def site(environment: Any, name: str) -> np.ndarray:
    return np.array(environment._simulator.sim.data.get_site_xpos(name))


def turn(environment: Any, joint: str, to: float) -> None:
    environment._simulator.sim.data.set_joint_qpos(joint, to)


def body(environment: Any, name: str) -> np.ndarray:
    return environment.moment().poses[environment.bodies.index(name), :3].astype(float)


UP = np.array([0.0, 0.0, 1.0])
BOWL, BOTTLE, TOP = "akita_black_bowl_1", "wine_bottle_1", "wooden_cabinet_1_top_side"
#: Task -> what makes its goal true, and steps until things lie still.
STATES: dict[str, tuple[Any, int]] = {
    "open_the_middle_drawer_of_the_cabinet": (lambda e: turn(e, "wooden_cabinet_1_middle_level", -0.15), 10),
    "put_the_bowl_on_the_stove": (lambda e: put(e, BOWL, site(e, "flat_stove_1_cook_region") + 0.04 * UP), 30),
    "put_the_wine_bottle_on_top_of_the_cabinet": (lambda e: put(e, BOTTLE, site(e, TOP) + 0.03 * UP), 30),
    "open_the_top_drawer_and_put_the_bowl_inside": (
        lambda e: put(e, BOWL, site(e, "wooden_cabinet_1_top_region")),
        2,
    ),
    "put_the_bowl_on_top_of_the_cabinet": (lambda e: put(e, BOWL, site(e, TOP) + 0.03 * UP), 30),
    "push_the_plate_to_the_front_of_the_stove": (
        lambda e: put(e, "plate_1", site(e, "main_table_stove_front_region") + 0.02 * UP),
        30,
    ),
    "put_the_cream_cheese_in_the_bowl": (lambda e: put(e, "cream_cheese_1", body(e, BOWL) + 0.08 * UP), 40),
    "turn_on_the_stove": (lambda e: turn(e, "flat_stove_1_button", 1.0), 10),
    "put_the_bowl_on_the_plate": (lambda e: put(e, BOWL, body(e, "plate_1") + 0.05 * UP), 40),
    "put_the_wine_bottle_on_the_rack": (
        lambda e: put(e, BOTTLE, site(e, "wine_rack_1_top_region") + 0.02 * UP),
        3,
    ),
}


@pytest.mark.thorough
@pytest.mark.libero
@pytest.mark.parametrize("name", STATES)
def test_each_goal_of_libero_goal_holds_in_its_state_and_none_of_the_others(goal_suite, name):
    assert sorted(goal.task_name for goal in goal_suite.goals) == sorted(STATES)
    change, steps = STATES[name]
    goal_suite.reset(0, 7)
    for _ in range(WAIT_STEPS):
        goal_suite.step(np.array(WAIT_ACTION), observe=False)
    assert not goal_suite.moment().held.any()
    change(goal_suite)
    goal_suite._simulator.sim.forward()
    for _ in range(steps):
        goal_suite.step(np.array(WAIT_ACTION), observe=False)
    held = np.flatnonzero(goal_suite.moment().held)
    assert [goal_suite.goals[place].task_name for place in held] == [name]


@pytest.mark.thorough
@pytest.mark.libero
def test_asking_whether_a_stove_is_off_does_not_light_it(libero_assets):
    """LIBERO's predicate `turnoff` shows the burner where the knob is neither on nor off."""
    tasks = list_tasks(find_suite("libero_90"))
    settings = replace(SMALL, libero_assets=libero_assets)
    # Its own goal does not ask; that of the scene's other task does.
    number = next(task.task_id for task in tasks if task.name.startswith("KITCHEN_SCENE8_put"))
    environment = made("libero_90", number, settings)
    try:
        assert "turnoff flat_stove_1" in {condition for goal in environment.goals for condition in goal.conditions}

        def seen(asked: bool) -> list[np.ndarray]:
            environment.reset(0, 7)
            turn(environment, "flat_stove_1_button", 0.2)
            pictures = []
            for _ in range(4):
                result = environment.step(np.array(WAIT_ACTION), observe=True)
                pictures += list(result.observation.images.values())
                if asked:
                    stove = environment._simulator.get_object("flat_stove_1").object_properties["vis_site_names"]
                    before = dict(stove)
                    environment.moment()
                    assert stove == before == {"burner": ("flat_stove_1_burner", False)}
            return pictures

        assert_the_same(seen(asked=False), seen(asked=True))
        assert_the_same(watched(environment, asked=False), watched(environment, asked=True))
    finally:
        environment.close()
