"""The table of `evaluate`."""

from __future__ import annotations

import pytest

from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS
from vla_attention.capture.small_policy.evaluate_command import describe, wilson
from vla_attention.capture.small_policy.rollouts import Outcome, other_task


def test_wilsons_interval_is_the_published_one() -> None:
    # Newcombe 1998, table I: 81 of 263 and 0 of 20, to four digits.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


def test_the_table_counts_successes_and_first_touches() -> None:
    outcomes = [
        Outcome(3, 0, "normal", True, 30, "red_cube", "red_cube"),
        Outcome(3, 1, "normal", False, 150, "blue_cube", "red_cube"),
        Outcome(4, 0, "normal", True, 40, None, "green_cube"),
    ]
    lines = describe(outcomes).splitlines()
    assert lines[1].split()[:3] == ["lift_red", "2", "50.0%"]
    assert lines[2].split()[:3] == ["lift_green", "1", "100.0%"]
    assert lines[3].startswith("all")
    assert "66.7%" in lines[3]
    assert "33.3%" in lines[3]


def test_a_switched_instruction_names_another_cube_for_the_same_verb() -> None:
    for number, task in enumerate(CUBE_TASKS[:12]):
        other = CUBE_TASKS[other_task(number)]
        assert other.verb == task.verb
        assert other.target != task.target
