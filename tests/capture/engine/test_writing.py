"""The thread that writes: order, bound, failures, and what is dropped. No store is written."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vla_attention.capture.engine.source import Committed, Outcome
from vla_attention.capture.engine.writing import WritingThread


class Stopped(Exception):
    """What `check` raises."""


class MadeUpStore:
    """Notes what its episodes' writers are asked for; `append` waits until the test lets it go on."""

    def __init__(self) -> None:
        self.log: list[str] = []
        self.may_append = threading.Event()
        self.may_append.set()
        self.appends = threading.Event()
        self.refuses: Exception | None = None

    @contextmanager
    def episode(self, start: Any, denoise_times: Any) -> Iterator[Any]:
        name = start.name

        def append(record: Any) -> None:
            self.appends.set()
            self.may_append.wait()
            self.log.append(f"{name}: {record.number}")

        def commit(success: bool, num_steps: int, steps: None) -> Path:
            if self.refuses is not None:
                raise self.refuses
            self.log.append(f"{name}: commit {success} {num_steps}")
            return Path(f"{name}-that-is-not-there")

        self.log.append(f"{name}: open")
        try:
            yield SimpleNamespace(append=append, commit=commit)
        finally:
            self.log.append(f"{name}: close")


def record(number: int, num_bytes: int = 60) -> Any:
    rows = SimpleNamespace(rows=np.zeros(num_bytes, dtype=np.uint8), contribution=None)
    return SimpleNamespace(number=number, rows={"joint": rows}, frames={}, camera_frames={}, coverage={})


class Writing(WritingThread):
    """With an event for what is told to the process that gave the work; it may hold 100 bytes."""

    def __init__(self) -> None:
        self.told = threading.Event()
        self.stopping = False
        super().__init__(done=self.told.set, check=self.stop, most_waiting_bytes=100)

    def stop(self) -> None:
        if self.stopping:
            raise Stopped

    def wait_until(self, holds: Callable[[], object]) -> None:
        while not holds():
            assert self.told.wait(60)
            self.told.clear()


def begin(writing: Writing, store: MadeUpStore, name: str) -> Any:
    return writing.episode(store, SimpleNamespace(name=name), np.ones(1))


def test_replans_and_commits_are_written_in_order() -> None:
    store = MadeUpStore()
    with Writing() as writing:
        one, other = (begin(writing, store, name) for name in ("one", "other"))
        one.append(record(0, 1))
        other.append(record(0, 1))
        one.append(record(1, 1))
        one.commit(Outcome(True, 7))
        writing.wait_until(lambda: one.committed)
        assert one.committed == Committed(Outcome(True, 7), 2, Path("one-that-is-not-there"))
        assert other.committed is None
    # The other one is dropped with the end of the block.
    expected = ["one: open", "one: 0", "other: open", "other: 0", "one: 1", "one: commit True 7", "one: close"]
    assert store.log == [*expected, "other: close"]


def test_what_waits_is_bounded() -> None:
    store = MadeUpStore()
    store.may_append.clear()
    with Writing() as writing:
        episode = begin(writing, store, "one")
        episode.append(record(0))
        assert store.appends.wait(60)
        writing.stopping = True
        with pytest.raises(Stopped):  # the replan in work and this one are more than 100 bytes: `check` is called
            episode.append(record(1))
        writing.stopping = False
        store.may_append.set()
        episode.append(record(2))
        episode.append(record(3, 1000))  # waits until nothing else does, and is not refused
        episode.commit(Outcome(False, 0))
        writing.wait_until(lambda: episode.committed)
    assert store.log[1:4] == ["one: 0", "one: 2", "one: 3"]


def test_a_failure_ends_its_episode_and_no_other() -> None:
    store = MadeUpStore()
    store.refuses = OSError("the disk is full")
    with Writing() as writing:
        episode, other = begin(writing, store, "one"), begin(writing, store, "other")
        other.append(record(0, 1))
        episode.append(record(0, 1))
        episode.commit(Outcome(True, 1))
        episode.append(record(1, 1))
        writing.wait_until(lambda: episode.error)
        assert str(episode.error) == "the disk is full"
        other.append(record(1, 1))
        other.drop()
        other.append(record(2, 1))
        writing.wait_until(lambda: "other: close" in store.log)
    assert store.log.count("one: close") == 1
    assert "one: 1" not in store.log
    assert "other: 2" not in store.log
