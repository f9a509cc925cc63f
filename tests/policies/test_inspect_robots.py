"""Inspect Robots 0.60.0, run for real: its own evaluation of its own embodiment, with the example's policy."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("inspect_robots", reason="run by make test-policies, in .venv-transformers")

import inspect_robots as robots
from inspect_robots.mock.cubepick import CubePickEmbodiment

import vla_attention as va
from tests.kit.small_torch_policy import SmallPolicy, given, small_layout
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

TASKS, STEPS, CHUNK = ("pick the bowl", "pick the plate"), 5, 3

path = Path(__file__).resolve().parents[2] / "examples/inspect_robots_policy.py"
spec = importlib.util.spec_from_file_location("inspect_robots_policy", path)
example = importlib.util.module_from_spec(spec)
spec.loader.exec_module(example)


class SmallBrain(robots.PolicyBase):
    """A random network, which fails at the step and trial that it is told."""

    info = robots.PolicyInfo("small", robots.Box((2,)))

    def __init__(self, fails: tuple[int, int] | None = None) -> None:
        self.network, self.fails, self.trial = SmallPolicy(), fails, -1
        self.ended: list[tuple[str, int]] = []

    def reset(self, scene: robots.Scene) -> None:
        self.trial += 1
        self.text = scene.instruction

    def act(self, observation: robots.Observation) -> robots.ActionChunk:
        if self.fails == (self.trial, observation.extra["env_step"]):
            raise ValueError("the network is gone")
        picture = torch.from_numpy(np.ascontiguousarray(observation.images["top"][::4, ::4])).permute(2, 0, 1) / 255
        state = torch.from_numpy(observation.state["eef_pos"]).float()
        noise = given()["noise"]
        actions = self.network.act(picture[None], [self.text], state[None], noise)[0].numpy()
        return robots.ActionChunk([robots.Action(action) for action in actions])

    def on_trial_end(self, record: robots.TrialRecord, log_dir: str, run_id: str) -> None:
        self.ended.append((record.scene_id, record.epoch))


class RecordedBrain(example.RecordedPolicy):
    def frames(self, observation: robots.Observation) -> dict[str, Any]:
        return {"front": observation.images["top"]}

    def state(self, observation: robots.Observation) -> np.ndarray:
        return observation.state["eef_pos"]


def judge(record: robots.TrialRecord, scene: robots.Scene) -> None:
    if scene.id == "right":
        record.operator_judgement = "y"


def evaluate(folder: Path, brain: SmallBrain, *, record: bool = True) -> Any:
    scenes = [robots.Scene(name, text) for name, text in (("left", TASKS[0]), ("right", TASKS[1]), ("far", TASKS[0]))]
    task = robots.Task("noise", scenes, "success_at_end", max_steps=STEPS, epochs=2)
    settings = {"log_dir": str(folder / "logs"), "before_scoring": judge}
    if not record:
        return robots.eval(task, brain, CubePickEmbodiment(goal_radius=0), **settings)[0]
    store = folder / "run.zarr"
    settings_of_run = {"tokenizer": brain.network.tokenizer, "untrained": True, "durable": False}
    with va.record(store, brain.network, layout=small_layout(), resume=store.exists(), **settings_of_run) as run:
        return robots.eval(task, RecordedBrain(brain, run), CubePickEmbodiment(goal_radius=0), **settings)[0]


def facts_of(folder: Path) -> list[tuple[Any, ...]]:
    found = [part.attributes for part in open_store(folder / "run.zarr").episodes]
    return [(part.task_id, part.episode_index, part.instruction, part.success) for part in found]


def test_every_trial_is_in_the_store_once_with_its_outcome(tmp_path):
    brain = SmallBrain()
    log = evaluate(tmp_path, brain)
    assert (log.status, log.results.total_trials) == ("success", 6)
    assert brain.ended == [(name, epoch) for name in ("left", "right", "far") for epoch in range(2)]
    store = open_store(tmp_path / "run.zarr")
    assert verify_store(store) == []
    trials = [(0, number, TASKS[0], False) for number in range(4)]
    assert facts_of(tmp_path) == [*trials, *((1, number, TASKS[1], True) for number in range(2))]
    assert {part.attributes.num_steps for part in store.episodes} == {STEPS}
    assert all(tuple(part.read("env_step")) == (0, CHUNK) for part in store.episodes)
    # Once more into the same store: nothing is recorded a second time.
    evaluate(tmp_path, SmallBrain())
    assert len(facts_of(tmp_path)) == 6


def test_actions_are_those_of_the_same_policy_alone(tmp_path):
    alone, recorded = evaluate(tmp_path / "alone", SmallBrain(), record=False), evaluate(tmp_path, SmallBrain())
    assert [result.reduced for result in alone.samples] == [result.reduced for result in recorded.samples]
    written = [sorted((folder / "logs").rglob("*.jsonl")) for folder in (tmp_path / "alone", tmp_path)]
    texts = [[file.read_text().split("\n", 1)[1] for file in files] for files in written]
    assert texts[0] == texts[1] != []
    stored = open_store(tmp_path / "run.zarr").episodes[0]
    np.testing.assert_array_equal(stored.read("state")[0], CubePickEmbodiment().start)


def test_a_trial_that_ends_with_an_error_is_dropped(tmp_path):
    log = evaluate(tmp_path, SmallBrain(fails=(1, CHUNK)))
    assert log.results.errored_trials == 1
    assert [(task, number) for task, number, *_ in facts_of(tmp_path)] == [(0, 0), (0, 2), (0, 3), (1, 0), (1, 1)]


def test_an_operator_who_ends_a_trial_without_a_verdict_leaves_its_outcome_open():
    policy = example.RecordedPolicy(SmallBrain(), None)
    record = robots.TrialRecord("left", 0, 0, terminated=True, termination_reason=robots.OPERATOR_END)
    assert policy.success(record) is None
    record.operator_judgement = "n"
    assert policy.success(record) is False
