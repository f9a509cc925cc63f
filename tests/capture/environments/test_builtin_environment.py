"""The built-in robosuite tasks: pictures on request, and their segmentation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("robosuite")

from vla_attention.capture.environments.base import Environment, EnvironmentSettings, Observation, initial_state_seed
from vla_attention.capture.environments.episode_protocol import CAMERAS, OPENPI, WAIT_ACTION
from vla_attention.capture.environments.robosuite_tasks import BUILTIN_TASKS
from vla_attention.capture.environments.suites import find_suite, make_environment

SUITE = find_suite("robosuite")
SETTINGS = EnvironmentSettings()
STACK = 1
ACTIONS = np.random.default_rng(1).uniform(-1, 1, (3, 7))


def act(environment: Environment, index: int, seed: int = 7) -> Observation:
    environment.reset(index, seed)
    for action in ACTIONS[:-1]:
        assert environment.step(action, observe=False).observation is None
    observation = environment.step(ACTIONS[-1], observe=True).observation
    assert observation is not None
    return observation


@pytest.fixture(scope="module")
def environment() -> Iterator[Environment]:
    made = make_environment(SUITE, STACK, SETTINGS)
    yield made
    made.close()


@pytest.mark.simulator
def test_pictures_are_those_of_the_untouched_simulator(environment: Environment) -> None:
    import robosuite
    from robosuite.controllers import load_controller_config

    untouched = robosuite.make(
        "Stack",
        robots="Panda",
        controller_configs=load_controller_config(default_controller="OSC_POSE"),
        camera_names=list(CAMERAS),
        camera_heights=256,
        camera_widths=256,
    )
    np.random.seed(initial_state_seed("Stack", 4))  # noqa: NPY002
    untouched.reset()
    values = [untouched.step(action)[0] for action in ACTIONS]
    untouched.close()
    on_demand = act(environment, 4)
    environment.reset(4, 7)
    drawn = [environment.step(action, observe=True).observation for action in ACTIONS]
    for observation, value in zip([*drawn, on_demand], [*values, values[-1]], strict=True):
        assert observation is not None
        for camera in CAMERAS:
            np.testing.assert_array_equal(observation.images[camera], value[f"{camera}_image"])
        np.testing.assert_array_equal(observation.eef_pos, value["robot0_eef_pos"])
        np.testing.assert_array_equal(observation.eef_quat, value["robot0_eef_quat"])
        np.testing.assert_array_equal(observation.gripper_qpos, value["robot0_gripper_qpos"])


@pytest.mark.thorough
@pytest.mark.simulator
def test_initial_states_are_fixed_by_their_index_alone(environment: Environment) -> None:
    first = act(environment, 0, seed=7)
    digest = environment.initial_state_digest
    act(environment, 1)
    assert environment.initial_state_digest != digest
    again = act(environment, 0, seed=8)
    assert environment.initial_state_digest == digest
    for camera in CAMERAS:
        np.testing.assert_array_equal(first.images[camera], again.images[camera])


@pytest.mark.thorough
@pytest.mark.simulator
def test_two_environments_in_one_process_do_not_disturb_each_other(environment: Environment) -> None:
    """Each frees and draws in its own OpenGL context; robosuite alone uses whichever is current."""
    alone = act(environment, 2)
    other = make_environment(SUITE, 0, EnvironmentSettings(replace(OPENPI, image_size=64)))
    other.reset(0, 7)
    environment.reset(2, 7)
    for action in ACTIONS[:-1]:
        environment.step(action, observe=False)
        other.step(action, observe=True)
    other.reset(1, 7)
    together = environment.step(ACTIONS[-1], observe=True).observation
    other.close()
    segmentation = environment.segmentation("agentview")
    assert together is not None
    for camera in CAMERAS:
        np.testing.assert_array_equal(alone.images[camera], together.images[camera])
    act(environment, 2)
    np.testing.assert_array_equal(environment.segmentation("agentview"), segmentation)


@pytest.mark.thorough
@pytest.mark.simulator
@pytest.mark.parametrize("task_id", [task_id for task_id in range(SUITE.num_tasks) if task_id != STACK])
def test_every_task_runs_and_shows_its_target(task_id: int) -> None:
    environment = make_environment(SUITE, task_id, SETTINGS)
    environment.reset(0, 7)
    result = environment.step(np.array(WAIT_ACTION), observe=True)
    segmentation = environment.segmentation("agentview")
    wanted = {thing.name for thing in environment.objects if thing.of_interest}
    seen = {environment.objects[index].name for index in np.unique(segmentation)}
    environment.close()
    assert not result.success
    assert wanted
    assert wanted <= seen
    assert wanted == {part.name for part in BUILTIN_TASKS[task_id].parts if part.of_interest}


@pytest.mark.simulator
def test_success_is_the_simulators_own_judgement() -> None:
    environment = make_environment(SUITE, 0, EnvironmentSettings(replace(OPENPI, image_size=32)))
    environment.reset(0, 7)
    assert not environment.step(np.array(WAIT_ACTION), observe=False).success
    simulator = environment._simulator  # type: ignore[attr-defined]
    position = simulator.sim.data.get_joint_qpos("cube_joint0")
    position[2] += 0.2  # in the air
    simulator.sim.data.set_joint_qpos("cube_joint0", position)
    assert environment.step(np.array(WAIT_ACTION), observe=False).success
    environment.close()


def test_initial_state_seeds_are_the_same_on_every_machine() -> None:
    assert initial_state_seed("Lift", 0) == 2565090732
    seeds = {initial_state_seed(task.environment, index) for task in BUILTIN_TASKS for index in range(50)}
    assert len(seeds) == 50 * len(BUILTIN_TASKS)
