"""Packed stores: one zip file an episode, without compression, and an index of the episodes.

zarr's `ZipStore` and tensorstore's `zip` read such a zip as they read a folder. Its order is for readers that are
elsewhere: large files first, then the small ones and all metadata, the seal last, so that one request for the end opens
the episode.
"""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.byte_source import Folder
from vla_attention.schemas.stores.durable_files import publish_file
from vla_attention.schemas.stores.packed_index import (
    INDEX_FILE,
    INDEX_FORMAT,
    INDEX_VERSION,
    PackedEpisode,
    PackedIndex,
    packed_file,
    read_index,
)
from vla_attention.schemas.stores.partial_folders import no_link
from vla_attention.schemas.stores.root import refuse_linked_group
from vla_attention.schemas.stores.seal import SEAL_FILE, read_seal
from vla_attention.schemas.stores.store_format import EPISODES_GROUP
from vla_attention.schemas.stores.zip_members import ZipMembers

#: Files of at most so many bytes are in the tail, which is read when the episode is opened.
SMALL_BYTES = 4096
#: The index is written after so many episodes: after a power cut, at most these are packed again.
_INDEX_EVERY = 50
_BYTES_AT_ONCE = 1_000_000
#: The first date that a zip can state: packing the same episode twice gives the same bytes.
_DATE = (1980, 1, 1, 0, 0, 0)


class Packing:
    """A packed store that episodes are added to. The index lists whole zips only, and is written now and then.

    A zip is on the disk before the index lists it, so that a crash of the machine leaves no entry without its zip.

    It is there before the first zip: a copy that ends early is a packed store of the episodes that it has. The caller
    holds the lock of the store (`lock_for_writing`), and calls `write_index` when it has ended.
    """

    def __init__(self, target: Path, run: str, building: Path) -> None:
        """Continue what is at `target`.

        Args:
            target: the store.
            run: digest of its configuration.
            building: a folder beside the store, in which files are written.

        Raises:
            BadArgument: its episodes are folders.
            StoreError: its index is damaged or of another run, or a folder for zips is a link.
        """
        refuse_linked_group(target)
        self.target = target
        self.run = run
        self.building = building
        if next((target / EPISODES_GROUP).glob("task*_episode*/zarr.json"), None) is not None:
            raise BadArgument(f"Cannot pack into {target}: its episodes are folders; give another name.")
        index = read_index(Folder(target), target, run)
        self.episodes: dict[str, PackedEpisode] = {} if index is None else dict(index.episodes)
        if index is None:
            self.write_index()

    def present(self) -> set[str]:
        """Names of the episodes whose zips are there, with the bytes that the index says; a link is no zip."""
        for name, entry in list(self.episodes.items()):
            path = self.target / entry.file
            if path.is_symlink() or not path.is_file() or path.stat().st_size != entry.bytes:
                del self.episodes[name]
        return set(self.episodes)

    def add(self, name: str, folder: Path) -> None:
        """Pack a sealed episode from its folder."""
        path = self.target / packed_file(name)
        no_link(path.parent)
        building = self.building / path.name
        tail = write_zip(folder, building)
        size = building.stat().st_size
        frame = ZipMembers(Folder(self.building), building.name, size, tail).frame_digest()
        publish_file(building, path)  # before the index lists it
        self.episodes[name] = PackedEpisode(packed_file(name), size, tail, read_seal(folder).digest, frame)
        if len(self.episodes) % _INDEX_EVERY == 0:
            self.write_index()

    def write_index(self) -> None:
        """Write the index in one step."""
        index = PackedIndex(INDEX_FORMAT, INDEX_VERSION, self.run, dict(sorted(self.episodes.items())))
        building = self.building / INDEX_FILE
        building.write_bytes(index.document())
        publish_file(building, self.target / INDEX_FILE)


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
            entry = zipfile.ZipInfo(name, _DATE)
            entry.file_size = file.stat().st_size  # as `writestr` states it, which takes all bytes at once
            with file.open("rb") as content, packed.open(entry, "w") as written:
                shutil.copyfileobj(content, written, _BYTES_AT_ONCE)
        if not tail:
            tail = packed.start_dir
    return tail
