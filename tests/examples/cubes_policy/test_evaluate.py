"""The rollouts of `evaluate`, its table, its file and its mistakes."""

from __future__ import annotations

import json
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest

from examples.cubes_policy import evaluate
from examples.cubes_policy.__main__ import main
from examples.cubes_policy.engine import cubes_protocol
from examples.cubes_policy.evaluate import Evaluation, Outcome, describe, other_task, run_episode
from vla_attention.capture.environments.base import StepResult, Task
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS
from vla_attention.capture.environments.episode_protocol import WAIT_STEPS


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


class FakeTable:
    """An environment that counts steps and is never solved; it notes at which step the task was switched."""

    named_cube, first_touched, initial_state_digest, objects = "red_cube", None, "", ()

    def __init__(self) -> None:
        self.steps, self.switched_at = -WAIT_STEPS, []

    def give_task(self, task) -> None:
        pass

    def reset(self, initial_state_index: int, seed: int) -> None:
        pass

    def step(self, action, observe: bool) -> StepResult:
        self.steps += 1
        return StepResult(False, object() if observe else None)

    def switch_task(self, task) -> None:
        self.switched_at.append((self.steps, task.name))


class FakePolicy:
    """Gives ten actions a call and notes the instructions it is given."""

    def __init__(self) -> None:
        self.read = []

    def prepare(self, observation, instruction: str) -> SimpleNamespace:
        self.read.append(instruction)
        return SimpleNamespace(given=None)

    def replan_noise_seed(self, *numbers: int) -> int:
        return 0

    def act(self, policy_input, noise_seed: int) -> np.ndarray:
        return np.zeros((10, 7))


@pytest.mark.parametrize(("replan_steps", "step"), [(5, 10), (4, 12), (10, 10), (7, 14)])
def test_the_instruction_is_switched_once_whatever_the_number_of_actions_of_a_call(replan_steps, step) -> None:
    table, policy = FakeTable(), FakePolicy()
    task = Task("cubes", 3, "lift_red", "lift the red cube", 50)
    run_episode(table, policy, task, 0, cubes_protocol("cubes", 7, replan_steps, 40), "switched")
    assert table.switched_at == [(step, "lift_green")]
    before = -(-step // replan_steps)
    assert policy.read[: before + 1] == ["lift the red cube"] * before + ["lift the green cube"]
    assert policy.read[-1] == "lift the green cube"


def refused(capsys, *words: str) -> str:
    assert main(["evaluate", *words]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    return printed


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--workers", "0"), "--workers 0; expected at least 1"),
        (("--episodes", "0"), "--episodes 0; expected at least 1"),
        (("--max-steps", "0"), "--max-steps 0; expected at least 1"),
        (("--replan-steps", "0"), "--replan-steps 0; expected at least 1"),
        (("--replan-steps", "11"), "--replan-steps 11: a policy call of 'pi05_cubes' gives 10 actions"),
        (("--seed", "-1"), "--seed -1; expected at least 0"),
        (("--suite", "libero_10"), "cubes, cubes_harder, cubes_marked, cubes_mark_only"),
        (("--output", "/nowhere/rates.json"), "there is no folder '/nowhere'"),
        (("--episodes", "51"), "Initial state 50 does not exist"),
        (("--condition", "switched", "--task-id", "12"), "(lift_leftmost) with another colour"),
    ],
)
def test_what_cannot_be_evaluated_is_one_sentence(capsys, words, message) -> None:
    assert message in refused(capsys, "pi05_cubes", *words)


def test_a_wrong_checkpoint_is_found_before_any_process_starts(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(evaluate, "share_among_processes", None)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    assert "There is no checkpoint folder at '/nowhere'" in refused(capsys, "/nowhere")
    assert "'empty' is not a pi checkpoint" in refused(capsys, "empty")


def test_a_file_of_another_evaluation_is_not_continued(tmp_path, capsys) -> None:
    path = tmp_path / "rates.json"
    evaluation = Evaluation("pi05_cubes", "cubes", 150, None, 7)
    outcome = Outcome(3, 0, "normal", True, 30, "red_cube", "red_cube")
    evaluate._write(path, evaluation, [outcome])
    words = ["--task-id", "3", "--episodes", "1", "--output", str(path)]
    assert main(["evaluate", "pi05_cubes", *words]) == 0
    assert "lift_red" in capsys.readouterr().out
    assert "checkpoint pi05_cubes, not other" in refused(capsys, "other", *words)
    assert "seed 7, not 8" in refused(capsys, "pi05_cubes", "--seed", "8", *words)
    path.write_text(json.dumps([asdict(outcome)]))
    assert "did not say what its episodes are of" in refused(capsys, "pi05_cubes", *words)
