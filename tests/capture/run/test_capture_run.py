"""From arguments to the protocol and the tasks of a run; nothing is simulated."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from vla_attention.capture.commands.arguments import build_parser
from vla_attention.capture.environments.episode_protocol import LEROBOT, OPENPI, EvaluationProtocol
from vla_attention.capture.policies.cosmos.family import COSMOS
from vla_attention.capture.policies.policy import Policy
from vla_attention.capture.run.capture_run import lines_on_physics, plan_protocol
from vla_attention.capture.run.run_settings import RunSettings, run_settings
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.libero_physics import MEND, PUBLISHED_MUJOCO
from vla_attention.schemas.stores.store_format import Protocol


def settings_of(*words: str) -> RunSettings:
    return run_settings(build_parser().parse_args([*words, "--output", "a.zarr"]))


def protocol_of(own: EvaluationProtocol, *words: str, family: str = "pi") -> Protocol:
    """The protocol of a policy whose ecosystem evaluates with `own` and executes 10 actions."""
    settings = settings_of(family, *words)
    policy = cast(Policy, SimpleNamespace(default_protocol=own, default_replan_steps=10))
    return plan_protocol(settings, settings.protocol or own, policy)


@pytest.mark.parametrize(
    ("own", "words", "expected"),
    [
        (OPENPI, (), ("openpi", 7, 256, 10, 220)),
        (LEROBOT, (), ("lerobot", 1000, 360, 10, 280)),
        (OPENPI, ("--protocol", "openpi"), ("openpi", 7, 256, 10, 220)),
        # openpi's client executes five actions of any policy; LeRobot takes as many as the checkpoint states.
        (LEROBOT, ("--protocol", "openpi"), ("openpi", 7, 256, 5, 220)),
        (OPENPI, ("--protocol", "lerobot"), ("lerobot", 1000, 360, 10, 280)),
        (LEROBOT, ("--seed", "3", "--max-steps", "20", "--replan-steps", "2"), ("lerobot", 3, 360, 2, 20)),
    ],
)
def test_the_checkpoint_chooses_the_protocol_and_options_override_it(own: Any, words: Any, expected: Any) -> None:
    planned = protocol_of(own, "--task-suite", "libero_spatial", *words)
    assert planned.wait_steps == 10
    shown = (planned.name, planned.seed, planned.image_size, planned.replan_steps, planned.max_steps)
    assert shown == expected


def test_a_capture_in_libero_begins_with_what_its_mujoco_changes() -> None:
    def lines(suite: str, mujoco: str) -> list[str]:
        return lines_on_physics({"mujoco": mujoco}, protocol_of(OPENPI, "--task-suite", suite))

    (told,) = lines("libero_spatial", "3.8.1")
    assert MEND in told
    assert lines("libero_spatial", PUBLISHED_MUJOCO) == lines("cubes", "3.8.1") == []


def test_a_family_with_one_protocol_has_no_option_for_it() -> None:
    assert protocol_of(COSMOS, family="cosmos").name == "cosmos"
    with pytest.raises(SystemExit):
        settings_of("cosmos", "--protocol", "openpi")


def test_several_tasks_are_run_once_each_in_order() -> None:
    assert settings_of("pi").task_ids is None
    assert settings_of("pi", "--task-id", "4").task_ids == (4,)
    assert settings_of("pi", "--task-id", "5", "0", "3", "5").task_ids == (0, 3, 5)
    with pytest.raises(BadArgument, match=r"Task 17 .*cubes; .* 0 to 16"):
        settings_of("pi", "--task-id", "0", "17")
