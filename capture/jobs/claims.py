"""Claims: which process is rolling out which episode, so that two jobs never spend hours on the same one.

Correctness does not rest on claims. An episode is published by one `rename`, and of two writers the second gets an error
(`vla_attention.capture.store.episode_writer`). Claims keep a second writer from starting, and must therefore survive what clusters do to processes: a
claim whose holder was killed is taken over.

A claim is a folder `NAME.zarr.jobs/claims/EPISODE.GENERATION/` with one file, `owner.json`. It is made under another name and
**renamed into place with its content**, which is the operation that publishes episodes and creates stores: one that a folder
already there makes fail, on local file systems as on NFS and Lustre. (`flock` does nothing on some Lustre mounts and stays on
one machine on some NFS ones; `O_EXCL` creates a file that is still empty.)

A living holder touches `owner.json` every half minute. A holder is dead when that is known (see `job.is_known_dead`), or when
it has not been touched for five minutes. Times are compared on the file server's clock only: a file touched just now against the
holder's. To take over from a dead holder, the folder of the **next generation** is made. Nothing is deleted for that, so two
processes that find the same holder dead cannot take each other's fresh claim away: one of their two renames fails. The winner
then looks whether the dead claim is still there. If not, somebody took over, finished and cleaned up in between, and it
begins again. Whoever holds the last generation removes all of them, the oldest first.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from vla_attention.capture.jobs.job import Worker, is_known_dead
from vla_attention.capture.store.durable_files import make_partial, partial_folder, remove_if_empty
from vla_attention.schemas.jsonable import MalformedDocument, from_json, to_json

#: Beside the store: who plans, claims and has written what. Never needed for reading, and may be deleted when nothing runs.
JOBS_SUFFIX = ".jobs"

TOUCH_EVERY_S = 30.0
#: Ten missed touches. Node-local clocks do not enter.
DEAD_AFTER_S = 300.0
_OWNER = "owner.json"
_ATTEMPTS = 5


@dataclass(frozen=True)
class Holder:
    """Who holds an episode, and how many seconds ago it began and last gave a sign of life."""

    episode: str
    worker: Worker
    began_s: float
    silent_s: float

    def described(self) -> str:
        """For people."""
        return f"{self.episode} by {self.worker.described()}, last sign of life {self.silent_s:.0f} s ago"


def jobs_folder(store: Path) -> Path:
    """Where processes leave notes for each other and for people: beside the store, never in it."""
    return store.with_name(store.name + JOBS_SUFFIX)


class Claims:
    """The claims of one process on episodes of one store. Use it as a context manager: a thread touches what is held."""

    def __init__(
        self, store: Path, worker: Worker, touch_every_s: float = TOUCH_EVERY_S, dead_after_s: float = DEAD_AFTER_S
    ) -> None:
        self.store = store
        self.folder = _claims_folder(store)
        self.worker = worker
        self.touch_every_s = touch_every_s
        self.dead_after_s = dead_after_s
        self._held: dict[str, int] = {}
        self._leaving = threading.Event()
        self._toucher = threading.Thread(target=self._touch, name="claims", daemon=True)

    def __enter__(self) -> Claims:
        self._toucher.start()
        return self

    def __exit__(self, _t: type[BaseException] | None, _v: BaseException | None, _tb: TracebackType | None) -> None:
        self._leaving.set()
        self._toucher.join()
        for episode in list(self._held):
            self.release(episode)

    def acquire(self, episode: str) -> Holder | None:
        """Claim an episode; None when it is ours now, else who holds it."""
        holder = None
        for attempt in range(_ATTEMPTS):
            if attempt:
                time.sleep(0.1 * attempt)
            won, holder = self._try(episode)
            if won:
                return None
            if holder is not None:
                return holder
        # Claims came and went under our eyes each time: somebody is at it.
        return Holder(episode, Worker("", "another machine", 0, "", ""), 0.0, 0.0)

    def _try(self, episode: str) -> tuple[bool, Holder | None]:
        """One attempt: (won, the living holder). Neither: things changed meanwhile, look again."""
        building = self.folder / f"new-{self.worker.tag}"
        shutil.rmtree(building, ignore_errors=True)
        self.folder.parent.mkdir(exist_ok=True)
        make_partial(building)
        owner = building / _OWNER
        try:
            owner.write_text(json.dumps(to_json(self.worker)))
            now = owner.stat().st_mtime
            generations = _generations(self.folder, episode)
            judged = None
            if generations:
                judged = _read(self.folder, episode, generations[-1], now)
                if judged is None:
                    return False, None
                if judged.worker.tag == self.worker.tag:
                    return True, None
                if judged.silent_s < self.dead_after_s and not is_known_dead(judged.worker, self.worker):
                    return False, judged
            generation = generations[-1] + 1 if generations else 0
            if not self._rename(building, self.folder / _name(episode, generation)):
                return False, None
        finally:
            shutil.rmtree(building, ignore_errors=True)
        self._held[episode] = generation
        if judged is not None:
            before = _read(self.folder, episode, generation - 1, now)
            if before is None or before.worker.tag != judged.worker.tag:
                self._remove(episode, generation)
                return False, None
            self._remove_partials_of(judged)
        return True, None

    def _rename(self, building: Path, target: Path) -> bool:
        try:
            building.rename(target)
        except OSError as error:
            # A file server that lost its answer reports a failure after success; the content tells whose it is.
            held = _owner(target)
            if held is None and error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                raise
            return held is not None and held.tag == self.worker.tag
        return True

    def release(self, episode: str) -> None:
        """Give an episode back."""
        last = self._held.get(episode)
        if last is None:
            return
        for generation in _generations(self.folder, episode):
            if generation <= last:
                self._remove(episode, generation)
        self._held.pop(episode, None)
        remove_if_empty(self.folder)

    def _remove(self, episode: str, generation: int) -> None:
        if self._held.get(episode) == generation:
            del self._held[episode]
        # Renamed first: whoever lists the claims never meets one without its owner.
        doomed = self.folder / f"old-{self.worker.tag}-{_name(episode, generation)}"
        try:
            (self.folder / _name(episode, generation)).rename(doomed)
        except OSError:
            return
        shutil.rmtree(doomed, ignore_errors=True)

    def _remove_partials_of(self, dead: Holder) -> None:
        """Remove the half-written episode of a holder that is gone; its machine may never come back to do so."""
        pattern = f"{dead.episode}-{dead.worker.host}-{dead.worker.process}-*"
        for folder in partial_folder(self.store).glob(pattern):
            shutil.rmtree(folder, ignore_errors=True)
        remove_if_empty(partial_folder(self.store))

    def _touch(self) -> None:
        while not self._leaving.wait(self.touch_every_s):
            for episode, generation in list(self._held.items()):
                try:
                    os.utime(self.folder / _name(episode, generation) / _OWNER)
                except OSError:
                    continue  # a file server that does not answer now may answer next time


def holders(store: Path) -> list[Holder]:
    """Everybody who claims an episode of the store now, dead or alive; by this machine's clock. Writes nothing."""
    folder = _claims_folder(store)
    episodes = sorted({entry.name.rpartition(".")[0] for entry in _entries(folder) if not _is_temporary(entry.name)})
    found = []
    for episode in episodes:
        generations = _generations(folder, episode)
        holder = _read(folder, episode, generations[-1], time.time()) if generations else None
        if holder is not None:
            found.append(holder)
    return found


def _claims_folder(store: Path) -> Path:
    return jobs_folder(store) / "claims"


def _name(episode: str, generation: int) -> str:
    return f"{episode}.{generation}"


def _is_temporary(name: str) -> bool:
    return name.startswith(("new-", "old-"))


def _entries(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError:
        return []


def _generations(folder: Path, episode: str) -> list[int]:
    numbers = [entry.name.removeprefix(f"{episode}.") for entry in _entries(folder) if not _is_temporary(entry.name)]
    return sorted(int(number) for number in numbers if number.isdigit())


def _owner(claim: Path) -> Worker | None:
    try:
        return from_json(Worker, json.loads((claim / _OWNER).read_text()))
    except (OSError, ValueError, MalformedDocument):
        return None


def _read(folder: Path, episode: str, generation: int, now: float) -> Holder | None:
    claim = folder / _name(episode, generation)
    try:
        # The folder's own time is when its content was put there; the file's is the last touch.
        began, touched = claim.stat().st_mtime, (claim / _OWNER).stat().st_mtime
    except OSError:
        return None
    # A machine that lost its power may leave an empty file behind. Nobody touches it, so it grows old like any other.
    worker = _owner(claim) or Worker("", "an unknown machine", 0, "", "")
    return Holder(episode, worker, max(0.0, now - began), max(0.0, now - touched))
