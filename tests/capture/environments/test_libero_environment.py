"""The real LIBERO: the pictures of the original package, the same episodes in any order, and the segmentation."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("libero")
pytest.importorskip("robosuite")

from vla_attention.capture.environments.base import NO_DEPARTURES, Departures, EnvironmentSettings, Observation
from vla_attention.capture.environments.episode_protocol import CAMERAS, WAIT_ACTION, WAIT_STEPS
from vla_attention.capture.environments.libero import LiberoEnvironment, load_initial_states, parent_of_region
from vla_attention.capture.environments.libero_beginnings import beginning_of
from vla_attention.capture.environments.libero_installation import load_libero, package_folder
from vla_attention.capture.environments.suites import find_suite, make_environment
from vla_attention.schemas.errors import UnknownName
from vla_attention.schemas.libero_physics import what_differs

SUITE, TASK_ID, SEED, INDEX = "libero_spatial", 7, 7, 3
ACTIONS = np.random.default_rng(0).uniform(-1, 1, (7, 7))
OBSERVED = (0, 4, 5)


def stored_states() -> np.ndarray:
    name = "pick_up_the_black_bowl_on_the_stove_and_place_it_on_the_plate"
    return load_initial_states(package_folder() / "init_files" / SUITE / f"{name}.pruned_init")


def identical(left: Observation, right: Observation) -> bool:
    return all(np.array_equal(left.images[camera], right.images[camera]) for camera in CAMERAS) and all(
        np.array_equal(getattr(left, name), getattr(right, name)) for name in ("eef_pos", "eef_quat", "gripper_qpos")
    )


def run_episode(environment: LiberoEnvironment, index: int, steps: int, observed: tuple[int, ...]) -> list[Observation]:
    """Wait and act; return the observations after the last waiting step and after the `observed` actions."""
    environment.reset(index, SEED)
    observations = [
        environment.step(np.array(WAIT_ACTION), observe=step == WAIT_STEPS - 1).observation
        for step in range(WAIT_STEPS)
    ]
    observations += [environment.step(ACTIONS[step], observe=step in observed).observation for step in range(steps)]
    return [observation for observation in observations if observation is not None]


@pytest.fixture(scope="module")
def protocol(libero_assets: Path) -> list[dict[str, np.ndarray]]:
    """The observations of the package's own environment in the same episode; it draws at every step."""
    load_libero(libero_assets)
    from libero.libero.envs import OffScreenRenderEnv

    folder = package_folder() / "bddl_files" / SUITE
    task = next(folder.glob("*on_the_stove_and_place_it_on_the_plate.bddl"))
    environment = OffScreenRenderEnv(bddl_file_name=str(task), camera_heights=256, camera_widths=256)
    environment.seed(SEED)
    for _ in range(INDEX + 1):
        environment.reset()
    environment.set_init_state(stored_states()[INDEX])
    values = [environment.step([0.0] * 6 + [-1.0])[0] for _ in range(10)][-1:]
    values += [environment.step(action)[0] for action in ACTIONS]
    environment.close()
    return [values[0], *(values[1 + step] for step in OBSERVED)]


@pytest.fixture(scope="module")
def environment(protocol: list[dict[str, np.ndarray]], libero_assets: Path) -> Iterator[LiberoEnvironment]:
    # After `protocol`: the package's own environment must be closed first, because it draws in whichever context is
    # current.
    made = make_environment(find_suite(SUITE), TASK_ID, EnvironmentSettings(libero_assets=libero_assets))
    assert isinstance(made, LiberoEnvironment)
    yield made
    made.close()
    made.close()


@pytest.fixture(scope="module")
def episode(environment: LiberoEnvironment) -> list[Observation]:
    return run_episode(environment, INDEX, len(ACTIONS), OBSERVED)


@pytest.mark.libero
def test_stored_states_are_read_without_running_pickled_code() -> None:
    states = stored_states()
    assert states.dtype == np.float64
    assert states.shape == (50, 92)
    assert np.isfinite(states).all()


def test_regions_belong_to_what_they_are_part_of() -> None:
    known = ["wine_rack_1", "wooden_cabinet_1", "wooden_cabinet_10"]
    assert parent_of_region("wine_rack_1_top_region", known) == "wine_rack_1"
    assert parent_of_region("wooden_cabinet_10_top_side", known) == "wooden_cabinet_10"
    assert parent_of_region("main_table_stove_front_region", known) is None


@pytest.mark.thorough
@pytest.mark.simulator
@pytest.mark.libero
def test_pictures_are_those_of_the_untouched_protocol(
    protocol: list[dict[str, np.ndarray]], episode: list[Observation]
) -> None:
    assert len(protocol) == len(episode) == 1 + len(OBSERVED)
    for theirs, ours in zip(protocol, episode, strict=True):
        for camera in CAMERAS:
            assert ours.images[camera].shape == (256, 256, 3)
            np.testing.assert_array_equal(ours.images[camera], theirs[f"{camera}_image"])
        np.testing.assert_array_equal(ours.eef_pos, theirs["robot0_eef_pos"])
        np.testing.assert_array_equal(ours.eef_quat, theirs["robot0_eef_quat"])
        np.testing.assert_array_equal(ours.gripper_qpos, theirs["robot0_gripper_qpos"])


@pytest.mark.thorough
@pytest.mark.simulator
@pytest.mark.libero
def test_the_segmentation_shows_the_moment_of_the_picture(
    environment: LiberoEnvironment, episode: list[Observation]
) -> None:
    """Drawing the kept moment in colour gives the picture bit for bit; drawing the end of the step does not."""
    last = run_episode(environment, INDEX, OBSERVED[-1] + 1, OBSERVED[-1:])[-1]
    segmented = environment.segmentation("agentview")
    simulation = environment._simulator.sim
    end_of_step = simulation.render(camera_name="agentview", width=256, height=256)
    context = simulation._render_context_offscreen
    original, context.data = context.data, type("Kept", (), {"_data": environment._moment})
    kept = simulation.render(camera_name="agentview", width=256, height=256)
    context.data = original
    np.testing.assert_array_equal(kept, last.images["agentview"])
    assert not np.array_equal(end_of_step, last.images["agentview"])
    environment.step(np.array(WAIT_ACTION), observe=False)  # the segmentation stays with the picture
    np.testing.assert_array_equal(environment.segmentation("agentview"), segmented)


@pytest.mark.thorough
@pytest.mark.simulator
@pytest.mark.libero
def test_episodes_do_not_depend_on_what_ran_before(environment: LiberoEnvironment, episode: list[Observation]) -> None:
    caller_state = np.random.get_state(legacy=False)["state"]["key"].copy()  # noqa: NPY002
    run_episode(environment, 11, 2, ())
    other = environment.initial_state_digest
    again = run_episode(environment, INDEX, len(ACTIONS), OBSERVED)
    assert all(identical(left, right) for left, right in zip(again, episode, strict=True))
    assert environment.initial_state_digest == hashlib.sha256(stored_states()[INDEX].tobytes()).hexdigest() != other
    state = np.random.get_state(legacy=False)["state"]["key"]  # noqa: NPY002
    np.testing.assert_array_equal(state, caller_state)


@pytest.mark.thorough
@pytest.mark.simulator
@pytest.mark.libero
def test_objects_and_their_pixels(environment: LiberoEnvironment, episode: list[Observation]) -> None:
    run_episode(environment, INDEX, 0, ())
    kinds = {thing.name: (thing.kind, thing.of_interest) for thing in environment.objects}
    assert kinds["akita_black_bowl_1"] == kinds["plate_1"] == ("object", True)
    assert kinds["akita_black_bowl_2"] == ("object", False)
    assert kinds["flat_stove_1"] == ("fixture", False)
    assert kinds["robot"] == ("robot", False)
    assert kinds["background"] == ("background", False)
    names = [thing.name for thing in environment.objects]
    for camera in CAMERAS:
        segmentation = environment.segmentation(camera)
        assert segmentation.dtype == np.int32
        assert segmentation.shape == (256, 256)
        shown = {
            names[index]: int(count) for index, count in zip(*np.unique(segmentation, return_counts=True), strict=True)
        }
        for name in ("akita_black_bowl_1", "plate_1", "robot", "background"):
            assert shown[name] > 300, (camera, name)
    plate = environment.segmentation("agentview") == names.index("plate_1")
    assert episode[0].images["agentview"][plate].mean() > 150  # the plate is the lightest thing on the table
    with pytest.raises(UnknownName, match="'agentview'"):
        environment.segmentation("agent_view")


def beginning(suite: str, task_id: int, assets: Path) -> Departures:
    """How the first state of a task departs from the published evaluations."""
    environment = make_environment(find_suite(suite), task_id, EnvironmentSettings(libero_assets=assets))
    assert isinstance(environment, LiberoEnvironment)
    try:
        run_episode(environment, 0, 0, ())
        return environment.departures()
    finally:
        environment.close()


@pytest.mark.libero
@pytest.mark.simulator
def test_scenes_begin_as_published_only_with_the_mujoco_of_the_published_evaluations(libero_assets) -> None:
    found = beginning("libero_spatial", 5, libero_assets)
    if "rest elsewhere" not in what_differs(version("mujoco")):
        assert found == NO_DEPARTURES
        return
    assert found.lost_relations == ("akita_black_bowl_1 on glazed_rim_porcelain_ramekin_1",)
    assert {one.name: one.distance for one in found.displaced} == {
        "akita_black_bowl_1": pytest.approx(0.035, abs=0.002)
    }
    thrown = {one.name: one.distance for one in beginning("libero_10", 7, libero_assets).displaced}
    assert thrown["ketchup_1"] == pytest.approx(0.545, abs=0.005)


def test_what_begins_otherwise_is_told_from_the_stored_beginnings() -> None:
    first, last = (beginning_of("libero_spatial", 5, state) for state in (0, 49))
    assert first is not None
    assert last is not None
    assert ("on", "akita_black_bowl_1", "glazed_rim_porcelain_ramekin_1") in first.relations
    bowl, ramekin = first.places["akita_black_bowl_1"], first.places["glazed_rim_porcelain_ramekin_1"]
    np.testing.assert_allclose(100 * (bowl - ramekin), [-1.45, 0.05, 3.51], atol=0.1)
    assert first.displaced(first.places) == {}
    moved = {**first.places, "plate_1": first.places["plate_1"] + [0.0, 0.03, 0.04], "bowl": np.zeros(3)}
    assert first.displaced(moved) == pytest.approx({"plate_1": 0.05})
    assert set(first.displaced(last.places)) <= set(first.places)
    assert beginning_of("libero_spatial", 5, 50) is beginning_of("made_up", 5, 0) is None
