"""The index of a packed store: its episodes, the zip of each, and the digests of their seals.

`index.json` beside the root's `zarr.json` is what a reader needs where nothing can be listed (plain HTTP), and says
where the small files of each zip begin. An index that was damaged, or is of another run, is refused. Where files can be
listed, episodes that lie there and that the index lacks are named.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from vla_attention.schemas.documents import decode_json
from vla_attention.schemas.errors import shortened
from vla_attention.schemas.jsonable import MalformedDocument, from_json, to_json
from vla_attention.schemas.limits import DOCUMENT_BYTES, ZIP_TAIL_BYTES
from vla_attention.schemas.safe_text import check_inner_path
from vla_attention.schemas.stores.byte_source import ByteSource
from vla_attention.schemas.stores.digest import seal_digest
from vla_attention.schemas.stores.remote_source import RemoteFailure, RemoteFolder
from vla_attention.schemas.stores.store_format import EPISODES_GROUP, StoreError, is_episode_name, parse_episode_name
from vla_attention.schemas.stores.store_url import StorePlace, StoreUrl

INDEX_FILE = "index.json"
INDEX_FORMAT = "vla-attention-index"
INDEX_VERSION = 1
#: What to do about episodes that an index does not list.
LIST_AGAIN = (
    "A copy that still packs lists it when it ends; otherwise run the same vla-attention store copy --packed again"
)
#: Episodes of one task in one folder: a hub takes at most 10,000 files in one.
_IN_A_FOLDER = 1000
_DIGEST = re.compile(r"[0-9a-f]{64}")
_PACK_FOLDER = re.compile(r"task[0-9]{3,}_[0-9]{3,}")


class NotListed(Exception):
    """A place that does not say which files it has."""


@dataclass(frozen=True)
class PackedEpisode:
    """One episode's zip: its path in the store, its bytes, the offset of its tail, and the digest of its seal.

    `frame` is the digest of the bytes around its files (`ZipMembers.frame_digest`). An index that leaves it out, as the
    fields of version 1 let it, is refused.
    """

    file: str
    bytes: int
    tail: int
    seal: str
    frame: str = ""

    def __post_init__(self) -> None:
        """Check the numbers, as the tail is read into memory, and that there are digests to compare with."""
        for name, digest in (("seal", self.seal), ("frame", self.frame)):
            if _DIGEST.fullmatch(digest) is None:
                raise ValueError(f"a zip has the {name} {shortened(digest, 80)!r}; expected 64 hexadecimal digits")
        if not (0 <= self.tail < self.bytes < 2**53 and self.bytes - self.tail <= ZIP_TAIL_BYTES):
            raise ValueError(f"a zip of {self.bytes} bytes cannot have its small files from {self.tail} on")


@dataclass(frozen=True)
class PackedIndex:
    """The episodes of a packed store by name; `run` is the digest of the run's configuration, `digest` of the rest."""

    format: str
    version: int
    run: str
    episodes: dict[str, PackedEpisode]
    digest: str = ""

    def __post_init__(self) -> None:
        """Check names and paths: a zip is moved, copied and removed at its path, so that the name alone decides it."""
        for name, episode in self.episodes.items():
            parse_episode_name(name)
            check_inner_path(episode.file)
            if episode.file != packed_file(name):
                raise ValueError(f"the zip of {name} is {episode.file}; expected {packed_file(name)}")

    def sealed(self) -> PackedIndex:
        """The same index with its digest."""
        return replace(self, digest=seal_digest(to_json(self)))

    def document(self) -> bytes:
        """The bytes of the file."""
        return json.dumps(to_json(self.sealed()), separators=(",", ":"), sort_keys=True).encode()


def packed_file(name: str) -> str:
    """The path of an episode's zip in a packed store."""
    task, index = parse_episode_name(name)
    return f"{EPISODES_GROUP}/task{task:03d}_{index // _IN_A_FOLDER:03d}/{name}.zip"


def unlisted_episodes(place: StorePlace, index: PackedIndex) -> tuple[str, ...]:
    """Zips and folders of episodes that lie in a packed store and that its index does not list: paths in the store.

    A link is none. At an address, folders are not looked for.

    Raises:
        NotListed: the place has no list of its files.
    """
    zips = _zips_elsewhere(place, index) if isinstance(place, StoreUrl) else set(_zips_and_folders(place))
    names = {path: path.rpartition("/")[2].removesuffix(".zip") for path in zips}
    return tuple(sorted(path for path, name in names.items() if is_episode_name(name) and name not in index.episodes))


def _zips_elsewhere(place: StoreUrl, index: PackedIndex) -> set[str]:
    try:
        files = RemoteFolder(place.url).files_below(EPISODES_GROUP)
    except (OSError, NotImplementedError) as error:
        raise NotListed(str(error).rstrip(".")) from None
    # Services name files in their own ways: with the bucket, with the repository and its commit.
    zips = {"/".join((EPISODES_GROUP, *file.split("/")[-2:])) for file in files if file.endswith(".zip")}
    if index.episodes and zips.isdisjoint(entry.file for entry in index.episodes.values()):
        raise NotListed("its list has none of the zips that the index names")
    return zips


def _zips_and_folders(store: Path) -> Iterator[str]:
    """Zips in the folders for them, and folders beside these."""
    for entry in _entries(store / EPISODES_GROUP):
        if not entry.is_dir(follow_symlinks=False):
            continue
        if is_pack_folder(entry.name):
            files = (file.name for file in _entries(Path(entry.path)) if file.is_file(follow_symlinks=False))
            yield from (f"{EPISODES_GROUP}/{entry.name}/{name}" for name in files if name.endswith(".zip"))
        else:
            yield f"{EPISODES_GROUP}/{entry.name}"


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except OSError:  # `verify` names a lost group
        return []


def is_pack_folder(name: str) -> bool:
    """Whether a folder beside the episodes has the name of one that holds zips."""
    return _PACK_FOLDER.fullmatch(name) is not None


def read_index(source: ByteSource, store: object, run: str) -> PackedIndex | None:
    """The index of a store whose run has this digest; None when it has none.

    Raises:
        StoreError: it cannot be read, was damaged, or belongs to another run.
    """
    try:
        content = source.whole(INDEX_FILE, most=DOCUMENT_BYTES)
    except RemoteFailure:
        raise
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise StoreError(f"The store {store} cannot be read: its {INDEX_FILE}: {error.strerror or error}.") from None
    try:
        document = decode_json(content)
        if not isinstance(document, dict) or document.get("format") != INDEX_FORMAT:
            raise ValueError(f"its 'format' is not '{INDEX_FORMAT}'")
        if document.get("version") != INDEX_VERSION:
            raise ValueError(f"its version is {document.get('version')!r}; this program reads {INDEX_VERSION}")
        if document.get("digest") != seal_digest(document):
            raise ValueError("its own digest does not fit")
        index = from_json(PackedIndex, document)
    except (MalformedDocument, ValueError) as error:
        raise StoreError(
            f"The store {store} cannot be read: its {INDEX_FILE} is damaged ({error}). vla-attention store copy "
            "--packed writes it again."
        ) from None
    if index.run != run:
        raise StoreError(
            f"The store {store} cannot be read: its {INDEX_FILE} belongs to a run of another configuration than its "
            "zarr.json states."
        )
    return index
