"""The list of suites and the errors of wrong choices; no simulator is built."""

from __future__ import annotations

import pytest

from vla_attention.capture.environments.base import EnvironmentSettings, check_task_id
from vla_attention.capture.environments.episode_protocol import LEROBOT, OPENPI
from vla_attention.capture.environments.suites import SUITES, find_suite, make_environment
from vla_attention.schemas.errors import BadArgument, UnknownName

SETTINGS = EnvironmentSettings()


def test_published_protocol_numbers() -> None:
    steps = {suite.name: (suite.num_tasks, suite.max_steps) for suite in SUITES if suite.kind == "libero"}
    perturbed = [suite for suite in SUITES if suite.perturbs]
    assert len(perturbed) == 16
    assert all(steps.pop(suite.name) == steps[suite.perturbs] for suite in perturbed)
    assert steps == {
        "libero_spatial": (10, 220),
        "libero_object": (10, 280),
        "libero_goal": (10, 300),
        "libero_10": (10, 520),
        "libero_90": (90, 400),
    }
    assert (OPENPI.image_size, OPENPI.default_seed, OPENPI.replan_steps, dict(OPENPI.max_steps)) == (256, 7, 5, {})
    assert (LEROBOT.image_size, LEROBOT.default_seed, LEROBOT.replan_steps) == (360, 1000, None)
    assert LEROBOT.max_steps == {"libero_spatial": 280}  # its other suites have openpi's numbers


def test_unknown_suite_names_the_nearest() -> None:
    with pytest.raises(UnknownName, match=r"'libero_spacial'.*'libero_spatial'"):
        find_suite("libero_spacial")


def test_task_id_out_of_range_states_the_range() -> None:
    suite = find_suite("libero_goal")
    check_task_id(suite, 9)
    for task_id in (-1, 10):
        with pytest.raises(BadArgument, match=f"Task {task_id} .*libero_goal; .* 0 to 9"):
            check_task_id(suite, task_id)
    with pytest.raises(BadArgument, match="Task 8"):
        make_environment(find_suite("robosuite"), 8, SETTINGS)
