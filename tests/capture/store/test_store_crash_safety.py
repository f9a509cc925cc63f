"""Whatever happens to a writing process, the store holds whole episodes only, and resuming completes it.

Failures are injected from here, into the calls that reach the disk: the product knows nothing of them.
"""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Barrier
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from tests.kit.crashes import PROCESSES, before_call, die, run_child
from tests.kit.durable_stores import SPEC, leftovers, names, store_bytes, write_store
from tests.kit.examples import examples
from tests.kit.stores import (
    commit,
    denoise_times,
    episode_records,
    root_attributes,
    write_episode,
)
from tests.kit.thorough import thorough_except
from vla_attention.capture.store import episode_writer
from vla_attention.capture.store.episode_writer import EpisodeTaken, StoreWriteFailed
from vla_attention.capture.store.store_writer import open_run
from vla_attention.capture.store.unpublished import UnpublishedFolder
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.stores import worker
from vla_attention.schemas.stores.locks import Locks
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import (
    RunMismatch,
    StoreError,
    StoreExists,
    StoreNotFound,
    episode_name,
)
from vla_attention.schemas.stores.verify import verify_store


def write_and_die(path: Path, kind: str, number: int) -> None:
    with before_call(kind, number, die):
        write_store(path, mode="resume", spec=SPEC)


def count_calls(kind: str, path: Path) -> int:
    with before_call(kind, -1, die) as calls:
        write_store(path, spec=SPEC)
    return calls()


@pytest.mark.parametrize(
    ("kind", "moments"),
    [
        ("set", 6),
        ("rename", 3),
        *(pytest.param(*case, marks=pytest.mark.thorough) for case in (("fsync", 4), ("renamed", 3))),
    ],
)
def test_a_killed_process_leaves_whole_episodes_and_is_resumed(tmp_path, uninterrupted, kind, moments):
    total = count_calls(kind, tmp_path / "counted.zarr")
    assert total >= moments
    for i in range(moments):
        path = tmp_path / f"{i}.zarr"
        number = i * (total - 1) // (moments - 1)
        assert run_child(write_and_die, path, kind, number) == -signal.SIGKILL
        if path.exists():
            store = open_store(path)
            assert verify_store(store) == []
            assert [episode.name for episode in store.episodes] in (
                [],
                ["task000_episode000"],
                ["task000_episode000", "task000_episode001"],
            )
        write_store(path, mode="resume", spec=SPEC)
        assert store_bytes(path) == uninterrupted
        assert not leftovers(path)


def test_an_exception_in_the_block_leaves_no_trace(tmp_path, uninterrupted):
    path = write_store(tmp_path / "a.zarr", spec=SPEC)
    store = open_run(path, root_attributes(SPEC), "resume")
    start, records = episode_records(SPEC, 7, 0)
    for stop in (0, 1, len(records)):
        for exception in (RuntimeError, KeyboardInterrupt):
            with pytest.raises(exception), store.episode(start, denoise_times(SPEC)) as writer:  # noqa: PT012
                for record in records[:stop]:
                    writer.append(record)
                raise exception
    with store.episode(start, denoise_times(SPEC)) as writer:
        writer.append(records[0])  # and never committed
    assert store_bytes(path) == uninterrupted
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", ["set", "fsync", "rename"])
@pytest.mark.parametrize("code", thorough_except([errno.ENOSPC], [errno.ENOSPC, errno.EIO]))
def test_a_full_or_failing_disk_is_an_error_and_harms_nothing(tmp_path, uninterrupted, kind, code):
    path = write_store(tmp_path / "a.zarr", spec=SPEC)
    store = open_run(path, root_attributes(SPEC), "resume")

    def fail() -> None:
        raise OSError(code, os.strerror(code))

    with before_call(kind, -1, fail) as calls:
        write_episode(store, SPEC, 6, 0)
    total = calls()
    shutil.rmtree(path / "episodes/task006_episode000")
    for number in sorted({0, total // 2, total - 1 if kind != "fsync" else total - 2}):
        with before_call(kind, number, fail), pytest.raises(StoreWriteFailed, match=os.strerror(code)) as caught:
            write_episode(store, SPEC, 6, 0)
        assert "task006_episode000" in str(caught.value)
        assert isinstance(caught.value, OSError)
        assert store_bytes(path) == uninterrupted
        assert not leftovers(path)


def test_a_disk_that_is_full_when_the_store_is_made(tmp_path):
    def fail() -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for kind in ("set", "fsync", "rename"):
        with before_call(kind, 0, fail), pytest.raises(BadArgument):
            open_run(tmp_path / "a.zarr", root_attributes(SPEC), "new")
        assert list(tmp_path.iterdir()) == []


def test_file_systems_without_hard_links_hold_stores(tmp_path, monkeypatch, uninterrupted):
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "link", refuse)
    assert store_bytes(write_store(tmp_path / "a.zarr", spec=SPEC)) == uninterrupted


@pytest.mark.parametrize("moved", [True, False], ids=["moved", "deleted"])
def test_a_store_that_goes_away_under_its_writer_does_not_come_back(tmp_path, uninterrupted, moved):
    path, elsewhere = tmp_path / "a.zarr", tmp_path / "elsewhere"
    write_store(path, spec=SPEC)

    def go_away() -> None:
        path.rename(elsewhere)
        if not moved:
            shutil.rmtree(elsewhere)

    def write_another() -> None:
        write_episode(open_run(path, root_attributes(SPEC), "resume"), SPEC, 6, 0)

    with before_call("set", -1, go_away) as calls:
        write_another()
    shutil.rmtree(path / "episodes/task006_episode000")
    for number in (0, 1, calls() // 2, calls() - 1):
        with before_call("set", number, go_away), pytest.raises(StoreNotFound):
            write_another()
        assert not path.exists()
        assert [*tmp_path.iterdir()] == [elsewhere] * moved
        if moved:
            elsewhere.rename(path)
            shutil.rmtree(path / ".writing")  # its lock is that of this process, which goes on
        write_store(path, mode="resume", spec=SPEC)
        assert store_bytes(path) == uninterrupted
        assert not leftovers(path)


def test_bytes_that_come_back_changed_are_never_published(tmp_path, monkeypatch):
    store = open_run(tmp_path / "a.zarr", root_attributes(SPEC), "new")
    original = UnpublishedFolder.set

    async def spoiled(self, key, value, **keywords):
        await original(self, key, value, **keywords)
        if "atoms/c." in key:
            file = Path(self.root) / key
            file.write_bytes(file.read_bytes()[:20] + b"\x55" + file.read_bytes()[21:])

    monkeypatch.setattr(UnpublishedFolder, "set", spoiled)
    with pytest.raises(StoreError, match="joint/atoms"):
        write_episode(store, SPEC, 0, 0)
    assert names(store.path) == []


def write_same(path: Path, barrier: Barrier, report: Connection) -> None:
    store = open_run(path, root_attributes(SPEC), "resume")
    start, records = episode_records(SPEC, 0, 0)
    barrier.wait(60)
    try:
        with store.episode(start, denoise_times(SPEC)) as writer:
            for record in records:
                writer.append(record)
            commit(writer, SPEC, 0, 0)
        report.send("committed")
    except StoreExists as error:
        report.send(str(error))


def create_and_fill(path: Path, task: int, barrier: Barrier) -> None:
    spec = replace(SPEC, tasks=(task,))
    barrier.wait(60)
    write_store(path, mode="resume", spec=spec)


def test_one_of_two_writers_of_an_episode_wins(tmp_path, uninterrupted):
    path = tmp_path / "a.zarr"
    barrier = PROCESSES.Barrier(2)
    receivers, children = [], []
    for _ in range(2):
        receiver, sender = PROCESSES.Pipe(duplex=False)
        receivers.append(receiver)
        children.append(PROCESSES.Process(target=write_same, args=(path, barrier, sender)))
        children[-1].start()
    results = [receiver.recv() for receiver in receivers if receiver.poll(60)]
    for child in children:
        child.join(60)
        assert child.exitcode == 0
    assert len(results) == 2
    assert results.count("committed") == 1  # the other one has the text of StoreExists
    assert verify_store(open_store(path)) == []
    assert not leftovers(path)
    write_store(path, mode="resume", spec=SPEC)
    assert store_bytes(path) == uninterrupted


def test_many_processes_create_and_fill_one_store(tmp_path):
    path = tmp_path / "a.zarr"
    barrier = PROCESSES.Barrier(4)
    children = [PROCESSES.Process(target=create_and_fill, args=(path, task, barrier)) for task in range(4)]
    for child in children:
        child.start()
    for child in children:
        child.join(60)
        assert child.exitcode == 0
    assert names(path) == [episode_name(task, episode) for task in range(4) for episode in range(2)]
    assert verify_store(open_store(path)) == []
    assert list(tmp_path.iterdir()) == [path]


def test_a_process_that_finds_the_store_made_by_another_goes_on_with_it(tmp_path, uninterrupted):
    path = tmp_path / "a.zarr"

    def made_by_another() -> None:
        write_store(tmp_path / "other.zarr", spec=SPEC).rename(path)

    with before_call("rename", 0, made_by_another):
        store = open_run(path, root_attributes(SPEC), "new")
    assert len(store.committed()) == 2
    assert store_bytes(path) == uninterrupted
    assert list(tmp_path.iterdir()) == [path]


def test_a_crash_while_overwriting_leaves_no_half_store(tmp_path, monkeypatch, uninterrupted):
    path = write_store(tmp_path / "a.zarr", spec=replace(SPEC, seed=5))

    def die_in_the_middle(folder: Path, **_: object) -> None:
        next(file for file in Path(folder).rglob("c.*")).unlink()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", die_in_the_middle)
        with pytest.raises(KeyboardInterrupt):
            open_run(path, root_attributes(SPEC), "overwrite")
    assert not path.exists()
    assert store_bytes(write_store(path, mode="overwrite", spec=SPEC)) == uninterrupted


@pytest.mark.parametrize("committed", [True, False])
def test_a_holder_that_stood_still_before_its_first_file_lost_the_episode(tmp_path, monkeypatch, committed):
    path = write_store(tmp_path / "a.zarr", spec=SPEC)
    start, _ = episode_records(SPEC, 6, 0)
    name, create = episode_name(6, 0), episode_writer.zarr.create_group
    stopped, other = (open_run(path, root_attributes(SPEC), "resume") for _ in range(2))

    def late(*given, **settings):
        monkeypatch.setattr(episode_writer.zarr, "create_group", create)
        os.utime(path / ".writing" / f"{name}.lock", (1000, 1000))
        assert other.locks.acquire(name) is None
        if committed:
            write_episode(other, SPEC, 6, 0)
        return create(*given, **settings)

    monkeypatch.setattr(episode_writer.zarr, "create_group", late)
    with (
        pytest.raises(StoreExists if committed else EpisodeTaken),
        stopped.episode(start, denoise_times(SPEC)),
    ):
        pytest.fail("the episode was begun")
    other.locks.release(name)
    assert verify_store(open_store(path)) == []
    assert (names(path)[-1] == name) is committed
    assert not leftovers(path)


def test_a_holder_that_stood_still_neither_harms_its_successor_nor_publishes_half(tmp_path, uninterrupted):
    """At every moment: it goes on after another process took the episode over, before or after its commit."""
    path = write_store(tmp_path / "a.zarr", spec=SPEC)
    before = store_bytes(path)
    start, records = episode_records(SPEC, 6, 0)
    name = episode_name(6, 0)
    for moment in ("append", "commit", "publish"):
        for committed in (True, False):
            stopped, other = (open_run(path, root_attributes(SPEC), "resume") for _ in range(2))

            def take_over(other=other, committed=committed) -> None:
                os.utime(path / ".writing" / f"{name}.lock", (1000, 1000))
                assert other.locks.acquire(name) is None
                if committed:
                    write_episode(other, SPEC, 6, 0)

            expected = StoreExists if committed else EpisodeTaken
            with stopped.episode(start, denoise_times(SPEC)) as writer, pytest.raises(expected):  # noqa: PT012
                writer.append(records[0])
                if moment == "append":
                    take_over()
                for record in records[1:]:
                    writer.append(record)
                if moment == "commit":
                    take_over()
                with before_call("rename", 0 if moment == "publish" else -1, take_over):
                    commit(writer, SPEC, 6, 0)
            if not committed:
                assert store_bytes(path) == before | {
                    f".writing/{name}.lock": (path / ".writing" / f"{name}.lock").read_bytes()
                }
                write_episode(other, SPEC, 6, 0)
            other.locks.release(name)
            assert verify_store(open_store(path)) == []
            assert names(path)[-1] == name
            assert not leftovers(path)
            shutil.rmtree(path / "episodes" / name)
    assert store_bytes(path) == uninterrupted


def dead_process() -> int:
    process = subprocess.Popen(["true"])
    process.wait()
    return process.pid


class Crash(BaseException):
    """Stands for the end of a process: nothing behind it is cleaned up."""


class WritersAndCrashes(RuleBasedStateMachine):
    """Writing, crashing anywhere, resuming and overwriting, against a set of episode names."""

    episodes = st.sampled_from([0, 1, 2])

    @initialize()
    def begin(self) -> None:
        self.folder = Path(os.environ["PYTEST_STATE_FOLDER"]) / os.urandom(6).hex()
        self.path = self.folder / "a.zarr"
        self.spec = replace(SPEC, replans=2)
        self.model: set[int] = set()
        self.exists = False

    def process_ends(self, kind: str, number: int, action: Callable[[], object]) -> None:
        """Run something in what looks like another process, which ends at the number-th write, if it comes to that."""

        def crash() -> None:
            raise Crash

        number_of_process, start = dead_process(), worker._process_start
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "getpid", lambda: number_of_process)
            patch.setattr(worker, "_process_start", lambda of: "1" if of == number_of_process else start(of))
            try:
                with before_call(kind, number, crash):
                    # Cleaning up is not for the dead.
                    patch.setattr(shutil, "rmtree", lambda *_, **__: None)
                    patch.setattr(Locks, "release", lambda *_: None)
                    action()
            except (Crash, UserError):
                return

    @rule(kind=st.sampled_from(["set", "fsync", "rename", "renamed"]), number=st.integers(0, 60), episode=episodes)
    def crash(self, kind: str, number: int, episode: int) -> None:
        def work() -> None:
            store = open_run(self.path, root_attributes(self.spec), "resume")
            if (0, episode) not in store.committed():
                write_episode(store, self.spec, 0, episode)

        self.process_ends(kind, number, work)
        # Either of the two, but nothing in between: what is listed is believed, and `whole` checks it.
        self.exists = self.path.exists()
        listed = self.listed()
        assert self.model <= listed <= self.model | {episode}
        self.model = listed

    @rule(episode=episodes)
    def write(self, episode: int) -> None:
        store = open_run(self.path, root_attributes(self.spec), "resume")
        self.exists = True
        if episode in self.model:
            with pytest.raises(StoreExists):
                write_episode(store, self.spec, 0, episode)
        else:
            write_episode(store, self.spec, 0, episode)
            self.model.add(episode)
        assert not leftovers(self.path)

    @precondition(lambda self: self.exists)
    @rule()
    def another_run(self) -> None:
        with pytest.raises(RunMismatch):
            open_run(self.path, root_attributes(replace(self.spec, seed=99)), "resume")
        if self.model:
            with pytest.raises(StoreExists):
                open_run(self.path, root_attributes(self.spec), "new")
        else:
            open_run(self.path, root_attributes(self.spec), "new")

    @rule()
    def overwrite(self) -> None:
        open_run(self.path, root_attributes(self.spec), "overwrite")
        self.exists = True
        self.model = set()

    def listed(self) -> set[int]:
        return (
            {episode.attributes.episode_index for episode in open_store(self.path).episodes} if self.exists else set()
        )

    @invariant()
    def whole(self) -> None:
        if getattr(self, "exists", False):
            assert self.listed() == self.model
            assert verify_store(open_store(self.path)) == []


def test_writers_and_crashes(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTEST_STATE_FOLDER", str(tmp_path))
    from hypothesis.stateful import run_state_machine_as_test

    run_state_machine_as_test(
        WritersAndCrashes,
        settings=settings(
            max_examples=examples(3), stateful_step_count=8, deadline=None, suppress_health_check=list(HealthCheck)
        ),
    )
