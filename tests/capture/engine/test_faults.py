"""Faults of one episode: it is dropped and named, tried once more where that can help, and the run goes on."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.capture.engine.simulators_in_threads import assert_same_episodes, record
from tests.kit.spoiled_policy import spoil_actions
from tests.kit.still_scene import StillScene
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.environments.base import Observation, StepResult
from vla_attention.capture.jobs.status import store_status
from vla_attention.capture.policies.pi.policy import PiPolicy
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.reader import open_store

WORDS = ["--task-id", "0", "--num-episodes", "3"]
#: The waiting steps of the protocol; the step after them is the policy's first.
WAITING = 10
both = pytest.mark.parametrize("num_envs", [1, 2], ids=["serial", "pipelined"])


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Iterator[Path]:
    """The store of three episodes without a fault."""
    with pytest.MonkeyPatch.context() as patch:
        from tests.capture.engine.simulators_in_threads import simulators_in_threads

        simulators_in_threads(patch)
        store = tmp_path_factory.mktemp("whole") / "a.zarr"
        assert record(store, 1, *WORDS) == 0
        yield store


class Faulty(StillScene):
    """Does in episode 1, as often as `faults` says, at the step `at` what `act` says."""

    faults: list[int]
    episodes: tuple[int, ...] = (1,)
    at: int = WAITING + 2

    def reset(self, initial_state_index: int, seed: int) -> None:
        super().reset(initial_state_index, seed)
        self.index, self.steps = initial_state_index, 0

    def step(self, action: np.ndarray, observe: bool) -> StepResult:
        self.steps += 1
        result = super().step(action, observe)
        if self.index in self.episodes and self.steps >= self.at and self.faults[0] > 0:
            changed = self.act(result)
            if changed is not result:
                self.faults[0] -= 1
            return changed
        return result

    def act(self, result: StepResult) -> StepResult:
        raise NotImplementedError


class Raising(Faulty):
    def act(self, result: StepResult) -> StepResult:
        self.faults[0] -= 1
        raise RuntimeError(f"the context\nis lost: {self.faults[0]}")


class RaisingInReset(Faulty):
    """Its first exception has the reason; the last one comes from what that left behind."""

    at = 1000

    def reset(self, initial_state_index: int, seed: int) -> None:
        super().reset(initial_state_index, seed)
        if initial_state_index in self.episodes and self.faults[0] > 0:
            self.faults[0] -= 1
            try:
                raise ValueError("no such state")
            except ValueError:
                raise AttributeError("no attribute '_context'")  # noqa: B904 (as libraries do)


def changed_pictures(result: StepResult, **changes: Any) -> StepResult:
    if result.observation is None:
        return result
    return StepResult(result.success, Observation(**{**vars(result.observation), **changes}))


class Black(Faulty):
    def act(self, result: StepResult) -> StepResult:
        if result.observation is None:
            return result
        images = {**result.observation.images}
        images["agentview"] = np.zeros_like(images["agentview"])
        return changed_pictures(result, images=images)


class StateIsNan(Faulty):
    def act(self, result: StepResult) -> StepResult:
        return changed_pictures(result, eef_pos=np.array([0.1, np.nan, 0.3]))


FAULTS = {
    "raises in a step": (Raising, "the context is lost: "),
    "raises in a reset": (RaisingInReset, "no such state (ValueError, test_faults.py:"),
    "black picture": (
        Black,
        "agentview at replan 1 (environment step 14) of episode task000_episode001",
    ),
    "state": (StateIsNan, "eef_pos at replan 1 (environment step 14) of episode"),
}


def spoil(scene: Any, kind: type[Any], times: int) -> list[int]:
    kind.faults = [times]
    scene.make = kind
    return kind.faults


def check_nothing_is_left(store: Path) -> None:
    assert not (store / ".writing").exists()
    assert analyze(["store", "verify", str(store)]) == 0


@pytest.mark.parametrize(
    ("num_envs", "name"),
    [(1, "raises in a step"), (2, "black picture")],
)
def test_a_fault_that_passes_costs_an_attempt(scene, whole, tmp_path, capsys, num_envs, name):
    kind, sentence = FAULTS[name]
    faults = spoil(scene, kind, 1)
    assert record(tmp_path / "a.zarr", num_envs, *WORDS) == 0
    assert faults == [0]
    said = capsys.readouterr()
    (line,) = [line for line in said.out.split("\n") if sentence in line]
    assert line.startswith("task000_episode001: ")
    assert line.endswith("begins again.")
    assert said.err == ""
    assert "3 episodes added, 0 solved" in said.out
    assert_same_episodes(whole, tmp_path / "a.zarr")
    assert store_status(tmp_path / "a.zarr").complete
    check_nothing_is_left(tmp_path / "a.zarr")


@pytest.mark.parametrize(("num_envs", "name"), [(1, "state"), (2, "raises in a step")])
def test_a_fault_that_stays_costs_the_episode_and_resuming_records_it(scene, whole, tmp_path, capsys, num_envs, name):
    kind, sentence = FAULTS[name]
    store, faults = tmp_path / "a.zarr", spoil(scene, kind, 2)
    assert record(store, num_envs, *WORDS) == 2
    assert faults == [0]
    said = capsys.readouterr()
    assert re.search(r"\b1 of .*: task000_episode001\. ", said.err)
    assert sentence in said.err
    assert "--resume" in said.err
    assert said.err.count("\n") == 1
    (dropped,) = store_status(store).tasks[0].dropped
    assert dropped.episode == "task000_episode001"
    assert sentence in dropped.reason
    assert "2 episodes added, 0 solved, 1 missing" in said.out
    assert [episode.name for episode in open_store(store).episodes] == ["task000_episode000", "task000_episode002"]
    check_nothing_is_left(store)
    assert record(store, num_envs, *WORDS, "--resume") == 0
    assert_same_episodes(whole, store)


@both
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_that_the_third_episode_meets_in_the_same_way_ends_the_run(scene, tmp_path, capsys, num_envs, name):
    kind, sentence = FAULTS[name]
    faults = spoil(scene, type("Always", (kind,), {"episodes": range(9)}), 100)
    assert record(tmp_path / "a.zarr", num_envs, "--task-id", "0", "--num-episodes", "9") == 2
    assert faults[0] >= 100 - 6  # two attempts of each of three episodes at most
    said = capsys.readouterr().err
    assert sentence.partition(" at replan")[0] in said
    assert "3 episodes in a row" in said
    assert said.count("\n") == 1
    check_nothing_is_left(tmp_path / "a.zarr")


@both
def test_numbers_that_turn_nan_cost_their_episode_only(scene, tmp_path, monkeypatch, capsys, num_envs):
    store = tmp_path / "a.zarr"
    spoil_actions(monkeypatch, 7, 0, 1)
    assert record(store, num_envs, *WORDS) == 2
    said = capsys.readouterr()
    assert re.search(r"\b1 of .*: task000_episode001\. .* replan 1 \(environment step 14\) of episode task0", said.err)
    assert said.err.count("\n") == 1
    assert "begins again" not in said.out  # the same input gives the same numbers
    check_nothing_is_left(store)


@both
def test_numbers_that_are_finite_the_second_time_cost_an_attempt(scene, whole, tmp_path, monkeypatch, capsys, num_envs):
    left = spoil_actions(monkeypatch, 7, 0, 1, times=1)
    assert record(tmp_path / "a.zarr", num_envs, *WORDS) == 0
    assert left == [0]
    said = capsys.readouterr().out
    assert "task000_episode001" in said
    assert_same_episodes(whole, tmp_path / "a.zarr")


def test_a_call_of_a_batch_that_turns_nan_costs_its_own_episode(scene, tmp_path, monkeypatch, capsys):
    act = PiPolicy.act_batch
    sizes = []

    def spoiled(self: PiPolicy, inputs: Any, seeds: Any, recorders: Any) -> Any:
        made = [actions.copy() for actions in act(self, inputs, seeds, recorders)]
        sizes.append(len(made))
        for actions, seed in zip(made, seeds, strict=True):
            if seed == self.replan_noise_seed(7, 0, 1, 0):
                actions[0, 0] = np.nan
        return made

    monkeypatch.setattr(PiPolicy, "act_batch", spoiled)
    spoil_actions(monkeypatch, 7, 0, 1, replan=0)  # the call is made again alone
    store = tmp_path / "a.zarr"
    assert record(store, 3, "--task-id", "0", "--num-episodes", "6", "--policy-batch", "3") == 2
    assert ": task000_episode001. " in capsys.readouterr().err
    assert [episode.name for episode in open_store(store).episodes] == [
        f"task000_episode00{episode}" for episode in (0, 2, 3, 4, 5)
    ]
    check_nothing_is_left(store)


@both
def test_a_mistake_of_the_user_ends_the_run(scene, tmp_path, capsys, num_envs):
    class Refusing(StillScene):
        def reset(self, initial_state_index: int, seed: int) -> None:
            raise UserError("The assets are missing; set VLA_LIBERO_ASSETS.")

    scene.make = Refusing
    assert record(tmp_path / "a.zarr", num_envs, *WORDS) == 2
    assert capsys.readouterr().err == "vla-attention capture: The assets are missing; set VLA_LIBERO_ASSETS.\n"
