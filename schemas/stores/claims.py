"""Claims: which process is recording which episode, so that no two jobs spend hours on the same one.

Correctness does not depend on claims. One `rename` publishes an episode, and the second of two writers gets an error
(`capture/store/episode_writer.py`). Claims keep a second writer from starting. Clusters kill processes, so the claim of
a killed holder must be replaceable.

A claim is a folder `NAME.zarr.jobs/claims/EPISODE.GENERATION/` with one file, `owner.json`. The folder is created under
another name and then **renamed together with its file**. Publishing an episode and creating a store use the same
operation: the rename fails if the target folder exists, on local file systems as on NFS and Lustre. (`flock` has no
effect on some Lustre mounts, and only within one machine on some NFS mounts. `O_EXCL` creates a file that is still
empty.)

A holder touches `owner.json` every half minute while it lives. It counts as dead if its end is certain
(`worker.is_known_dead`), or if the file was not touched for five minutes. Only the clock of the file server is used:
the time of the holder's file is compared with that of a file that was written just now. To replace a dead holder, a
process creates the folder of the **next generation**. It deletes nothing for that, so two processes that replace the
same dead holder cannot delete each other's new claim: one of their two renames fails. The winner then checks that the
dead claim still exists. If not, a third process has replaced it, finished and cleaned up in the meantime, and the
winner starts again. The holder of the last generation deletes all generations, the oldest first.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import threading
import time
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import TracebackType

from vla_attention.schemas.documents import decode_json
from vla_attention.schemas.jsonable import MalformedDocument, from_json, to_json
from vla_attention.schemas.limits import CLAIM_BYTES, JOB_FILES
from vla_attention.schemas.regular_files import read_regular
from vla_attention.schemas.stores.partial_folders import make_partial, no_link, remove_if_empty, remove_partials_of
from vla_attention.schemas.stores.store_format import StoreError, is_episode_name
from vla_attention.schemas.stores.worker import Worker, is_known_dead

#: Ending of the folder beside the store that holds claims and records. No reader needs it, and it may be deleted while
#: no capture runs.
JOBS_SUFFIX = ".jobs"

#: Seconds between two touches of a held claim.
TOUCH_EVERY_S = 30.0
#: Seconds without a touch after which a holder counts as dead: ten missed touches.
DEAD_AFTER_S = 300.0
_OWNER = "owner.json"
#: Episode and generation in the name of a claim.
_CLAIM = re.compile(r"(.+)\.(0|[1-9][0-9]*)")
_ATTEMPTS = 5


@dataclass(frozen=True)
class Holder:
    """The process that holds an episode.

    began_s, silent_s: seconds since the claim began, and since its last touch.
    """

    episode: str
    worker: Worker
    began_s: float
    silent_s: float

    def describe(self) -> str:
        """Return episode, worker and time of the last touch as text."""
        return f"{self.episode} by {self.worker.describe()}, last active {self.silent_s:.0f} s ago"


def jobs_folder(store: Path) -> Path:
    """Return the folder of claims and records. It is beside the store, so that a copy of the store omits it.

    Raises:
        StoreError: it is a link.
    """
    return no_link(store.with_name(store.name + JOBS_SUFFIX))


def job_files(folder: Path) -> list[str]:
    """Return the names in a folder of claims or records; none if it does not exist.

    Raises:
        StoreError: there are more than processes fill a store.
    """
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in islice(entries, JOB_FILES + 1)]
    except OSError:
        return []
    if len(names) > JOB_FILES:
        raise StoreError(
            f"{folder} has more than {JOB_FILES:,} entries, and a capture writes one for each of its processes. Delete "
            "the folder when no capture runs; no reader of the store needs it."
        )
    return names


class Claims:
    """The claims of one process on episodes of one store.

    Within its context a thread touches the held claims. Leaving the context releases them.
    """

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
        """Claim an episode. Returns None after success, else the holder of the claim."""
        holder = None
        for attempt in range(_ATTEMPTS):
            if attempt:
                time.sleep(0.1 * attempt)
            won, holder = self._try(episode)
            if won:
                return None
            if holder is not None:
                return holder
        # The claims changed during every attempt, so other processes are active.
        return Holder(episode, Worker("", "another machine", 0, "", ""), 0.0, 0.0)

    def _try(self, episode: str) -> tuple[bool, Holder | None]:
        """Try once; returns (success, living holder). (False, None): the claims changed meanwhile, so try again."""
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
            # Its machine may never run a capture again.
            dead = judged.worker
            remove_partials_of(self.store, episode, dead.host, dead.process, dead.process_space)
        return True, None

    def _rename(self, building: Path, target: Path) -> bool:
        try:
            building.rename(target)
        except OSError as error:
            # A file server whose answer was lost reports a failure after success. The content shows whose claim it is.
            held = _owner(target)
            if held is None and error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                raise
            return held is not None and held.tag == self.worker.tag
        return True

    def release(self, episode: str) -> None:
        """Release an episode."""
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
        # Rename first, so that no listing of the claims shows one without its owner file.
        doomed = self.folder / f"old-{self.worker.tag}-{_name(episode, generation)}"
        try:
            (self.folder / _name(episode, generation)).rename(doomed)
        except OSError:
            return
        shutil.rmtree(doomed, ignore_errors=True)

    def _touch(self) -> None:
        while not self._leaving.wait(self.touch_every_s):
            for episode, generation in list(self._held.items()):
                try:
                    os.utime(self.folder / _name(episode, generation) / _OWNER)
                except OSError:
                    continue  # the file server may answer next time


def holders(store: Path) -> list[Holder]:
    """Return the holders of all claims on the store's episodes, dead or alive. Times are by this machine's clock."""
    folder, now = _claims_folder(store), time.time()
    last = {episode: numbers[-1] for episode, numbers in sorted(_claims(folder).items())}
    read = (_read(folder, episode, generation, now) for episode, generation in last.items())
    return [holder for holder in read if holder is not None]


def _claims_folder(store: Path) -> Path:
    return no_link(jobs_folder(store) / "claims")


def _name(episode: str, generation: int) -> str:
    return f"{episode}.{generation}"


def _claims(folder: Path) -> dict[str, list[int]]:
    """The generations of the claims on each episode, in ascending order. What has another name is no claim."""
    generations_of: dict[str, list[int]] = {}
    for name in job_files(folder):
        match = _CLAIM.fullmatch(name)
        if match is not None and is_episode_name(match[1]):
            generations_of.setdefault(match[1], []).append(int(match[2]))
    return {episode: sorted(generations) for episode, generations in generations_of.items()}


def _generations(folder: Path, episode: str) -> list[int]:
    return _claims(folder).get(episode, [])


def _owner(claim: Path) -> Worker | None:
    try:
        return from_json(Worker, decode_json(read_regular(claim / _OWNER, CLAIM_BYTES, follow=False)))
    except (OSError, ValueError, MalformedDocument):
        return None


def _read(folder: Path, episode: str, generation: int, now: float) -> Holder | None:
    claim = folder / _name(episode, generation)
    try:
        # The time of the folder is that of its creation with its content; the time of the file is the last touch.
        began, touched = claim.stat().st_mtime, (claim / _OWNER).stat().st_mtime
    except OSError:
        return None
    # A power failure may leave an empty file. No process touches it, so the claim expires like any other.
    worker = _owner(claim) or Worker("", "an unknown machine", 0, "", "")
    return Holder(episode, worker, max(0.0, now - began), max(0.0, now - touched))
