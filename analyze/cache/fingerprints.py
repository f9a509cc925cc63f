"""How an episode's files are at the moment, without reading them: what was kept holds while this stays as it was.

A seal says what an episode was when it was captured, and reading compares with it. What is taken from the cache is not
read, so that damage would not be seen. Every file has to be the one that was there when the masses were measured: same
inode, size, and times of change. Writing to a file, exchanging it and setting its date all change the time that the
file system notes (ctime), which no program can set.
"""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path

from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import SEAL_GROUP

#: Files that changed less than this ago may change again without a difference that file systems' clocks show.
SETTLED_SECONDS = 2.0
#: The state of an episode that is not in a file system of this machine: its seal, which is read there at every opening,
#: has to suffice.
_ELSEWHERE = hashlib.sha256(b"elsewhere").digest()
#: Pictures are in no measure of attention, and are most of the files.
_NOT_MEASURED = "frames/"


def file_state(episode: StoredEpisode) -> bytes | None:
    """A digest of the present state of an episode's files; None when one is missing or only just changed.

    Raises:
        CorruptEpisode: its seal cannot be read or is not its own.
    """
    place = episode.folder
    if not isinstance(place, Path):
        return _ELSEWHERE
    names = [name for name in episode.files.records if not name.startswith(_NOT_MEASURED)]
    paths = {name: f"{place}/{name}" for name in (*names, f"{SEAL_GROUP}/zarr.json")}
    newest, stats = 0, []
    for name, path in paths.items():
        try:
            status = os.stat(path)
        except OSError:
            return None
        newest = max(newest, status.st_mtime_ns, status.st_ctime_ns)
        stats.append(f"{name} {status.st_ino} {status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}")
    if newest > (time.time() - SETTLED_SECONDS) * 1e9:
        return None
    return hashlib.sha256("\n".join(stats).encode()).digest()
