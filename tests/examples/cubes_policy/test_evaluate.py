"""The rollouts of `evaluate`, its table, its file and its mistakes."""

from __future__ import annotations

import pytest

from examples.cubes_policy.__main__ import main
from examples.cubes_policy.evaluate import other_task
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS


def test_a_switched_instruction_names_another_cube_for_the_same_verb() -> None:
    for number, task in enumerate(CUBE_TASKS[:12]):
        other = CUBE_TASKS[other_task(number)]
        assert other.verb == task.verb
        assert other.target != task.target


def refused(capsys, *words: str) -> str:
    assert main(["evaluate", *words]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    return printed


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--workers", "0"), "--workers 0; expected at least 1"),
        (("--replan-steps", "0"), "--replan-steps 0; expected at least 1"),
    ],
)
def test_what_cannot_be_evaluated_is_one_sentence(capsys, words, message) -> None:
    assert message in refused(capsys, "pi05_cubes", *words)
