"""Locks: which process is writing which episode, so that no two spend hours on the same one.

`NAME.zarr/.writing/` has for every episode that is being written `EPISODE.lock` and the unfinished episode, a folder
`EPISODE-DIGITS/`. `NAME.zarr.partial/`, beside the store, has the same for a whole store that is made, copied, merged
or deleted. Both folders are removed when they are empty, and no reader of a store looks into them.

Nothing that is published depends on a lock: one `rename` publishes an episode, and the second of two writers gets an
error (`durable_files.publish`). A lock keeps the second writer from starting.

A lock is a file that is made with `O_EXCL`, which one of several processes can do, on local file systems as on NFS and
Lustre. Its holder touches it every half minute. A holder counts as dead if its end is certain (`is_known_dead`), or if
the lock was not touched for five minutes: by the clock of the file server, or, since its holder's clock may be ahead of
that, as long as the waiter has looked at it. An empty lock, whose holder was killed before it wrote into it, counts for
ten seconds. Whoever replaces a dead holder holds
`EPISODE.taking` meanwhile, which is made in the same way: without it, one of two that found the same dead holder would
delete the new lock of the other. What the dead holder wrote is renamed before it is removed: its rename of the whole
episode, should it still come, then fails or came first.

A holder that was only stopped (SIGSTOP, a file server that hangs) touches the lock only while what is in it is its own.
"""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from vla_attention.schemas.foreign_files import read_regular
from vla_attention.schemas.jsonable import MalformedDocument, decode_json, from_json, to_json
from vla_attention.schemas.stores.store_format import StoreExists, StoreNotFound, is_episode_name
from vla_attention.schemas.stores.worker import Worker, is_known_dead, this_worker

#: Of unfinished episodes and their locks, in a store. Without a `zarr.json`: it is no part of the store.
WRITING_FOLDER = ".writing"
#: Ending of the folder beside a store that a whole store is written in.
PARTIAL_SUFFIX = ".partial"
#: The name of the lock there.
WHOLE_STORE = "store"
#: Seconds between two touches of a held lock.
TOUCH_EVERY_S = 30.0
#: Seconds without a touch after which a holder counts as dead: ten missed touches.
DEAD_AFTER_S = 300.0
#: Seconds after which an empty lock counts as left behind: its holder writes into it as soon as it is made.
WRITTEN_WITHIN_S = 10.0
_LOCK, _TAKING, _ASIDE = ".lock", ".taking", "removed-"
_ATTEMPTS = 5
#: Of a lock: a worker in JSON.
_MOST_BYTES = 10_000
_UNKNOWN = Worker("", "an unknown machine", 0, "", "")


@dataclass(frozen=True)
class Holder:
    """Who holds a lock.

    name: of the episode. silent_s: seconds since the last touch. is_dead: whether the lock may be taken.
    """

    name: str
    worker: Worker
    silent_s: float
    is_dead: bool

    def describe(self) -> str:
        """Return episode, worker and time of the last touch as text."""
        return f"{self.name} by {self.worker.describe()}, last active {self.silent_s:.0f} s ago"


class Held(StoreExists):
    """Another process is writing the same."""

    def __init__(self, place: Path, holder: Holder, lock: Path) -> None:
        super().__init__(
            f"Another process is writing {place}: {holder.worker.describe()}, last active {holder.silent_s:.0f} s ago. "
            f"Wait for it, or give another place. If it has ended, delete {lock}, or try again after "
            f"{DEAD_AFTER_S / 60:.0f} minutes."
        )
        self.holder = holder


class _Seen(NamedTuple):
    """A lock at one moment."""

    content: bytes
    touched_s: float


class Locks:
    """The locks of one process in one folder; a thread touches those that it holds.

    Leaving the context releases all of them. `owner`: the store; `is_name`: what may be locked there.
    """

    def __init__(self, folder: Path, owner: Path, is_name: Callable[[str], bool], worker: Worker | None = None) -> None:
        self.folder = folder
        self.owner = owner
        self.worker = worker or this_worker()
        self.touch_every_s, self.dead_after_s = TOUCH_EVERY_S, DEAD_AFTER_S
        self._is_name = is_name
        self._content = json.dumps(to_json(self.worker)).encode()
        self._mutex = threading.Lock()
        self._held: set[str] = set()
        self._toucher: threading.Thread | None = None
        #: Of every lock of others: what was seen, and when it was seen first (monotonic).
        self._first_seen: dict[Path, tuple[_Seen, float]] = {}

    def __enter__(self) -> Locks:
        return self

    def __exit__(self, _t: type[BaseException] | None, _v: BaseException | None, _tb: TracebackType | None) -> None:
        for name in list(self._held):
            self.release(name)

    def acquire(self, name: str) -> Holder | None:
        """Lock a name. Returns None after success, else who holds it.

        Raises:
            StoreNotFound: the store was moved or deleted.
            OSError: the folder cannot be written to.
        """
        lock, holder = self._lock(name), None
        for attempt in range(_ATTEMPTS):
            time.sleep(0.02 * attempt)
            if self._create(lock):
                self._hold(name)
                self._remove_parts(name)
                return None
            seen = _look(lock)
            if seen is None:
                continue
            if seen.content == self._content:
                self._hold(name)
                return None
            holder = self._judge(lock, seen, self._now)
            if not holder.is_dead:
                return holder
            self._remove_dead(lock, seen)
        # It changed during every attempt, so that other processes are active.
        return holder or Holder(name, _UNKNOWN, 0.0, is_dead=False)

    def release(self, name: str) -> None:
        """Unlock a name; a lock that another process has taken stays."""
        with self._mutex:
            self._held.discard(name)
        if self.holds(name):
            _remove(self._lock(name))  # where that is refused, others take it once this process has ended
        _remove_if_empty(self.folder)

    def holds(self, name: str) -> bool:
        """Whether the lock is this process's own, also after it stood still."""
        return self._is_own(self._lock(name))

    def _is_own(self, file: Path) -> bool:
        seen = _look(file)
        return seen is not None and seen.content == self._content

    @contextmanager
    def part(self, name: str) -> Iterator[Path]:
        """Lock a name, unless it is locked already, and give a new folder to write in.

        After the block, what was not renamed is removed.

        Raises:
            Held: another process is writing it.
        """
        with self._mutex:
            held = name in self._held
        if not held and (holder := self.acquire(name)) is not None:
            raise Held(self.owner if name == WHOLE_STORE else self.owner / name, holder, self._lock(name))
        folder = self.folder / f"{name}-{uuid.uuid4().hex[:12]}"
        try:
            self._make(folder)
            yield folder
        finally:
            try:
                shutil.rmtree(folder, ignore_errors=True)
            finally:  # also after Ctrl-C; the next holder removes the rest
                if not held:
                    self.release(name)
                _remove_if_empty(self.folder)

    def sweep(self) -> None:
        """Remove what processes left that have ended."""
        for name in self._names():
            with self._mutex:
                held = name in self._held
            if not held and self.acquire(name) is None:
                self.release(name)
        for path in self._entries():
            if path.name.startswith(_ASIDE):
                _remove(path)
        _remove_if_empty(self.folder)

    def leftovers(self) -> dict[Path, Holder | None]:
        """Everything in the folder, and the holder of its lock who may still live; None: `sweep` removes it, or tries.

        What has another name than processes of ours give is not in it.
        """
        living = {holder.name: holder for holder in self.holders() if not holder.is_dead}
        return {
            path: living.get(name or "")
            for path in self._entries()
            if (name := self._name_of(path)) is not None or path.name.startswith(_ASIDE)
        }

    def holders(self) -> list[Holder]:
        """The holders of all locks, dead or alive, by this machine's clock."""
        locks = [path for path in self._entries() if path.suffix == _LOCK and self._is_name(path.stem)]
        looked = [(path, _look(path)) for path in locks]
        return [self._judge(path, seen, time.time) for path, seen in looked if seen is not None]

    def _lock(self, name: str) -> Path:
        return self.folder / f"{name}{_LOCK}"

    def _entries(self) -> list[Path]:
        """What is in the folder; none if it does not exist."""
        try:
            with os.scandir(self.folder) as entries:
                return sorted(Path(entry.path) for entry in entries)
        except OSError:
            return []

    def _name_of(self, path: Path) -> str | None:
        for ending in (_LOCK, _TAKING):
            if path.name.endswith(ending):
                name = path.name.removesuffix(ending)
                return name if self._is_name(name) else None
        name = path.name.rpartition("-")[0]
        return name if self._is_name(name) else None

    def _names(self) -> list[str]:
        return sorted({name for path in self._entries() if (name := self._name_of(path)) is not None})

    def _create(self, file: Path) -> bool:
        """Make a file with this process in it; False if it exists, or another process took it before it was written."""
        while True:
            try:
                handle = os.open(file, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
            except FileExistsError:
                return False
            except FileNotFoundError:
                self._make_place()
                continue
            try:
                os.write(handle, self._content)
            except OSError:
                _remove(file)
                raise
            finally:
                os.close(handle)
            return self._is_own(file)

    def _make(self, folder: Path) -> None:
        while True:
            try:
                return folder.mkdir()
            except FileNotFoundError:
                self._make_place()

    def _make_place(self) -> None:
        """Make the folder of the locks, which whoever finds it empty removes."""
        if not self.folder.parent.is_dir():
            raise StoreNotFound(f"The folder {self.folder.parent} was moved or deleted.")
        try:
            self.folder.mkdir()
        except FileExistsError:  # made meanwhile, and perhaps removed again
            if self.folder.is_symlink():
                raise

    def _judge(self, file: Path, seen: _Seen, now: Callable[[], float]) -> Holder:
        before, first = self._first_seen.get(file, (None, 0.0))
        if before != seen:
            first = time.monotonic()
            self._first_seen[file] = seen, first
        worker = _worker(seen.content) or _UNKNOWN
        silent = max(0.0, now() - seen.touched_s, time.monotonic() - first)
        too_long = silent >= (self.dead_after_s if seen.content else WRITTEN_WITHIN_S)
        return Holder(file.stem, worker, silent, too_long or is_known_dead(worker, self.worker))

    def _now(self) -> float:
        """The time of the file server: that of a file that was made just now."""
        probe = self.folder / f"{_ASIDE}{uuid.uuid4().hex}"
        try:
            probe.touch()
            return probe.stat().st_mtime
        except FileNotFoundError:  # another process has swept the folder
            return time.time()
        finally:
            _remove(probe)

    def _remove_dead(self, lock: Path, seen: _Seen) -> None:
        """Remove a dead holder's lock, unless another process does it or has done it."""
        guard = lock.with_suffix(_TAKING)
        if not self._create(guard):
            taking = _look(guard)
            if taking is not None and self._judge(guard, taking, self._now).is_dead:
                _remove(guard)
            return
        try:
            if _look(lock) == seen:  # neither touched nor replaced since it was judged
                _remove(lock)
        finally:
            _remove(guard)

    def _remove_parts(self, name: str) -> None:
        """Remove what earlier holders wrote of a name that is locked now."""
        for path in self._entries():
            if self._name_of(path) == name and path.suffix not in (_LOCK, _TAKING):
                aside = self.folder / f"{_ASIDE}{uuid.uuid4().hex}"
                with suppress(OSError):  # published at this moment by a holder that stood still
                    path.rename(aside)
                    _remove(aside)

    def _hold(self, name: str) -> None:
        with self._mutex:
            self._held.add(name)
            if self._toucher is None:
                self._toucher = threading.Thread(target=self._touch, name="locks", daemon=True)
                self._toucher.start()

    def _touch(self) -> None:
        while True:
            time.sleep(self.touch_every_s)
            with self._mutex:
                names = list(self._held)
                if not names:
                    self._toucher = None
                    return
            for name in names:
                with suppress(OSError):  # the file server may answer next time
                    if self.holds(name):
                        os.utime(self._lock(name))


def episode_locks(store: Path, worker: Worker | None = None) -> Locks:
    """The locks on a store's episodes."""
    return Locks(store / WRITING_FOLDER, store, is_episode_name, worker)


def store_locks(store: Path, worker: Worker | None = None) -> Locks:
    """The lock on a place where a whole store is made, copied, merged or deleted."""
    return Locks(store.with_name(store.name + PARTIAL_SUFFIX), store, lambda name: name == WHOLE_STORE, worker)


def _look(file: Path) -> _Seen | None:
    try:
        content = read_regular(file, _MOST_BYTES)
    except FileNotFoundError:
        return None
    except OSError:
        content = b""  # no lock of ours; it is never touched
    try:
        return _Seen(content, os.lstat(file).st_mtime)
    except OSError:
        return None


def _worker(content: bytes) -> Worker | None:
    try:
        return from_json(Worker, decode_json(content))
    except (ValueError, MalformedDocument):
        return None


def _remove(path: Path) -> None:
    """Remove a folder, or a file or link in its place."""
    if path.is_symlink() or not path.is_dir():
        with suppress(OSError):
            path.unlink()
    else:
        shutil.rmtree(path, ignore_errors=True)


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):  # something is in it, or another process has removed it
        folder.rmdir()
