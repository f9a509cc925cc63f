"""Locks: one holder per episode, also after the death of a holder and with several processes at once."""

from __future__ import annotations

import os
import subprocess
import threading
import time
from pathlib import Path

import pytest
from msgspec.structs import replace

from vla_attention.schemas.stores import locks
from vla_attention.schemas.stores.locks import Held, Holder, Locks, episode_locks, store_locks
from vla_attention.schemas.stores.worker import Worker, is_known_dead, this_worker

NAME = "task000_episode003"


def worker(number: int, **changes: object) -> Worker:
    """A worker of another machine. This machine cannot determine whether it lives."""
    made = Worker(f"tag{number}", f"node{number}", number, "1", "pid:[1]")
    return replace(made, **changes)


@pytest.fixture
def store(tmp_path) -> Path:
    path = tmp_path / "a.zarr"
    path.mkdir()
    return path


def age(store: Path, seconds: float) -> None:
    """Set the last touch of every lock to so many seconds ago."""
    for file in store.glob(".writing/*.*"):
        os.utime(file, (time.time() - seconds,) * 2)


def test_a_second_process_gets_the_holder(store):
    first = episode_locks(store, worker(1, slurm_job="7", job_name="5_2"))
    second = episode_locks(store, worker(2))
    assert first.acquire(NAME) is None
    assert first.acquire(NAME) is None
    holder = second.acquire(NAME)
    assert isinstance(holder, Holder)
    assert holder.worker == first.worker
    assert ("node1" in holder.describe(), "5_2" in holder.describe()) == (True, True)
    assert second.acquire("task000_episode004") is None
    assert [found.name for found in second.holders()] == [NAME, "task000_episode004"]
    first.release(NAME)
    assert second.acquire(NAME) is None
    second.release(NAME)
    second.release("task000_episode004")
    assert list(store.iterdir()) == []


def test_a_silent_holder_is_replaced_and_its_unfinished_episode_removed(store):
    first, second, third = (episode_locks(store, worker(number)) for number in (1, 2, 3))
    assert first.acquire(NAME) is None
    others = ["task000_episode0030-aa", f"{NAME}_notes", "notes.txt"]
    for folder in (f"{NAME}-0123abcd", *others):
        (store / ".writing" / folder / "deep").mkdir(parents=True)
    age(store, 240)
    assert second.acquire(NAME) is not None
    age(store, 301)
    assert second.acquire(NAME) is None
    assert sorted(entry.name for entry in (store / ".writing").iterdir()) == sorted([f"{NAME}.lock", *others])
    held = third.acquire(NAME)
    assert held is not None
    assert held.worker == second.worker
    # The first holder was only stopped. It neither touches nor deletes the lock of its successor.
    assert not first.holds(NAME)
    first.release(NAME)
    assert second.holds(NAME)
    second.release(NAME)
    assert third.acquire(NAME) is None


class Clocks:
    """What the module `time` has, with a clock that is set by hand."""

    sleep, time = staticmethod(time.sleep), staticmethod(time.time)

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.mark.parametrize("ahead_s", [-200, 0, 100_000], ids="{} s ahead".format)
def test_a_lock_whose_clock_is_ahead_is_not_held_for_ever(store, monkeypatch, ahead_s):
    monkeypatch.setattr(locks, "time", clocks := Clocks())
    lock = store / ".writing" / f"{NAME}.lock"
    dead, waiting, another = (episode_locks(store, worker(number)) for number in (1, 2, 3))
    assert dead.acquire(NAME) is None
    age(store, -ahead_s)
    held = waiting.acquire(NAME)
    assert held is not None
    assert held.silent_s < 250
    clocks.now += 290
    os.utime(lock, (time.time() + ahead_s, time.time() + ahead_s + 30))  # touched: it was alive
    assert waiting.acquire(NAME) is not None
    clocks.now += 290
    assert waiting.acquire(NAME) is not None
    assert another.acquire(NAME) is not None
    clocks.now += 10
    assert another.acquire(NAME) is not None, "it has looked for ten seconds only"
    assert waiting.acquire(NAME) is None
    assert waiting.holds(NAME)


def test_a_lock_that_its_holder_did_not_live_to_write_is_taken_soon(store, monkeypatch):
    (store / ".writing").mkdir()
    (store / ".writing" / f"{NAME}.lock").touch()
    age(store, 9)
    mine = episode_locks(store, worker(1))
    assert mine.acquire(NAME) is not None
    age(store, 11)
    assert mine.acquire(NAME) is None


def test_a_holder_that_stood_still_before_it_wrote_its_lock_does_not_believe_it_has_it(store, monkeypatch):
    slow, quick = episode_locks(store, worker(1)), episode_locks(store, worker(2))
    write = os.write

    def stands_still(handle: int, content: bytes) -> int:
        monkeypatch.undo()
        age(store, 11)
        assert quick.acquire(NAME) is None
        return write(handle, content)

    monkeypatch.setattr(os, "write", stands_still)
    held = slow.acquire(NAME)
    assert held is not None
    assert held.worker == quick.worker
    assert quick.holds(NAME)


def test_a_folder_of_locks_that_goes_away_while_it_is_made_is_made_again(store, monkeypatch):
    make, times = os.mkdir, []

    def made_and_removed_by_another(path: object, *arguments: object) -> None:
        make(path, *arguments)
        if not times:
            times.append(1)
            os.rmdir(path)
            raise FileExistsError(17, "File exists")

    monkeypatch.setattr(os, "mkdir", made_and_removed_by_another)
    assert episode_locks(store, worker(1)).acquire(NAME) is None


def test_a_stopped_holder_does_not_touch_its_successor(store):
    first, second = episode_locks(store, worker(1)), episode_locks(store, worker(2))
    first.touch_every_s = 0.02
    assert first.acquire(NAME) is None
    lock = store / ".writing" / f"{NAME}.lock"
    lock.unlink()
    assert second.acquire(NAME) is None
    os.utime(lock, (1000, 1000))
    time.sleep(0.2)
    assert lock.stat().st_mtime == 1000


@pytest.mark.parametrize("kind", ["a link", "a folder", "a broken text", "nothing"])
def test_what_is_no_lock_of_ours_is_replaced_when_it_is_old(store, tmp_path, kind):
    """Whoever gives away a store can put anything into it."""
    precious = tmp_path / "precious"
    (precious / "thesis").mkdir(parents=True)
    (store / ".writing").mkdir()
    lock, part = store / ".writing" / f"{NAME}.lock", store / ".writing" / f"{NAME}-0123"
    part.symlink_to(precious, target_is_directory=True)
    match kind:
        case "a link":
            lock.symlink_to(precious / "thesis", target_is_directory=True)
        case "a folder":
            lock.mkdir()
        case _:
            lock.write_text("{..}" if kind == "a broken text" else "")
    mine = episode_locks(store, worker(1))
    assert mine.acquire(NAME) is not None
    os.utime(lock, (1000, 1000), follow_symlinks=False)
    assert mine.acquire(NAME) is None
    assert not os.path.lexists(part)
    assert (precious / "thesis").is_dir()


@pytest.mark.parametrize("silent", [False, True])
@pytest.mark.parametrize("taking", [False, True], ids=["", "one was killed while it replaced another"])
def test_of_several_processes_one_gets_the_lock(store, silent, taking):
    if silent:
        assert episode_locks(store, worker(99)).acquire(NAME) is None
        if taking:
            (store / ".writing" / f"{NAME}.taking").touch()
        age(store, 1000)
    everybody = [episode_locks(store, worker(number)) for number in range(8)]
    barrier, won = threading.Barrier(len(everybody)), []

    def run(mine: Locks) -> None:
        barrier.wait()
        if mine.acquire(NAME) is None:
            won.append(mine)

    threads = [threading.Thread(target=run, args=(mine,)) for mine in everybody]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    won += [mine for mine in everybody if not won and mine.acquire(NAME) is None][:1]  # all gave way to one another
    assert len(won) == 1
    (holder,) = won[0].holders()
    assert holder.worker == won[0].worker
    won[0].release(NAME)
    assert list(store.iterdir()) == []


def test_of_two_that_found_the_same_dead_holder_one_replaces_it(store, monkeypatch):
    """The second one has judged the dead holder when the first one already has the lock."""
    assert episode_locks(store, worker(99)).acquire(NAME) is None
    age(store, 1000)
    first, second = episode_locks(store, worker(1)), episode_locks(store, worker(2))
    remove = Locks._remove_dead

    def after_the_other(self: Locks, lock: Path, seen: object) -> None:
        monkeypatch.undo()
        assert first.acquire(NAME) is None
        remove(self, lock, seen)

    monkeypatch.setattr(Locks, "_remove_dead", after_the_other)
    held = second.acquire(NAME)
    assert held is not None
    assert held.worker == first.worker
    assert first.holds(NAME)


def test_a_lock_that_may_not_be_deleted_is_no_error_of_its_holder(store, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    first, second = episode_locks(store, worker(1)), episode_locks(store, worker(2))
    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", refuse)
        patch.setattr(Path, "unlink", refuse)
        with first.part(NAME) as folder:
            assert second.acquire(NAME) is not None
        assert not folder.exists()
    age(store, 301)
    assert second.acquire(NAME) is None


def test_a_living_holder_touches_its_lock(store):
    with episode_locks(store, worker(1)) as first:
        first.touch_every_s = 0.05
        assert first.acquire(NAME) is None
        age(store, 1000)
        until = time.monotonic() + 5
        while first.holders()[0].silent_s > 10 and time.monotonic() < until:
            time.sleep(0.01)
        assert episode_locks(store, worker(2)).acquire(NAME) is not None
    assert list(store.iterdir()) == []  # leaving the context releases all locks


def test_a_process_of_this_machine_that_has_ended_is_known_to_be_dead(store):
    me = this_worker()
    assert not is_known_dead(me, me)
    child = subprocess.Popen(["sleep", "60"])
    start = Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()[19]
    other = replace(me, tag="x", process=child.pid, process_start=start)
    assert not is_known_dead(other, me)
    assert is_known_dead(replace(other, process_start="1"), me)  # another process has its number now
    assert not is_known_dead(replace(other, process_start="1", process_space="pid:[0]"), me)
    assert not is_known_dead(replace(other, process_start="1", host="elsewhere"), me)
    child.kill()
    child.wait()
    assert is_known_dead(other, me)
    assert episode_locks(store, other).acquire(NAME) is None
    assert episode_locks(store, me).acquire(NAME) is None


def test_a_requeued_job_replaces_its_own_lock_at_once(store):
    before = worker(1, slurm_job="7")
    assert episode_locks(store, before).acquire(NAME) is None
    assert episode_locks(store, worker(2, slurm_job="8")).acquire(NAME) is not None
    assert episode_locks(store, worker(3, slurm_job="7")).acquire(NAME) is not None
    assert episode_locks(store, worker(3, slurm_job="7", restarts=1)).acquire(NAME) is None


def test_a_part_is_removed_with_its_lock_and_refused_to_a_second_process(store):
    place = store.with_name("b.zarr")
    with store_locks(place, worker(1)).part(locks.WHOLE_STORE) as part:
        (part / "zarr.json").write_text("{}")
        with pytest.raises(Held, match=r"node1"), store_locks(place, worker(2)).part(locks.WHOLE_STORE):
            pass
    assert list(store.parent.iterdir()) == [store]


def test_a_sweep_removes_what_the_dead_left_and_nothing_else(store):
    dead, living, mine = (episode_locks(store, worker(number)) for number in (1, 2, 3))
    for number, each in enumerate((dead, living)):
        assert each.acquire(f"task000_episode00{number}") is None
        (store / ".writing" / f"task000_episode00{number}-aa").mkdir()
    for name in ("removed-aa", "task000_episode002-aa"):  # a process was killed while it removed them
        (store / ".writing" / name).mkdir()
    os.utime(store / ".writing" / "task000_episode000.lock", (1000, 1000))
    assert {path.name: holder and holder.worker for path, holder in mine.leftovers().items()} == {
        "removed-aa": None,
        "task000_episode000-aa": None,
        "task000_episode000.lock": None,
        "task000_episode001-aa": living.worker,
        "task000_episode001.lock": living.worker,
        "task000_episode002-aa": None,
    }
    mine.sweep()
    left = ["task000_episode001-aa", "task000_episode001.lock"]
    assert sorted(entry.name for entry in (store / ".writing").iterdir()) == left
