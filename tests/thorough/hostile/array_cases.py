"""Arrays of stores: what their zarr.json claims, and bytes that decode to more than they may."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
from numcodecs import blosc

from tests.kit.attacks import files_of, with_checksum
from tests.kit.stores import reseal, write_array
from tests.thorough.hostile.changes import (
    VERIFY,
    Case,
    change_index,
    edit_array,
    edit_episode,
    episode_of,
    replace_chunk,
    rows_file,
    seal_again,
)
from vla_attention.schemas.stores.digest import bytes_digest

ROWS = "Array joint/rows of episode task000_episode000 cannot be read: "
ATOMS = "Array joint/atoms of episode task000_episode000 cannot be read: "
UNIFORM = r"joint/uniform has the shape \(.*\); expected \(2, 2, 2, "
#: What is said of another layout, before the place in the zarr.json.
FORM = r"its zarr.json is not that of an array of this format: \$\.codecs"
STATE = "Array state of episode task000_episode000 cannot be read: "
#: Zeros that take some kilobytes of a file.
BOMB = 96_000_000


def _rows(change: Callable[[dict[str, Any]], object], shape: Any = None) -> Callable[[Path], None]:
    return lambda store: edit_array(store, "joint/rows", change, shape)


def _atoms(change: Callable[[dict[str, Any]], object], shape: Any = None) -> Callable[[Path], None]:
    return lambda store: edit_array(store, "joint/atoms", change, shape)


def _state(change: Callable[[dict[str, Any]], object], shape: Any) -> Callable[[Path], None]:
    """Of the state an analysis knows the number of replans only."""
    return lambda store: edit_array(store, "state", change, shape)


def _uniform(*shape: int) -> Callable[[Path], None]:
    """What uniform attention gives, in another shape; the rows are (2, 2, 2, 2, 1, 39)."""
    return lambda store: edit_array(store, "joint/uniform", lambda content: None, list(shape))


def _codecs(codecs: list[Any]) -> Callable[[Path], None]:
    return _atoms(lambda content: content.update(codecs=codecs))


def _chunks(content: dict[str, Any]) -> list[int]:
    extents: list[int] = content["chunk_grid"]["configuration"]["chunk_shape"]
    return extents


def _inner(content: dict[str, Any]) -> dict[str, Any]:
    settings: dict[str, Any] = content["codecs"][0]["configuration"]
    return settings


def _blosc_bomb(name: bytes) -> Callable[[Path], None]:
    """One chunk of states that is what it says: zeros, in a file of a hundredth or less."""

    def make(store: Path) -> None:
        frame = blosc.compress(np.zeros(BOMB // 8), name, 9, blosc.SHUFFLE, typesize=8)
        replace_chunk(store, "state", frame)
        shape = [2, BOMB // 16]
        edit_array(store, "state", lambda content: _chunks(content).__setitem__(slice(None), shape), shape=shape)

    return make


def _lying_frame(store: Path) -> None:
    """A frame whose header says that it decodes to 2 GB."""
    (file,) = files_of(episode_of(store), "joint/atoms")
    frame = bytearray(file.read_bytes()[:-4])
    frame[4:8] = (2_000_000_000).to_bytes(4, "little")
    replace_chunk(store, "joint/atoms", bytes(frame))


def _large_pictures(store: Path) -> None:
    """Pictures of zeros that take 96 MB, in chunks of 3 MB, which only a reading of all would need at once."""
    folder = episode_of(store) / "frames" / "base_0_rgb"
    shape = (32, 1000, 1000, 3)
    write_array(folder, np.zeros(shape, np.uint8), chunks=(1, 1000, 1000, 3), shards=shape, overwrite=True)
    reseal(episode_of(store))
    edit_episode(store, lambda attributes: attributes["arrays"]["frames/base_0_rgb"].update(shape=list(shape)))


def _offsets(change: Callable[[np.ndarray], np.ndarray | None]) -> Callable[[Path], None]:
    return lambda store: change_index(store, change)


def _entry(offset: int, length: int) -> Callable[[np.ndarray], None]:
    def change(index: np.ndarray) -> None:
        index[0] = offset, length

    return change


def _sparse_shard(store: Path) -> None:
    """A shard of a terabyte of holes, whose first chunk takes nearly all of it."""
    file = rows_file(store)
    content, size = file.read_bytes(), 68
    with file.open("r+b") as shard:
        shard.truncate(10**12)
        shard.seek(10**12 - size)
        shard.write(content[-size:])
    seal_again(store, lambda files: files[f"joint/rows/{file.name}"].update(size=10**12))
    change = np.frombuffer(content[-size:-4], dtype="<u8").reshape(-1, 2).copy()
    change[0] = 0, 10**11
    change[1:, 0] += 10**11
    stored = with_checksum(change.tobytes())
    with file.open("r+b") as shard:
        shard.seek(10**12 - size)
        shard.write(stored)
    seal_again(store, lambda files: files[f"joint/rows/{file.name}"].update(size=10**12, index=bytes_digest(stored)))


CHUNK = {"name": "bytes", "configuration": {"endian": "little"}}
BLOSC = {"typesize": 4, "cname": "lz4", "clevel": 5, "shuffle": "bitshuffle", "blocksize": 0}


def _array_document(text: str) -> Callable[[Path], None]:
    def make(store: Path) -> None:
        (episode_of(store) / "joint/atoms/zarr.json").write_text(text)
        seal_again(store)

    return make


ARRAY_CASES = [
    Case("array: no JSON", _array_document("["), "joint/atoms/zarr.json does not say what its seal", VERIFY, 1),
    Case(
        "array: deep JSON", _array_document("[" * 10**6), "joint/atoms/zarr.json does not say what its seal", VERIFY, 1
    ),
    Case("array: 40 MB", _array_document(f'{{"x": "{"y" * 40_000_000}"}}'), r"expected at most 32,000,000"),
    Case("array: no codecs", _codecs([]), ATOMS + FORM),
    Case("array: the codec zstd", _codecs([CHUNK, {"name": "zstd"}]), ATOMS + FORM + ".*'zstd'"),
    Case("array: the codec pickle", _codecs([{"name": "numcodecs.pickle"}]), ATOMS + FORM + ".*'numcodecs.pickle'"),
    Case(
        "array: compressed by snappy",
        _codecs([CHUNK, {"name": "blosc", "configuration": BLOSC | {"cname": "snappy"}}, {"name": "crc32c"}]),
        ATOMS + FORM + ".*'snappy'",
    ),
    Case("array: chunks of nothing", _atoms(lambda c: _chunks(c).__setitem__(0, 0)), ATOMS + ".*chunk_shape"),
    Case(
        "array: chunks of 10^12", _atoms(lambda c: _chunks(c).__setitem__(0, 10**12)), ATOMS + "a chunk of it would ta"
    ),
    Case("array: 10^8 chunks", _state(lambda c: None, [2, 10**8]), STATE + "its file holds", VERIFY, 1),
    Case("array: a petabyte", _state(lambda c: None, [2, 10**15]), STATE + "its shape is .*bytes", VERIFY, 1),
    Case(
        "array: masses of another shape", _atoms(lambda c: None, [2, 2, 2, 2, 1, 8]), r"expected \(2, 2, 2, 2, 1, 9\)"
    ),
    Case(
        "rows: chunks of nothing",
        _rows(lambda c: _inner(c)["chunk_shape"].__setitem__(0, 0)),
        ROWS + FORM + ".*chunk_shape",
    ),
    Case(
        "rows: a shard in a shard",
        _rows(lambda c: _inner(c).update(codecs=deepcopy(c["codecs"]))),
        ROWS + FORM + ".*codecs",
    ),
    Case("rows: chunks without checksums", _rows(lambda c: _inner(c)["codecs"].pop()), ROWS + FORM + ".*codecs"),
    Case(
        "uniform: not listed",
        lambda store: edit_episode(store, lambda attributes: attributes["arrays"].pop("joint/uniform")),
        "lacks the array joint/uniform",
    ),
    Case("uniform: 10^12 replans", _uniform(10**12, 1, 1, 1, 1, 39), UNIFORM + r"2, 1, 39\), or 1 in place of a leng"),
    Case("shard: an offset of 2^63", _offsets(_entry(2**63, 100)), ROWS + ".*overlap or lie outside"),
    Case("shard: no chunks", _offsets(_entry(2**64 - 1, 2**64 - 1)), ROWS + ".*lacks chunk 0: it is missing"),
    Case(
        "shard: two chunks at one place", _offsets(lambda index: index[[0, 0, 2, 3]]), ROWS + ".*overlap or lie outside"
    ),
    Case("shard: a chunk of 100 GB", _sparse_shard, ROWS + "its index names a chunk of 100000000000 bytes"),
    Case("bomb: zstd", _blosc_bomb(b"zstd"), STATE + "it would take 96,000,000 bytes", VERIFY, 1),
    Case("bomb: a header of 2 GB", _lying_frame, ATOMS + ".*its header says 2000000000 decoded bytes; expected"),
    Case("bomb: pictures in many chunks", _large_pictures, "frames/base_0_rgb", VERIFY, 1),
]
