"""Episodes 0, 1, 2, ... of real LIBERO tasks are those of the published evaluations, bit for bit and in any order."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("libero")
pytest.importorskip("robosuite")

from tests.capture.environments.published_loops import PublishedEpisode, cosmos_loop, lerobot_loop, openpi_loop
from vla_attention.capture.environments.base import EnvironmentSettings
from vla_attention.capture.environments.episode_protocol import (
    CAMERAS,
    LEROBOT,
    OPENPI,
    WAIT_ACTION,
    WAIT_STEPS,
    EvaluationProtocol,
)
from vla_attention.capture.environments.libero import LiberoEnvironment
from vla_attention.capture.environments.suites import find_suite, list_tasks, make_environment
from vla_attention.capture.policies.cosmos.family import COSMOS

pytestmark = [pytest.mark.simulator, pytest.mark.libero, pytest.mark.thorough]

#: Rack, cabinet and stove of the first have no joint. In the others something begins open or switched on.
FURNITURE, DRAWER, STOVE = ("libero_goal", 0), ("libero_10", 3), ("libero_10", 8)
Place = tuple[str, int]


@contextmanager
def environment_of(place: Place, protocol: EvaluationProtocol, assets: Path) -> Iterator[LiberoEnvironment]:
    settings = EnvironmentSettings(protocol, assets)
    made = make_environment(find_suite(place[0]), place[1], settings)
    assert isinstance(made, LiberoEnvironment)
    try:
        yield made
    finally:
        made.close()


def play(environment: LiberoEnvironment, episode: int, seed: int, further_steps: int = 0) -> PublishedEpisode:
    environment.reset(episode, seed)
    simulation = environment._simulator.sim
    placed = simulation.model.body_pos.copy(), simulation.model.body_quat.copy()
    for step in range(WAIT_STEPS):
        observation = environment.step(np.array(WAIT_ACTION), observe=step == WAIT_STEPS - 1).observation
    assert observation is not None
    state = simulation.get_state().flatten().copy()
    for action in np.random.default_rng(episode).uniform(-1, 1, (further_steps, 7)):
        environment.step(action, observe=False)
    return PublishedEpisode(*placed, state, dict(observation.images))


def check(ours: PublishedEpisode, published: PublishedEpisode) -> None:
    np.testing.assert_array_equal(ours.body_pos, published.body_pos)
    np.testing.assert_array_equal(ours.body_quat, published.body_quat)
    np.testing.assert_array_equal(ours.state, published.state)
    for camera in CAMERAS:
        np.testing.assert_array_equal(ours.images[camera], published.images[camera])


#: One task of each suite that is not above; that of libero_object has no furniture.
OTHERS = ("libero_spatial", 7), ("libero_object", 0), ("libero_90", 20)


@pytest.mark.parametrize("place", [FURNITURE, DRAWER, STOVE, *OTHERS])
def test_every_episode_is_that_of_openpi_in_any_order(place: Place, libero_assets: Path) -> None:
    published = openpi_loop(libero_assets, list_tasks(find_suite(place[0]))[place[1]], episodes=4)
    assert np.array_equal(published[0].body_pos, published[1].body_pos) == (place[0] == "libero_object")
    with environment_of(place, OPENPI, libero_assets) as environment:
        for number, episode in enumerate((3, 1, 0, 2)):
            assert environment.missing_resets(episode, 7) == (0 if number else 3)
            check(play(environment, episode, 7, further_steps=3), published[episode])


@pytest.mark.parametrize("place", [FURNITURE, DRAWER])
def test_every_episode_is_that_of_lerobot_in_any_order(place: Place, libero_assets: Path) -> None:
    """The drawer draws further numbers at every reset, and LeRobot resets once before the first episode."""
    published = lerobot_loop(libero_assets, list_tasks(find_suite(place[0]))[place[1]], episodes=3)
    assert published[0].images["agentview"].shape == (360, 360, 3)
    with environment_of(place, LEROBOT, libero_assets) as environment:
        for episode in (2, 0, 1):
            assert environment.missing_resets(episode, LEROBOT.default_seed) == 0
            check(play(environment, episode, LEROBOT.default_seed, further_steps=3), published[episode])
            for camera in CAMERAS:
                assert environment.segmentation(camera).shape == (360, 360)


@pytest.mark.parametrize("place", [FURNITURE, DRAWER])
def test_every_episode_is_that_of_cosmos_whatever_the_seed_of_its_noise(place: Place, libero_assets: Path) -> None:
    published = cosmos_loop(libero_assets, list_tasks(find_suite(place[0]))[place[1]], episodes=3)
    with environment_of(place, COSMOS, libero_assets) as environment:
        for episode, seed in ((2, 7), (0, 195), (1, 7)):
            check(play(environment, episode, seed, further_steps=3), published[episode])


def test_two_seeds_do_not_disturb_each_other(libero_assets: Path) -> None:
    """Every run's seed has resets of its own, and the caller's random numbers stay as they were."""
    before = np.random.get_state(legacy=False)["state"]["key"].copy()  # noqa: NPY002
    with environment_of(FURNITURE, OPENPI, libero_assets) as environment:

        def places(episode: int, seed: int) -> np.ndarray:
            environment.reset(episode, seed)
            return environment._simulator.sim.model.body_pos.copy()

        first = places(1, 7)
        assert environment.missing_resets(1, 8) == 1
        assert not np.array_equal(places(1, 8), first)
        assert (environment.missing_resets(1, 7), environment.missing_resets(4, 7)) == (0, 2)
        np.testing.assert_array_equal(places(1, 7), first)
    np.testing.assert_array_equal(np.random.get_state(legacy=False)["state"]["key"], before)  # noqa: NPY002


def test_an_environment_that_was_told_of_resets_makes_the_same_episodes(libero_assets: Path) -> None:
    """Several simulators of a task tell each other what their resets began with."""
    with environment_of(DRAWER, OPENPI, libero_assets) as first:
        expected = [play(first, episode, 7, further_steps=3) for episode in (0, 1, 2)]
        known = pickle.loads(pickle.dumps(first.known_resets(7)))
    with environment_of(DRAWER, OPENPI, libero_assets) as second:
        assert second.missing_resets(2, 7) == 2
        second.learn_resets(7, known)
        assert (second.missing_resets(2, 7), second.missing_resets(3, 7), second.missing_resets(1, 8)) == (0, 0, 1)
        second.learn_resets(7, known[:1])  # who knows more keeps it
        check(play(second, 2, 7, further_steps=3), expected[2])
