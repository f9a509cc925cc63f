"""What is said of the MuJoCo that simulated a LIBERO store, and of scenes that did not begin as their task says."""

from __future__ import annotations

from dataclasses import replace

import pytest
from msgspec import structs

from tests.kit.stores import StoreSpec, small_steps, write_store
from vla_attention.schemas.episode_steps import Displaced
from vla_attention.schemas.libero_physics import MEND, PUBLISHED_MUJOCO, SimulatedScenes, simulated_with, what_differs
from vla_attention.schemas.stores.reader import open_store

LOST = ("bowl on ramekin",)


@pytest.mark.parametrize(
    ("version", "rests", "floors"),
    [
        (PUBLISHED_MUJOCO, False, False),
        ("3.2.3", False, False),
        ("3.2.7", False, False),
        ("3.3.3", False, True),
        ("3.3.7", False, True),
        ("3.4.0", True, True),
        ("3.8.1", True, True),
        ("3.10.0rc1", True, True),
        ("4.0.0", True, True),
        ("absent", False, False),
        ("", False, False),
    ],
)
def test_objects_rest_elsewhere_from_3_4_on_and_floors_are_darker_from_3_3_3_on(version, rests, floors):
    assert ("rest elsewhere" in what_differs(version), "darker" in what_differs(version)) == (rests, floors)


def scenes(tmp_path, suite, versions, lost, displaced=None):
    """What is said of a store whose episodes have these versions, lost relations and displaced objects."""

    def plant(spec, task, episode, steps):
        made = small_steps(spec, task, episode, steps)
        return replace(
            made,
            attributes=structs.replace(
                made.attributes,
                mujoco=versions[episode],
                lost_relations=lost[episode],
                displaced=(displaced or {}).get(episode, ()),
            ),
        )

    store = open_store(
        write_store(
            tmp_path / "a.zarr", spec=StoreSpec(suite=suite, tasks=(0,), episodes=len(versions), plant_steps=plant)
        )
    )
    found = SimulatedScenes()
    for episode in store.episodes:
        found.add(store.attributes.protocol, episode.attributes)
    return found.describe("a.zarr")


@pytest.mark.parametrize(
    ("suite", "versions", "lost", "numbers"),
    [
        ("libero_spatial", ["3.8.1", "3.8.1"], [LOST, LOST], ["MuJoCo 3.8.1 (", MEND, "in 2 of 2 episodes"]),
        ("libero_spatial", ["3.8.1", PUBLISHED_MUJOCO], [(), ()], ["MuJoCo 3.8.1 in 1 of 2 episodes", MEND]),
        (
            "libero_pro_goal_swap",
            ["3.3.7", "3.8.1"],
            [(), LOST],
            ["3.3.7, 3.8.1", "rest elsewhere", "in 1 of 2 episodes"],
        ),
        ("libero_spatial", [PUBLISHED_MUJOCO, ""], [LOST, ()], ["in 1 of 2 episodes", "bowl on ramekin"]),
        ("libero_spatial", [PUBLISHED_MUJOCO, ""], [(), ()], None),
        ("cubes", ["3.8.1", "3.8.1"], [(), ()], None),
    ],
)
def test_a_store_is_told_by_its_episodes(tmp_path, suite, versions, lost, numbers):
    said = scenes(tmp_path, suite, versions, lost)
    assert all(number in said for number in numbers or [])
    assert bool(said) == (numbers is not None)
    assert (MEND in said) == any(version not in ("", PUBLISHED_MUJOCO) for version in versions if suite != "cubes")


def test_without_steps_only_a_callers_own_loop_had_the_simulator(tmp_path):
    store = open_store(write_store(tmp_path / "a.zarr", suite="libero_10", tasks=(0,), episodes=1))
    protocol = store.attributes.protocol
    episode = structs.replace(store.episodes[0].attributes, provenance={"mujoco": "3.8.1"})
    for loop, version in {"recorded": "3.8.1", "dataset": "", "openpi": ""}.items():
        assert simulated_with(structs.replace(protocol, name=loop), episode) == version
    assert simulated_with(structs.replace(protocol, name="recorded", suite="mine"), episode) == ""


def test_displaced_objects_are_told_the_farthest_first(tmp_path):
    near, far = (Displaced("ketchup", 0.05), Displaced("milk", 0.3)), (Displaced("ketchup", 0.54),)
    said = scenes(tmp_path, "libero_10", ["3.8.1"] * 3, [()] * 3, {0: near, 2: far})
    assert "in 2 of 3 episodes" in said
    assert "(ketchup by 54 cm, milk by 30 cm)" in said
