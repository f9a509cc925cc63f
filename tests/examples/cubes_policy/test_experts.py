"""The scripted experts as pure functions of the state: where they go and when they close, lift and let go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from examples.cubes_policy.experts import CLOSED, OPEN, TRAVEL_HEIGHT, TableState, expert_action
from vla_attention.capture.environments.cubes.scene import HALF_SIZE, TABLE_HEIGHT

REST = TABLE_HEIGHT + HALF_SIZE
CUBES = np.array([[0.0, 0.0, REST], [0.1, 0.15, REST], [-0.1, -0.12, REST]])
STATE = TableState(gripper=np.array([-0.1, 0.0, 1.0]), gap=0.079, gap_speed=0.0, upright=np.zeros(3), cubes=CUBES)


def _at(x: float, y: float, z: float, **changes: float) -> TableState:
    return replace(STATE, gripper=np.array([x, y, z]), **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("verb", ["touch", "lift", "push_left", "push_right", "put_on"])
def test_actions_are_within_the_limits_wherever_the_gripper_is(verb: str) -> None:
    places = np.random.default_rng(0).uniform([-0.3, -0.3, 0.8], [0.3, 0.3, 1.2], (200, 3))
    for place in places:
        action = expert_action(verb, _at(*place), 0, 1)  # type: ignore[arg-type]
        assert action.shape == (7,)
        assert np.isfinite(action).all()
        assert (np.abs(action) <= 1.0).all()


def test_a_gripper_far_away_moves_over_the_cubes_and_not_through_them() -> None:
    low = _at(0.1, 0.1, REST + 0.02)
    action = expert_action("touch", low, 0, None)
    assert action[0] < 0
    assert action[1] < 0
    assert action[2] > 0
    over = expert_action("touch", _at(0.0, 0.0, REST + TRAVEL_HEIGHT), 0, None)
    np.testing.assert_allclose(over[:2], 0.0, atol=1e-12)
    assert over[2] == -1.0
    assert over[6] == CLOSED


def test_lifting_opens_above_closes_around_and_rises_with_the_cube() -> None:
    assert expert_action("lift", _at(0.0, 0.0, REST + 0.1), 0, None)[6] == OPEN
    around = expert_action("lift", _at(0.0, 0.0, REST + 0.005), 0, None)
    assert around[6] == CLOSED
    assert abs(around[2]) < 0.2
    held = expert_action("lift", _at(0.0, 0.0, REST, gap=0.045), 0, None)
    assert held[6] == CLOSED
    assert held[2] == 1.0
    still_closing = expert_action("lift", _at(0.0, 0.0, REST, gap=0.06, gap_speed=-0.15), 0, None)
    assert still_closing[2] <= 0.0


@pytest.mark.parametrize(("verb", "side"), [("push_left", 1.0), ("push_right", -1.0)])
def test_pushing_begins_on_the_other_side(verb: str, side: float) -> None:
    beside = expert_action(verb, _at(0.0, -side * 0.05, REST), 0, None)  # type: ignore[arg-type]
    assert side * beside[1] > 0.5
    wrong_side = expert_action(verb, _at(0.0, side * 0.05, REST), 0, None)  # type: ignore[arg-type]
    assert wrong_side[2] > 0.5  # up, and over the cube


def test_a_cube_is_let_go_only_on_the_other_one() -> None:
    on_top = CUBES.copy()
    on_top[0] = [*CUBES[1, :2], REST + 2 * HALF_SIZE]
    held = replace(STATE, gripper=on_top[0].copy(), gap=0.045, cubes=on_top)
    assert expert_action("put_on", held, 0, 1)[6] == OPEN
    in_the_air = on_top.copy()
    in_the_air[0, 2] += 0.05
    above = replace(held, gripper=in_the_air[0].copy(), cubes=in_the_air)
    action = expert_action("put_on", above, 0, 1)
    assert action[6] == CLOSED
    assert action[2] < 0
