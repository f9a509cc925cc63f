"""An array job on a real SLURM: interrupted during an episode, requeued, analysed.

It runs only with `make test-slurm`, on a machine where sbatch works.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.jobs.status import store_status
from vla_attention.capture.published.evaluate import evaluate
from vla_attention.schemas.stores.reader import open_store

pytestmark = [
    pytest.mark.simulator,
    pytest.mark.skipif(not os.environ.get("VLA_TEST_SLURM"), reason="needs a running SLURM: make test-slurm"),
]

ROOT = Path(__file__).resolve().parents[2]
TASKS, EPISODES = (0, 1, 2), 3
ARGS = "--max-steps 80 --replan-steps 4"
#: Longest wait for one condition. SLURM starts a requeued job only after two minutes.
PATIENCE_S = 900


def slurm(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.strip()


def state_of(job: str) -> str:
    shown = slurm("scontrol", "show", "job", job)
    return re.search(r"JobState=(\w+)", shown)[1]


def wait_until(what: str, condition: Callable[[], object], log: Callable[[], str], every_s: float = 0.2) -> None:
    until = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until, f"did not happen: {what}\n{slurm('squeue')}\n{log()}"
        time.sleep(every_s)


@contextmanager
def signalling(job: str) -> Iterator[None]:
    """Send SIGTERM to the batch script of a job; the block waits for the effect.

    The exit code of scancel shows nothing. SLURM delivers the signal at once, and on an idle machine the job has
    requeued itself before scancel gets its answer. scancel then fails, because the job cannot be altered now, or
    repeats the request for a minute. At the end of the block it is stopped, so that no repeated signal reaches the
    restarted job.
    """
    process = subprocess.Popen(
        ["scancel", "--signal=TERM", "--batch", job], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        process.kill()
        process.wait()


def test_an_array_interrupted_in_episodes_equals_a_single_process(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    output = tmp_path / "array"
    store = output / "robosuite.zarr"
    variables = {
        "CHECKPOINT": "untrained-tiny",
        "TASK_SUITE": "robosuite",
        "NUM_EPISODES": str(EPISODES),
        "ARGS": ARGS,
        "LAYERS": "0 2",
        "OUTPUT_DIR": str(output),
        "SETUP": f"export PATH={Path(sys.executable).parent}:$PATH",
    }
    printed = subprocess.run(
        [ROOT / "scripts/submit_attention_ratio.sh", f"--array={TASKS[0]}-{TASKS[-1]}", "--ntasks=1"],
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    array, analysis = re.search(r"Job (\d+) captures .* job (\d+) analyses", printed).groups()

    def log_of(task: int) -> str:
        file = tmp_path / f"slurm-{array}_{task}.out"
        return file.read_text() if file.exists() else ""

    def logs() -> str:
        return "\n".join(file.read_text() for file in sorted(tmp_path.glob("slurm-*.out")))

    def in_an_episode(task: int) -> bool:
        """A process has locked an episode of the task and begun to write it."""
        return any((store / ".writing").glob(f"task{task:03d}_episode???-*"))

    try:
        # One task gets SIGTERM, as --signal sends it before the time limit, and requeues itself.
        wait_until("task 0 is in an episode", lambda: in_an_episode(0), logs, 0.05)
        with signalling(f"{array}_0"):
            wait_until("task 0 is requeued", lambda: "is back in the queue" in log_of(0), logs, 0.05)
        assert re.search(r"SIGTERM: .*task000_episode\d+ at step \d+.*; .* \d", log_of(0))
        # Another task is requeued by SLURM, as after a preemption.
        wait_until("task 1 is in an episode", lambda: in_an_episode(1), logs, 0.05)
        slurm("scontrol", "requeue", f"{array}_1")
        wait_until("task 1 has dropped its episode", lambda: "Stopped by SIGTERM: dropped task001" in log_of(1), logs)
        assert not any((store / ".writing").glob("task000*"))
        wait_until("the analysis is done", lambda: state_of(analysis) not in ("PENDING", "RUNNING", "COMPLETING"), logs)
        assert state_of(analysis) == "COMPLETED", logs()
    finally:
        subprocess.run(["scancel", array, analysis], check=False)

    status = store_status(store)
    assert status.complete, logs()
    assert [task.committed for task in status.tasks] == [EPISODES] * len(TASKS)
    assert status.writing == ()
    assert not (store / ".writing").exists()
    assert analyze(["store", "verify", str(store)]) == 0
    assert "requeued 1 times" in log_of(0)
    assert "requeued 1 times" in log_of(1)
    assert "requeued" not in log_of(2)

    single = tmp_path / "single"
    for task in TASKS:
        arguments = ["--checkpoint", "untrained-tiny", "--task-suite", "robosuite", "--task-id", str(task)]
        arguments += ["--num-episodes", str(EPISODES), "--layers", "0", "2", "--output-dir", str(single), *ARGS.split()]
        assert evaluate("evaluate-attention-ratio", [*arguments, "--stage", "capture"]) == 0
    arguments = ["--task-suite", "robosuite", "--checkpoint", "untrained-tiny", "--layers", "0", "2"]
    assert evaluate("evaluate-attention-ratio", [*arguments, "--output-dir", str(single), "--stage", "analyze"]) == 0
    assert_same(store, single / "robosuite.zarr")
    name = "attention_ratio_results_robosuite.json"
    results = json.loads((output / name).read_text())
    assert results == json.loads((single / name).read_text())
    expected = [(task, episode) for task in TASKS for episode in range(EPISODES)]
    assert sorted((item["task_id"], item["episode_idx"]) for item in results) == expected


def assert_same(one: Path, other: Path) -> None:
    """Assert equal episodes and bit-identical arrays; only the provenance may differ."""
    first, second = open_store(one), open_store(other)
    assert [episode.name for episode in first.episodes] == [episode.name for episode in second.episodes]
    for left, right in zip(first.episodes, second.episodes, strict=True):
        assert left.attributes.arrays == right.attributes.arrays
        assert (left.attributes.success, left.attributes.num_steps) == (
            right.attributes.success,
            right.attributes.num_steps,
        )
        for name in left.attributes.arrays:
            assert np.array_equal(left.read(name), right.read(name)), (left.name, name)
            assert left.read(name).tobytes() == right.read(name).tobytes(), (left.name, name)
