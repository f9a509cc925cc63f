"""Changes of actions, and the units that they are told in, against arithmetic by hand."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

import vla_attention as va
from tests.kit.archives import unpacked
from tests.kit.paths import GOLDEN
from tests.kit.site_stores import write_site_store
from tests.kit.stores import small_effects, write_store
from vla_attention.analyze.core.action_changes import (
    EFFECT,
    Part,
    action_spread,
    first_angle,
    hand_and_gripper,
    parse_units,
    parts_of_names,
    units_of,
)
from vla_attention.analyze.core.hand_movements import Commands, fitted, rotation_vectors
from vla_attention.schemas.episode_steps import POSES
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import CorruptEpisode

GENERATOR = np.random.default_rng(0)


def part(how, scale=(2.0, 2.0, 2.0)):
    return Part(EFFECT, "t", "{}", np.arange(len(scale)), np.array(scale), how)


def test_a_change_is_of_the_steps_that_count():
    base, other = GENERATOR.normal(size=(2, 2, 4, 7))
    steps = np.array([1, 3])
    change = 2 * (other - base)[..., :3]
    ends = [np.linalg.norm(change[i, :n].sum(axis=0)) for i, n in enumerate(steps)]
    means = [np.sqrt((change[i, :n] ** 2).mean()) for i, n in enumerate(steps)]
    np.testing.assert_allclose(part("end").of(base, other, steps), ends)
    np.testing.assert_allclose(part("mean").of(base, other, steps), means)


def test_each_dimension_has_its_own_scale():
    base, other = np.zeros((2, 1, 2, 7))
    other[..., :2] = [1.0, 10.0]
    assert part("mean", (3.0, 0.1)).of(base, other, np.array([2])).tolist() == [np.sqrt((9 + 1) / 2)]


def test_flips_are_counted_over_executed_steps():
    base, other = np.zeros((2, 2, 4, 7))
    base[..., -1] = 1
    other[..., -1] = [[-1, 1, 1, -1], [0, -0.2, 1, 1]]  # a command of 0 leaves the gripper as it is
    gripper = replace(part("opposite", (1.0,)), dimensions=np.array([6]))
    assert gripper.of(base, other, np.array([3, 4])).tolist() == [1 / 3, 1 / 4]


def test_the_angle_is_that_of_the_first_translations():
    base, other = np.zeros((2, 4, 2, 7))
    base[:, 0, :3] = [1, 0, 0]
    other[:, 0, :3] = [[2, 0, 0], [0, 3, 0], [-1, 0, 0], [0, 0, 0]]
    other[:, 1, :3] = 9  # later steps do not matter
    np.testing.assert_allclose(first_angle(base, other), [0, 90, 180, np.nan])


def quaternion(axis, angle):
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis))])


def product(one, two):
    """one x two: first two, then one."""
    w, v, x, u = one[0], one[1:], two[0], two[1:]
    return np.array([w * x - v @ u, *(w * u + x * v + np.cross(v, u))])


@pytest.mark.parametrize("sign", [1, -1])
def test_turns_are_around_the_axes_of_the_world(sign):
    start = quaternion([0.6, 0.0, 0.8], 1.1)
    turned = product(quaternion([0, 1, 0], 0.3), start)
    np.testing.assert_allclose(rotation_vectors(np.array([start, sign * turned])), [[0, 0.3, 0]], atol=1e-12)
    assert rotation_vectors(np.array([start, start])).tolist() == [[0, 0, 0]]


def test_a_fit_explains_what_is_left_out():
    told = [GENERATOR.normal(size=(20, 3)) for _ in range(4)]
    exact = fitted([(one, 0.02 * one) for one in told])
    assert (exact.factor, exact.explained) == pytest.approx((0.02, 1.0))
    assert exact.error < 1e-12
    noisy = [(one, 0.02 * one + GENERATOR.normal(size=one.shape) * 0.02) for one in told]
    found = fitted(noisy)
    # By hand: each episode's movements against what the other three say.
    left = 0.0
    for i, (one, moved) in enumerate(noisy):
        x, y = (np.concatenate([pair[side] for j, pair in enumerate(noisy) if j != i]) for side in (0, 1))
        left += ((moved - (x * y).sum() / (x**2).sum() * one) ** 2).sum()
    assert found.explained == pytest.approx(1 - left / sum((moved**2).sum() for _, moved in noisy))
    assert found.explained == pytest.approx(0.5, abs=0.1)
    assert fitted([(np.zeros((5, 3)), told[0][:5])] * 2) is None


@pytest.mark.parametrize(("noise", "named"), [(0.1, ["effect", "turn", "gripper"]), (0.6, None)])
def test_centimetres_only_where_commands_explain_how_the_hand_moves(noise, named):
    told = GENERATOR.normal(size=(5, 30, 3))
    moved = 0.02 * (told + noise * GENERATOR.normal(size=told.shape))
    commands = [Commands(*of, *of) for of in zip(moved, told, strict=True)]
    found = hand_and_gripper(commands)
    assert named == (None if found is None else list(found.names))
    if found is not None:
        assert found.centimetres == pytest.approx(2.0, rel=0.05)
        assert found.parts[1].scale[0] == pytest.approx(np.degrees(0.02), rel=0.05)


def test_the_hand_of_the_shipped_policy_ends_elsewhere_by_the_centimetres_of_its_steps():
    """Of the raw arrays: factor, change and noise of one word, as the document about this policy has them."""
    store = va.open(va.example("cubes"))
    found = store.effects()["effects_items"].filter(label="'blue'").row(0, named=True)
    noise = store.effects()["effects_items"].filter(kind="noise").row(0, named=True)
    assert (found["effect"], found["turn"], found["gripper"]) == pytest.approx((6.9, 0.96, 0.0), abs=0.05)
    assert (noise["effect"], noise["turn"], noise["gripper"]) == pytest.approx((0.79, 0.39, 0.0), abs=0.05)


def test_units_are_those_of_the_whole_store_whatever_is_selected():
    store = va.open(va.example("cubes"))
    one = store.effects(tasks=2)["effects"]
    every = store.effects()["effects"].filter(task_id=2)
    assert one["effect"].to_list() == pytest.approx(every["effect"].to_list(), rel=1e-9)


def test_an_episode_whose_steps_are_damaged_is_left_out_of_the_units_if_asked(tmp_path):
    broken, whole = tmp_path / "broken.zarr", tmp_path / "whole.zarr"
    for path in (broken, whole):
        shutil.copytree(va.example("cubes"), path)
    name = "episodes/task000_episode000"
    (chunk,) = [file for file in (broken / name / POSES).rglob("*") if file.is_file() and file.name != "zarr.json"]
    chunk.write_bytes(bytes(byte ^ 1 for byte in chunk.read_bytes()))
    shutil.rmtree(whole / name)
    with pytest.raises(CorruptEpisode, match="task000_episode000"):
        units_of([open_store(broken)])
    assert units_of([open_store(broken)], skip_corrupt=True).notes == units_of([open_store(whole)]).notes


@pytest.mark.parametrize(
    ("name", "parts", "centimetres"),
    [("cosmos", 3, 1.27), ("cubes", 3, 1.17), ("libero", 1, None), ("replay", 1, None)],
    ids=["Cosmos in robosuite", "pi in cubes", "a controller that no factor explains", "a data set, without steps"],
)
def test_stores_tell_how_their_commands_move_the_hand(name, parts, centimetres):
    """robosuite's controller moves the hand by some part of 5 cm for a command of 1, whatever policy commands."""
    units = units_of([open_store(unpacked(GOLDEN / "tables/stores" / f"{name}.tar.xz"))])
    assert len(units.parts) == parts
    assert units.centimetres == pytest.approx(centimetres, abs=0.01)


def test_without_steps_effects_are_in_the_policys_normalised_actions(tmp_path):
    path = write_store(tmp_path / "a.zarr", plant_effects=small_effects)
    units = units_of([open_store(path)])
    assert units.names == (EFFECT, "gripper")
    assert units.parts[0].dimensions.tolist() == [*range(6)]
    assert units.parts[0].scale.tolist() == [0.5] * 6  # 1 of the policy's is 2 of the robot's


def test_of_the_callers_own_loop_nobody_knows_units_but_the_user(tmp_path):
    path = write_site_store(tmp_path / "a.zarr", protocol="recorded")
    store = open_store(path)
    actions = np.concatenate([one.read("actions").reshape(-1, one.read("actions").shape[-1]) for one in store.episodes])
    spread = units_of([store])
    np.testing.assert_allclose(spread.parts[0].scale, 1 / actions.std(axis=0), rtol=1e-6)
    assert spread.names == (EFFECT,)
    arms = units_of([store], ["left=0-1:rad", "right=2:rad"])
    assert arms.names == (EFFECT, "change_right")
    assert [one.dimensions.tolist() for one in arms.parts] == [[0, 1], [2]]
    assert arms.said("0.2") == "left changes by 0.2 rad"


def test_names_of_a_data_sets_actions_tell_two_arms_apart():
    names = ["left_waist.pos", "left_elbow.pos", "left_gripper.pos", "right_waist.pos", "right_gripper.pos"]
    parts = [*parts_of_names(names, np.array([1.0, 2.0, 3.0, 4.0, 5.0]))]
    assert [part.name for part in parts] == [EFFECT, "change_left_gripper", "change_right_arm", "change_right_gripper"]
    assert [part.dimensions.tolist() for part in parts] == [[0, 1], [2], [3], [4]]
    assert [part.scale.tolist() for part in parts] == [[1, 2], [3], [4], [5]]
    assert [part.dimensions.tolist() for part in parts_of_names(["shoulder", "elbow"], np.ones(2))] == [[0, 1]]


@pytest.mark.parametrize(
    "group", ["arm", "arm=", "arm=a-b", "arm=0-7:rad", "a b=0", "=0-2", "arm=5-2", "arm=0-1-2", "arm=0-99999999999"]
)
def test_units_that_fit_no_action_are_refused(group):
    with pytest.raises(BadArgument, match="--units"):
        list(parse_units([group], 7))


def test_spread_is_the_standard_deviation_over_all_replans_and_steps():
    scales = np.array([0.5, 0.01, 0.0, 1.0])
    actions = [GENERATOR.normal(size=(replans, 4, 4)) * scales for replans in (3, 50)]
    found = action_spread(actions)
    np.testing.assert_allclose(found.spread, np.concatenate([a.reshape(-1, 4) for a in actions]).std(axis=0))
    # 0.01 is about 1% of the largest: what is below that is no movement.
    assert found.used[[0, 3]].all()
    assert 2 in found.left_out
