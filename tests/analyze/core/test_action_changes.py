"""Changes of actions against arithmetic by hand."""

from __future__ import annotations

import numpy as np
import pytest

from vla_attention.analyze.core.action_changes import (
    Noise,
    action_spread,
    first_angle,
    gripper_flips,
    noise_of,
    root_mean_square_change,
    with_noise,
)


def test_spread_is_the_standard_deviation_over_all_replans_and_steps():
    generator = np.random.default_rng(0)
    scales = np.array([0.5, 0.01, 0.0, 1.0])
    actions = [generator.normal(size=(replans, 4, 4)) * scales for replans in (3, 50)]
    found = action_spread(actions)
    np.testing.assert_allclose(found.spread, np.concatenate([a.reshape(-1, 4) for a in actions]).std(axis=0))
    # 0.01 is about 1% of the largest: what is below that is no movement.
    assert found.used[[0, 3]].all()
    assert 2 in found.left_out


def test_a_change_is_in_units_of_the_spread_over_the_steps_that_count():
    actions = [np.array([[[0.0, 10.0], [2.0, 30.0]]])]  # spreads 1 and 10
    spread = action_spread(actions)
    np.testing.assert_allclose(spread.spread, [1, 10])
    base = np.zeros((2, 3, 2))
    other = base.copy()
    other[:, 0] = [1, 10]  # one spread in both dimensions
    other[:, 1] = [3, 10]
    other[:, 2] = [50, 50]
    changed = root_mean_square_change(base, other, spread, np.array([1, 2]))
    assert changed == pytest.approx([1.0, np.sqrt((1 + (9 + 1) / 2) / 2)])


def test_dimensions_that_are_left_out_change_nothing():
    spread = action_spread([np.array([[[0.0, 5.0], [2.0, 5.0]]])])
    base = np.zeros((1, 2, 2))
    other = base + np.array([0.0, 100.0])
    assert root_mean_square_change(base, other, spread, np.array([2])).tolist() == [0.0]


def test_the_angle_is_that_of_the_first_translations():
    base = np.zeros((4, 2, 7))
    other = np.zeros((4, 2, 7))
    base[:, 0, :3] = [1, 0, 0]
    other[:, 0, :3] = [[2, 0, 0], [0, 3, 0], [-1, 0, 0], [0, 0, 0]]
    other[:, 1, :3] = 9  # later steps do not matter
    np.testing.assert_allclose(first_angle(base, other), [0, 90, 180, np.nan])


def test_flips_are_counted_over_executed_steps():
    base = np.zeros((2, 4, 7))
    other = np.zeros((2, 4, 7))
    base[..., -1] = 1
    other[..., -1] = [[-1, 1, 1, -1], [0, -0.2, 1, 1]]  # a command of 0 leaves the gripper as it is
    assert gripper_flips(base, other, np.array([3, 4])).tolist() == [1 / 3, 1 / 4]


def test_a_dimension_that_is_mostly_noise_is_left_out():
    generator = np.random.default_rng(3)
    signal, noise = np.array([1.0, 0.1, 1.0]), np.array([0.05, 0.2, 0.5])
    shape = (200, 5, 3)
    moved = generator.normal(size=shape) * signal
    base, other = (moved + generator.normal(size=shape) * noise for _ in range(2))
    spread = action_spread([base])
    episodes = [slice(0, 50), slice(50, 120), slice(120, None)]
    change = noise_of([(base[part], other[part]) for part in episodes], spread.spread)
    np.testing.assert_allclose(change.change, np.sqrt(2) * noise / np.hypot(signal, noise), rtol=0.06)
    assert with_noise(spread, change).left_out == (1,)
    assert with_noise(spread, change).reasons == ("", "mostly noise", "")
    # A single episode has no interval, and two that differ have a wide one: nothing is left out by chance.
    assert with_noise(spread, noise_of([(base, other)], spread.spread)).left_out == ()
    near = Noise(np.array([0.3, 1.086, 0.4]), np.array([0.2, 0.948, 0.3]), np.array([0.4, 1.2, 0.5]))
    assert with_noise(spread, near).left_out == ()
    # Where everything is mostly noise, everything is kept.
    alone = Noise(*(np.array([value] * 3) for value in (2.0, 1.5, 2.5)))
    assert with_noise(spread, alone).left_out == ()
