"""Seals: a seal lists every file of an episode, and binds them to the episode's name and to its run.

Capture seals an episode when all of it is written, `vla-attention store copy` when it has left something out. The
reader (`reader.py`, `sealed_files.py`) compares what it reads with the seal. Its digests find accidents and partial
edits: files that were damaged, exchanged, cut off or changed. They are no signature: who can compute them
can make a new seal.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from vla_attention.schemas.jsonable import from_json, to_json
from vla_attention.schemas.stores.array_metadata import array_metadata
from vla_attention.schemas.stores.byte_source import ByteSource, Folder
from vla_attention.schemas.stores.digest import CHECKSUM_BYTES, bytes_digest
from vla_attention.schemas.stores.root import group_attributes
from vla_attention.schemas.stores.sealed_files import index_places, index_size
from vla_attention.schemas.stores.store_format import SEAL_GROUP, EpisodeSeal, FileRecord

SEAL_FILE = f"{SEAL_GROUP}/zarr.json"


def seal_episode(folder: Path, name: str, run: str, copied_from: str = "") -> EpisodeSeal:
    """Seal an episode whose files are all in `folder`; returns what was written.

    Args:
        folder: where the episode is at the moment.
        name: the name of its group in the store.
        run: digest of the run's configuration, see `run_digest`.
        copied_from: digest of the seal under which the episode was captured, if this is a changed copy.
    """
    (folder / SEAL_FILE).unlink(missing_ok=True)
    files = {file.relative_to(folder).as_posix(): file for file in sorted(folder.rglob("*")) if file.is_file()}
    documents = {name: json.loads(file.read_bytes()) for name, file in files.items() if file.name == "zarr.json"}
    about = {
        name.rpartition("/")[0]: array_metadata(of) for name, of in documents.items() if of["node_type"] == "array"
    }
    shards = {f"{name}/{array.file}": array.shard_chunks for name, array in about.items()}
    records = {name: _file_record(file, shards.get(name)) for name, file in files.items()}
    seal = EpisodeSeal(name, run, records, documents, digest="", copied_from=copied_from)
    content = seal_document(to_json(seal))
    (folder / SEAL_GROUP).mkdir(exist_ok=True)
    (folder / SEAL_FILE).write_bytes(content)
    return from_json(EpisodeSeal, group_attributes(content))


def seal_document(attributes: Mapping[str, Any]) -> bytes:
    """The bytes of the file of a seal: its attributes, after a digest that fits."""
    first = {"digest": "", **{name: value for name, value in attributes.items() if name != "digest"}}
    group = {"zarr_format": 3, "node_type": "group", "attributes": first}
    content = json.dumps(group, separators=(",", ":")).encode()
    return content.replace(b'"digest":""', b'"digest":"%s"' % bytes_digest(content).encode(), 1)


def read_seal(place: Path | ByteSource) -> EpisodeSeal:
    """Read the seal of the episode whose files are there.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no seal, or its own digest does not fit.
    """
    source = Folder(place) if isinstance(place, Path) else place
    content = source.whole(SEAL_FILE)
    attributes = group_attributes(content)
    digest = str(attributes.get("digest"))
    if bytes_digest(content.replace(digest.encode(), b"", 1)) != digest:
        raise ValueError("its own digest does not fit")
    return from_json(EpisodeSeal, attributes)


def identity_problem(seal: EpisodeSeal, name: str, run: str) -> str | None:
    """Why the sealed episode is not the one of that name in a store of that run, or None."""
    if seal.episode != name:
        return f"its seal is that of {seal.episode}: a folder was renamed, or copied under another name"
    if seal.run != run:
        return (
            "its seal belongs to a run of another configuration than the zarr.json of the store states (policy, "
            "protocol, recording, sites): one of them was changed, or the episode is of another store"
        )
    return None


def _file_record(path: Path, chunks: int | None) -> FileRecord:
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        record = FileRecord(size, hashlib.file_digest(file, "sha256").hexdigest())
        if chunks is None:
            return record
        stored = os.pread(file.fileno(), index_size(chunks), max(0, size - index_size(chunks)))
        ends = [offset + length for offset, length in index_places(stored)]
        checksums = [os.pread(file.fileno(), CHECKSUM_BYTES, end - CHECKSUM_BYTES) for end in ends if end > 0]
    return replace(record, index=bytes_digest(stored), chunks=b"".join(checksums).hex())
