"""Simulators in threads of the test's process, and in scenes that the test chooses: captures then take seconds."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace

import pytest
import zarr

from tests.kit.still_scene import StillScene
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.engine import simulator_process, simulators

TINY = ["pi", "--checkpoint", "untrained-tiny", "--replan-steps", "4", "--max-steps", "8"]


def _serve(descriptor: int) -> None:
    """A scene that raises SystemExit stands for a process that ends without an answer."""
    with suppress(SystemExit):
        simulator_process.main(descriptor)


class ThreadOfTests:
    """Stands for a `SimulatorProcess`: its own side runs in a thread of this process, in a `StillScene`."""

    started: list[ThreadOfTests]

    def __init__(self, setup: simulator_process.SimulatorSetup) -> None:
        self.connection, theirs = Pipe()
        self.code = -signal.SIGKILL
        self._theirs = theirs
        self._thread = threading.Thread(target=_serve, args=(os.dup(theirs.fileno()),), daemon=True)
        theirs.close()
        self._thread.start()
        self.connection.send(setup)
        self.started.append(self)

    def ask(self, request: object) -> None:
        self.connection.send(request)

    def has_answer(self) -> bool:
        return self.connection.poll()

    def receive(self) -> object:
        return self.connection.recv()

    def how_it_ended(self) -> str:
        return "killed by signal 9"

    def close(self) -> None:
        self.connection.close()
        self._thread.join()


def simulators_in_threads(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Let simulators be threads, or parts of this process; `make()` of what is returned makes their environments."""
    made = SimpleNamespace(make=StillScene)
    monkeypatch.setattr(ThreadOfTests, "started", [], raising=False)
    monkeypatch.setattr(simulator_process, "make_environment", lambda suite, task_id, settings: made.make())
    monkeypatch.setattr(simulators, "SimulatorProcess", ThreadOfTests)
    monkeypatch.setattr("vla_attention.capture.environments.drawing.check_drawing", lambda suite, libero_assets: "")
    return made


def record(store: Path, num_envs: int, *words: str) -> int:
    """Capture with the policy of test size; returns the exit code."""
    return capture([*TINY, "--task-suite", "robosuite", "--output", str(store), "--num-envs", str(num_envs), *words])


def assert_same_episodes(one: Path, other: Path) -> None:
    """Compare two stores array by array, with types, shapes and attributes."""
    first, second = (zarr.open_group(store, mode="r")["episodes"] for store in (one, other))
    assert sorted(first.keys()) == sorted(second.keys())
    for name in first:
        assert {**first[name].attrs} == {**second[name].attrs}
        arrays, others = (
            {path: array for path, array in group[name].members(max_depth=None) if isinstance(array, zarr.Array)}
            for group in (first, second)
        )
        assert arrays.keys() == others.keys()
        assert "joint/rows" in arrays
        for path, array in arrays.items():
            mine, its = array[:], others[path][:]
            assert (mine.dtype, mine.shape) == (its.dtype, its.shape)
            assert mine.tobytes() == its.tobytes(), f"{name}/{path}"
