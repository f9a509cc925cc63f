"""vla-eval 0.8.0, run for real: `vla-eval serve` with the example's server, and `vla-eval run --no-docker`."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("vla_eval", reason="run by make test-policies, in .venv-transformers")
pytest.importorskip("transformers", minversion="5.0", reason="run by make test-policies, in .venv-transformers")

import torch

import vla_attention as va
from tests.policies import pi0_model
from tests.policies.vla_eval_benchmark import TASKS, NoiseBenchmark
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

HERE = Path(__file__).resolve().parent
#: Executed actions of a policy call; an episode has 8 steps.
CHUNK, CALLS = 3, (0, 3, 6)


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def environment() -> dict[str, str]:
    bin_folder = Path(sys.executable).parent
    return {
        **os.environ,
        "PATH": f"{bin_folder}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join([str(HERE.parents[1]), os.environ.get("PYTHONPATH", "")]),
        # `vla-eval serve` starts its script with uv: in this environment, without a look at any index.
        "VIRTUAL_ENV": str(bin_folder.parent),
        "UV_OFFLINE": "1",
        "OMP_NUM_THREADS": "1",
    }


def wait_for(port: int, server: subprocess.Popen[bytes], log: Path, seconds: float = 180) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if server.poll() is not None:
            raise AssertionError(f"vla-eval serve ended: {log.read_text()[-3000:]}")
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=2)
        except (urllib.error.URLError, OSError):
            time.sleep(0.3)
        else:
            return
    raise AssertionError(f"vla-eval serve did not start: {log.read_text()[-3000:]}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the store and the results of two runs of the benchmark, of one and of two episodes a task."""
    folder, port = tmp_path_factory.mktemp("vla_eval"), free_port()
    # As a user does: uv would take the environment of the project in which a script lies.
    for script in (HERE.parents[1] / "examples/vla_eval_server.py", HERE / "vla_eval_small_server.py"):
        shutil.copy(script, folder)
    server = {
        "script": "vla_eval_small_server.py",
        "args": {"store": str(folder / "run.zarr"), "suite": "noise", "chunk_size": CHUNK, "port": port},
    }
    benchmark = {
        "server": {"url": f"ws://127.0.0.1:{port}"},
        "output_dir": str(folder / "results"),
        "benchmarks": [
            {"benchmark": "tests.policies.vla_eval_benchmark:NoiseBenchmark", "subname": "noise", "params": {}}
        ],
    }
    (folder / "server.yaml").write_text(json.dumps(server))
    log = folder / "server.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            ["vla-eval", "serve", "--config", "server.yaml", "--address", f"127.0.0.1:{port}"],
            cwd=folder, env=environment(), stdout=output, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
    try:
        wait_for(port, process, log)
        for episodes in (1, 2):
            benchmark["benchmarks"][0]["episodes_per_task"] = episodes
            (folder / "benchmark.yaml").write_text(json.dumps(benchmark))
            done = subprocess.run(
                ["vla-eval", "run", "--config", "benchmark.yaml", "--no-docker", "--yes"],
                cwd=folder, env=environment(), capture_output=True, text=True, timeout=300, check=False,
            )  # fmt: skip
            assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:] + log.read_text()[-3000:]
    finally:
        # It serves in a process of its own, which a signal to it alone would leave.
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(timeout=30)
    return folder


def test_every_episode_of_the_benchmark_is_in_the_store_once(folder):
    store = open_store(folder / "run.zarr")
    assert verify_store(store) == []
    facts = [
        (part.attributes.task_id, part.attributes.episode_index, part.attributes.instruction, part.attributes.success)
        for part in store.episodes
    ]
    assert facts == [(number, episode, TASKS[number], number == 0) for number in range(2) for episode in range(2)]
    assert {part.attributes.num_steps for part in store.episodes} == {8}
    assert all(tuple(part.read("env_step")) == CALLS for part in store.episodes)


def test_the_rows_are_those_of_the_same_call_outside_of_vla_eval(folder, tmp_path):
    stored = open_store(folder / "run.zarr").episodes[0]
    bench = NoiseBenchmark()
    raw = bench.reset({"episode_idx": 0})
    seen = bench.make_obs(raw, {"name": TASKS[0]})
    policy = pi0_model.small_pi0()
    given = pi0_model.inputs(instruction=TASKS[0])
    pictures = np.stack([seen["images"][name] for name in pi0_model.CAMERAS])
    given["pixel_values"] = torch.from_numpy(pictures).permute(0, 3, 1, 2)[None] / 127.5 - 1
    given["state"] = torch.from_numpy(np.float32(seen["states"]))[None]
    layout = va.layouts.pi0_transformers(policy, cameras=pi0_model.CAMERAS, prompt_tokens=pi0_model.LONGEST)
    with (
        va.record(tmp_path / "run.zarr", policy, layout=layout, durable=False) as run,
        run.episode(task_id=0, episode_index=0, instruction=TASKS[0]) as episode,
        episode.replan(env_step=0),
    ):
        actions = policy.sample_actions(**given)
    alone = open_store(tmp_path / "run.zarr").episodes[0]
    np.testing.assert_array_equal(stored.read("joint/rows")[0], alone.read("joint/rows")[0])
    np.testing.assert_array_equal(stored.read("actions")[0], actions[0].double().numpy())
    np.testing.assert_array_equal(stored.read("frames/wrist")[0], seen["images"]["wrist"])


def test_the_store_is_analysed(folder):
    run = va.open(folder / "run.zarr")
    assert sorted(run.analyze()["tasks"].filter(scope="task")["instruction"].unique()) == sorted(TASKS)
    assert {"base", "wrist", "linguistic"} <= set(run.analyze(grouping="cameras")["steps_groups"]["group"].unique())
