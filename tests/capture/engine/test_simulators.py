"""Several simulators at a time: the same stores as with one, and what happens when processes end."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zarr

from tests.capture.engine.simulators_in_threads import TINY, ThreadOfTests, assert_same_episodes, record
from tests.kit.races import unlike
from tests.kit.raw_rows import probabilities
from tests.kit.still_scene import StillScene
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.engine.call import Caller
from vla_attention.capture.engine.loop import EpisodeLoop
from vla_attention.capture.jobs.status import store_status
from vla_attention.capture.rerun.base_store import machine_differences
from vla_attention.schemas.stop_signals import EXIT_TERMINATED
from vla_attention.schemas.stores.locks import episode_locks
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.worker import Worker

NODE = Worker("node7-11-ab", "node7", 11, "1", "pid:[1]", "99", "98_2")


# ---------------------------------------------------------------- simulators in threads, for what needs no simulator


class Deadly(StillScene):
    """Ends its process at the second step after the waiting steps of episode 1, as often as `lives` says.

    Episode 0 goes on when that is over: no simulator is idle when episode 1 begins again.
    """

    lives: list[int]
    over: threading.Event

    def reset(self, initial_state_index: int, seed: int) -> None:
        super().reset(initial_state_index, seed)
        self.index, self.steps = initial_state_index, 0
        if self.index == 1 and self.lives[0] == 0:
            self.over.set()

    def step(self, action: np.ndarray, observe: bool) -> Any:
        self.steps += 1
        if self.index == 0:
            self.over.wait(60)
        if self.index == 1 and self.steps == 12 and self.lives[0] > 0:
            self.lives[0] -= 1
            raise SystemExit  # as if the process ended: its end of the connection closes without an answer
        return super().step(action, observe)


def test_more_simulators_give_the_same_episodes(scene, tmp_path, capsys):
    words = ["--task-id", "0", "2", "--num-episodes", "3"]
    assert record(tmp_path / "one.zarr", 1, *words) == 0
    assert not ThreadOfTests.started
    capsys.readouterr()
    assert record(tmp_path / "three.zarr", 3, *words) == 0
    assert len(ThreadOfTests.started) == 3
    assert_same_episodes(tmp_path / "one.zarr", tmp_path / "three.zarr")
    printed = capsys.readouterr().out
    assert re.search("3 processes; --num-envs", printed)
    assert len(re.findall("no success .*8 steps, 2 replans", printed)) == 6
    assert "6 episodes added, 0 solved" in printed
    assert not (tmp_path / "three.zarr" / ".writing").exists()
    assert store_status(tmp_path / "three.zarr").complete
    assert analyze(["store", "verify", str(tmp_path / "three.zarr")]) == 0


def test_an_episode_whose_simulator_died_begins_again(scene, tmp_path, capsys):
    words = ["--task-id", "0", "--num-episodes", "3"]
    assert record(tmp_path / "one.zarr", 1, *words) == 0
    Deadly.lives, Deadly.over = [2], threading.Event()
    scene.make = Deadly
    assert record(tmp_path / "a.zarr", 2, *words) == 0
    assert Deadly.lives == [0]
    assert len(ThreadOfTests.started) == 4
    assert len(re.findall(r"task000_episode001: .*signal 9\)", capsys.readouterr().out)) == 2
    assert_same_episodes(tmp_path / "one.zarr", tmp_path / "a.zarr")
    assert not (tmp_path / "a.zarr" / ".writing").exists()


class Broken(StillScene):
    """Fails in its first episode."""

    error: Exception

    def reset(self, initial_state_index: int, seed: int) -> None:
        raise self.error


def test_an_error_of_a_simulator_is_one_line(scene, tmp_path, capsys):
    Broken.error = RuntimeError("the context\nis lost")
    scene.make = Broken
    assert record(tmp_path / "a.zarr", 2, "--task-id", "0", "--num-episodes", "2") == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    for part in ("a.zarr", "the context is lost", "RuntimeError", "test_simulators.py:"):
        assert part in printed
    assert "Traceback" not in printed


def test_an_error_of_the_writing_ends_everything(scene, tmp_path, monkeypatch, capsys):
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("vla_attention.capture.store.episode_writer.publish", full)
    assert record(tmp_path / "a.zarr", 2, "--task-id", "0", "--num-episodes", "2") == 2
    said = capsys.readouterr().err
    assert "No space left on device" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "a.zarr" / ".writing").exists()


def test_it_waits_for_an_episode_that_another_process_has_locked(scene, tmp_path, monkeypatch, capsys):
    store = tmp_path / "a.zarr"
    assert record(store, 1, "--task-id", "0", "--num-episodes", "1") == 0
    other = episode_locks(store, NODE)
    assert other.acquire("task000_episode001") is None
    monkeypatch.setattr(
        "vla_attention.capture.engine.loop.time",
        SimpleNamespace(sleep=lambda seconds: other.release("task000_episode001")),
    )
    assert record(store, 2, "--task-id", "0", "--num-episodes", "4", "--resume") == 0
    printed = capsys.readouterr().out
    assert printed.count("task000_episode001 by node7") == 1
    assert printed.index("episode 3: no success") < printed.index("Waiting") < printed.index("episode 1: no success")
    assert store_status(store).complete


def in_whole_batches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Let the policy wait until every simulator that runs has come to its call; returns the sizes of batches."""
    poll, make, sizes = EpisodeLoop._poll, Caller.make, []

    def poll_all(self: EpisodeLoop) -> None:
        poll(self)
        while len(self._ready) < len(self._running):
            poll(self)

    def note(self: Caller, calls: Any) -> Any:
        sizes.append(len(calls))
        return make(self, calls)

    monkeypatch.setattr(EpisodeLoop, "_poll", poll_all)
    monkeypatch.setattr(Caller, "make", note)
    return sizes


@pytest.mark.parametrize("contributions", [True])
def test_the_first_replan_of_a_batch_is_that_of_single_calls_but_for_rounding(
    scene, tmp_path, monkeypatch, capsys, contributions
):
    words = ["--task-id", "0", "2", "--num-episodes", "2", *([] if contributions else ["--no-contributions"])]
    assert record(tmp_path / "one.zarr", 1, *words) == 0
    capsys.readouterr()
    sizes = in_whole_batches(monkeypatch)
    assert record(tmp_path / "four.zarr", 4, "--policy-batch", "3", *words) == 0
    assert re.search("at most 3; --policy-batch", capsys.readouterr().out)
    assert sizes[0] == 3
    assert sum(sizes) == 8 + 2 * 3  # for each task, three single calls look at whether the words get through
    given = {kind: open_store(tmp_path / f"{kind}.zarr").episodes[0].attributes.provenance for kind in ("one", "four")}
    assert "policy_batch" not in given["one"]
    assert given["four"] == {**given["one"], "policy_batch": "3"}
    assert machine_differences(given["four"], given["one"]) == ["policy_batch 3 then, 1 now"]
    for name in [f"task00{task}_episode00{episode}" for task in (0, 2) for episode in (0, 1)]:
        one, four = (zarr.open_group(tmp_path / f"{kind}.zarr/episodes/{name}", mode="r") for kind in ("one", "four"))
        for path in ["actions", "joint/atoms", *(["joint/contribution"] if contributions else [])]:
            np.testing.assert_allclose(four[path][0], one[path][0], rtol=1e-4, atol=1e-5, err_msg=path)
        # Rows are stored with 11 bits: rounding may fall to the other side.
        rows = [probabilities(group["joint/rows"])[0] for group in (four, one)]
        np.testing.assert_allclose(*rows, rtol=2e-3, atol=1e-7)
        for path in ("joint/key_role", "frames/base_0_rgb"):
            np.testing.assert_array_equal(four[path][:], one[path][:])
        for name in ("noise_seed", "env_step"):
            assert four.attrs[name] == one.attrs[name]
    assert analyze(["store", "verify", str(tmp_path / "four.zarr")]) == 0


def test_a_resumed_store_has_the_bytes_of_an_undisturbed_one(scene, tmp_path):
    """Whichever episodes were there, and whichever process recorded them."""
    words = ["--task-id", "0", "2", "--num-episodes", "2"]
    whole, store = tmp_path / "whole/a.zarr", tmp_path / "a.zarr"
    assert record(whole, 1, *words) == 0
    episodes = sorted((whole / "episodes").glob("task*"))
    for missing in (episodes[:1], episodes[1:], [episodes[0], episodes[2]]):
        shutil.copytree(whole, store)
        for episode in missing:
            shutil.rmtree(store / "episodes" / episode.name)
        assert record(store, 2, "--resume", *words) == 0
        assert unlike(store, whole) == ()
        shutil.rmtree(store)
    assert record(store, 1, "--task-id", "2", "--num-episodes", "2") == 0
    assert record(store, 1, "--resume", *words) == 0
    assert unlike(store, whole) == ()


class Hangs:
    """The setup of a simulator that answers once, with its number, and then does something else for ever."""

    title = "a reset"

    def server(self, connection: Any) -> Hangs:
        connection.send(os.getpid())
        return self

    def serve(self) -> None:
        while True:
            time.sleep(60)


#: Starts such a simulator and is killed; a fork of it may hold the other end of the connection.
_KILLED = """
import os, signal, sys, time
from tests.capture.engine.test_simulators import Hangs
from vla_attention.capture.engine.simulator_process import SimulatorProcess
simulator = SimulatorProcess(Hangs())
number, fork = simulator.receive(), "held" in sys.argv and os.fork()
if fork == 0 and "held" in sys.argv:
    time.sleep(600)
print(number, int(fork), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("held", [False, True], ids=["alone", "a fork goes on"])
def test_a_simulator_ends_with_the_policys_process_whatever_it_does(tmp_path, held):
    command = [sys.executable, "-c", _KILLED, *["held"] * held]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=os.environ | {"TMPDIR": str(tmp_path)}) as policy:
        assert policy.stdout is not None
        number, fork = map(int, policy.stdout.readline().split())
    until = time.monotonic() + 60
    try:
        while _is_simulator(number):
            assert time.monotonic() < until
            time.sleep(0.05)
    finally:
        if fork:
            os.kill(fork, signal.SIGKILL)
        if _is_simulator(number):
            os.kill(number, signal.SIGKILL)
    assert list(tmp_path.iterdir()) == []


# --------------------------------------------------------------------------------------------- real simulators


@pytest.mark.simulator
@pytest.mark.thorough
@pytest.mark.parametrize("suite", ["cubes", "robosuite"])
def test_two_simulators_give_the_episodes_of_one_to_the_bit(suite, tmp_path, monkeypatch):
    # One renders with the threads of this process, the other two with one each.
    words = ["--task-suite", suite, "--task-id", "0", "3", "--num-episodes", "2"]
    for name, num_envs in (("one", "1"), ("two", "2")):
        arguments = [*TINY, *words, "--num-envs", num_envs, "--output", str(tmp_path / f"{name}.zarr")]
        command = [sys.executable, "-m", "vla_attention.capture", *arguments, "--threads", "2"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    assert_same_episodes(tmp_path / "one.zarr", tmp_path / "two.zarr")


@pytest.mark.thorough
@pytest.mark.simulator
@pytest.mark.libero
def test_simulators_that_share_a_task_of_libero_give_the_published_episodes(libero_assets, tmp_path):
    words = [*TINY[:-1], "4", "--task-suite", "libero_goal", "--task-id", "0", "--num-episodes", "4"]
    words += ["--libero-assets", str(libero_assets)]
    for num_envs in ("1", "2"):
        assert capture([*words, "--num-envs", num_envs, "--output", str(tmp_path / f"{num_envs}.zarr")]) == 0
    assert_same_episodes(tmp_path / "1.zarr", tmp_path / "2.zarr")


class Run:
    """A capture with two simulators in a process of its own, and what the operating system knows of it."""

    def __init__(self, folder: Path, max_steps: int, episodes: int = 3) -> None:
        self.store, self.log, self.temporary = folder / "a.zarr", folder / "log", folder / "temporary"
        self.temporary.mkdir()
        words = [*TINY[:-1], str(max_steps), "--task-suite", "robosuite", "--task-id", "0", "--num-envs", "2"]
        words += ["--num-episodes", str(episodes), "--output", str(self.store)]
        with self.log.open("w") as out:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "vla_attention.capture", *words],
                stdout=out,
                stderr=subprocess.STDOUT,
                env=os.environ
                | {"MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"), "SLURM_JOB_ID": "", "TMPDIR": str(self.temporary)},
            )

    def wait_until(self, what: Any) -> Any:
        until = time.monotonic() + 240
        while not (found := what()):
            assert self.process.poll() is None, self.log.read_text()
            assert time.monotonic() < until, self.log.read_text()
            time.sleep(0.1)
        return found

    def simulators(self) -> list[int]:
        """The numbers of the simulators' processes that live."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        return [int(child) for child in children if _is_simulator(child)]

    def both_are_in_an_episode(self) -> bool:
        return len(list((self.store / ".writing").glob("task*-*"))) == 2


def _is_simulator(number: str | int) -> bool:
    try:
        return b"simulator_process" in Path(f"/proc/{number}/cmdline").read_bytes()
    except OSError:
        return False


@pytest.mark.thorough
@pytest.mark.simulator
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, EXIT_TERMINATED), (signal.SIGINT, 130), (signal.SIGKILL, -9)]
)
def test_a_stopped_capture_leaves_no_half_episode_and_no_process(number, code, tmp_path):
    run = Run(tmp_path, max_steps=100_000)  # no episode ends before the signal
    run.wait_until(run.both_are_in_an_episode)
    children = run.simulators()
    assert len(children) == 2
    run.process.send_signal(number)
    assert run.process.wait(60) == code, run.log.read_text()
    until = time.monotonic() + 60
    while any(_is_simulator(child) for child in children):  # after SIGKILL they see that nobody listens
        assert time.monotonic() < until
        time.sleep(0.1)
    assert list(run.temporary.glob("vla-*")) == []
    said = run.log.read_text()
    assert "Traceback" not in said
    if number != signal.SIGKILL:
        assert not (run.store / ".writing").exists()
    if number == signal.SIGTERM:
        assert re.search("SIGTERM: .*task000_episode000 at step.*, task000_episode001 at step", said)
        assert "3 of this process's 3" in said
    assert not any((run.store / "episodes").glob("task*"))


@pytest.mark.thorough
@pytest.mark.simulator
def test_a_killed_simulator_is_replaced(tmp_path):
    # Whenever the kill comes, the simulator has an episode to begin. Of short episodes, one might end before the other
    # begins, every time.
    run = Run(tmp_path, max_steps=60, episodes=8)
    run.wait_until(run.both_are_in_an_episode)
    victim = run.simulators()[0]
    folders = list(run.temporary.glob("vla-simulator-*"))
    assert len(folders) == 2
    os.kill(victim, signal.SIGKILL)
    assert run.process.wait(600) == 0, run.log.read_text()
    assert len(re.findall("signal 9.* begins again", run.log.read_text())) == 1
    assert store_status(run.store).complete
    assert analyze(["store", "verify", str(run.store)]) == 0
    assert list(run.temporary.glob("vla-*")) == []
