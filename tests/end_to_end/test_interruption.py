"""SIGTERM during a capture, and captures that share a store: a real process and real simulators."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest

from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.jobs.status import store_status
from vla_attention.capture.published.evaluate import evaluate
from vla_attention.schemas.stop_signals import EXIT_TERMINATED
from vla_attention.schemas.stores.locks import episode_locks

pytestmark = [pytest.mark.simulator, pytest.mark.thorough]

DUMMY = ["pi", "--checkpoint", "untrained-tiny", "--task-suite", "robosuite", "--replan-steps", "4", "--task-id", "0"]
DUMMY += ["--num-envs", "1"]  # several simulators: tests/capture/engine/test_pipeline.py


def test_sigterm_drops_the_episode_in_flight_and_resuming_completes_the_store(tmp_path):
    store = tmp_path / "a.zarr"
    arguments = [*DUMMY, "--num-episodes", "3", "--max-steps", "32", "--output", str(store)]
    log = tmp_path / "log"

    def in_a_later_episode() -> bool:
        names = [holder.name for holder in episode_locks(store).holders()]
        partial = list((store / ".writing").glob("task*-*"))
        return len(names) == len(partial) == 1 and partial[0].name.startswith(f"{names[0]}-") and names[0][-1] != "0"

    with log.open("w") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "vla_attention.capture", *arguments],
            stdout=out,
            stderr=subprocess.STDOUT,
            env=os.environ | {"MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"), "SLURM_JOB_ID": ""},
        )
        until = time.monotonic() + 120
        while not in_a_later_episode():
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < until, log.read_text()
            time.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == EXIT_TERMINATED, log.read_text()
    printed = log.read_text()
    dropped = re.search(r"SIGTERM: .*task000_episode00([12]) at step", printed)
    assert dropped, printed
    number = int(dropped[1])  # on a busy machine the signal may come an episode later
    committed = {
        1: "1 episode (task000_episode000); 2 of this process's 3",
        2: "2 episodes (task000_episode000, task000_episode001); 1 of this process's 3",
    }
    assert committed[number] in printed
    assert "Traceback" not in printed
    assert "\r" not in printed  # no progress bar in a file
    assert not (tmp_path / "a.zarr.partial").exists()
    assert not (store / ".writing").exists()
    (task,) = store_status(store).tasks
    assert (task.committed, task.expected, task.missing) == (number, 3, tuple(range(number, 3)))
    assert f"process {process.pid}" in task.last_by

    assert capture([*arguments, "--resume"]) == 0
    assert analyze(["store", "verify", str(store)]) == 0
    assert store_status(store).complete


def test_array_tasks_fill_one_store_and_the_analysis_comes_last(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, value in {"MIN": "0", "MAX": "1", "STEP": "1", "COUNT": "2"}.items():
        monkeypatch.setenv(f"SLURM_ARRAY_TASK_{name}", value)
    arguments = ["--checkpoint", "untrained-tiny", "--task-suite", "robosuite", "--num-episodes", "1"]
    short = ["--replan-steps", "4", "--max-steps", "8"]
    folder = tmp_path / "results/attention_ratio_robosuite"
    store = folder / "robosuite.zarr"
    assert evaluate("evaluate-attention-ratio", [*arguments, *short, "--array-index", "0"]) == 0
    assert not list(folder.glob("*.json"))
    assert [(task.task_id, task.committed, task.expected) for task in store_status(store).tasks] == [
        (0, 1, 1),
        (1, 0, 1),  # belongs to an array task that has not started
    ]
    assert evaluate("evaluate-attention-ratio", [*arguments, "--stage", "analyze"]) == 0
    assert re.search("task 1 .*1 of 1 .*: 0", capsys.readouterr().out)
    assert evaluate("evaluate-attention-ratio", [*arguments, *short, "--array-index", "1"]) == 0
    assert store_status(store).complete
    for layers in (("0",), ("1", "5")):
        assert evaluate("evaluate-attention-ratio", [*arguments, "--stage", "analyze", "--layers", *layers]) == 0
        name = "attention_ratio_results_robosuite.json"
        results = json.loads((folder / name).read_text())
        assert [item["task_id"] for item in results] == [0, 1]
        assert set(results[0]["summary"]) == {f"layer_{layer}" for layer in layers} | {"layers_avg"}
        assert results == json.loads((folder / f"layers_{'_'.join(layers)}" / name).read_text())
    # All layers were recorded, so neither question needed another capture.
    assert json.loads((store / "zarr.json").read_text())["attributes"]["recording"]["layers"] == [0, 1, 2]
