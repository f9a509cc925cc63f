"""Packed stores: one zip file an episode, without compression, and an index of the episodes.

zarr's `ZipStore` and tensorstore's `zip` read such a zip as they read a folder. Its order is for readers that are
elsewhere: large files first, then the small ones and all metadata, the seal last, so that one request for the end opens
the episode.
"""

from __future__ import annotations

import errno
import fcntl
import os
import zipfile
from pathlib import Path

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.byte_source import Folder
from vla_attention.schemas.stores.packed_index import (
    INDEX_FILE,
    INDEX_FORMAT,
    INDEX_VERSION,
    PackedEpisode,
    PackedIndex,
    packed_file,
    read_index,
)
from vla_attention.schemas.stores.seal import SEAL_FILE, read_seal
from vla_attention.schemas.stores.store_format import EPISODES_GROUP

#: Files of at most so many bytes are in the tail, which is read when the episode is opened.
SMALL_BYTES = 4096
#: The index is written after so many episodes: after a power cut, at most these are packed again.
_INDEX_EVERY = 50
#: The first date that a zip can state: packing the same episode twice gives the same bytes.
_DATE = (1980, 1, 1, 0, 0, 0)


class Packing:
    """A packed store that episodes are added to. The index lists whole zips only, and is written now and then.

    It is there before the first zip: a copy that ends early is a packed store of the episodes that it has. One process
    at a time packs into a store, because the index that is written last would lack the zips of the other.
    """

    def __init__(self, target: Path, run: str, building: Path) -> None:
        """Continue what is at `target`, until `close`.

        Args:
            target: the store.
            run: digest of its configuration.
            building: a folder beside the store, in which files are written.

        Raises:
            BadArgument: its episodes are folders, or another copy is packing into it.
            StoreError: its index is damaged or of another run.
        """
        self.target = target
        self.run = run
        self.building = building
        if next((target / EPISODES_GROUP).glob("task*_episode*/zarr.json"), None) is not None:
            raise BadArgument(f"Cannot pack into {target}: its episodes are folders; give another name.")
        self._lock = _locked(target)
        try:
            index = read_index(Folder(target), target, run)
            self.episodes: dict[str, PackedEpisode] = {} if index is None else dict(index.episodes)
            if index is None:
                self.write_index()
        except BaseException:
            os.close(self._lock)
            raise

    def present(self) -> set[str]:
        """Names of the episodes whose zips are there, with the bytes that the index says."""
        for name, entry in list(self.episodes.items()):
            path = self.target / entry.file
            if not path.is_file() or path.stat().st_size != entry.bytes:
                del self.episodes[name]
        return set(self.episodes)

    def add(self, name: str, folder: Path) -> None:
        """Pack a sealed episode from its folder."""
        path = self.target / packed_file(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        building = self.building / path.name
        tail = write_zip(folder, building)
        size = building.stat().st_size
        building.replace(path)
        self.episodes[name] = PackedEpisode(packed_file(name), size, tail, read_seal(folder).digest)
        if len(self.episodes) % _INDEX_EVERY == 0:
            self.write_index()

    def write_index(self) -> None:
        """Write the index in one step."""
        index = PackedIndex(INDEX_FORMAT, INDEX_VERSION, self.run, dict(sorted(self.episodes.items())))
        building = self.building / INDEX_FILE
        building.write_bytes(index.document())
        building.replace(self.target / INDEX_FILE)

    def close(self) -> None:
        """Write the index a last time, and let others pack."""
        try:
            self.write_index()
        finally:
            os.close(self._lock)


def _locked(target: Path) -> int:
    """The root's `zarr.json`, opened and locked; the lock ends with the process, whatever ends that."""
    handle = os.open(target / "zarr.json", os.O_RDWR | os.O_CLOEXEC)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES):
            os.close(handle)
            raise BadArgument(
                f"Cannot pack into {target}: another copy is packing into it; run the same command again when that has "
                "ended, or give another name."
            ) from None
        # A file system without locks: there, nothing but the user keeps two copies apart.
    return handle


def write_zip(folder: Path, path: Path) -> int:
    """Write the files of a folder into a zip; returns the offset from which on everything is small."""
    files = [(file, file.relative_to(folder).as_posix()) for file in folder.rglob("*") if file.is_file()]
    small = {name: name.endswith("zarr.json") or file.stat().st_size <= SMALL_BYTES for file, name in files}
    # Arrays, then small arrays, then metadata, then the seal.
    files.sort(key=lambda one: (small[one[1]], one[1].endswith("zarr.json"), one[1] == SEAL_FILE, one[1]))
    tail = 0
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as packed:
        for file, name in files:
            if not small[name]:
                tail = 0
            elif not tail:
                tail = packed.start_dir
            packed.writestr(zipfile.ZipInfo(name, _DATE), file.read_bytes())
        if not tail:
            tail = packed.start_dir
    return tail
