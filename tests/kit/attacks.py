"""Damage to a store that checksums and shapes cannot show: files in the wrong place, edited roots, renamed folders.

Every attack leaves files that can be read by themselves. They use nothing of the package.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from numcodecs import blosc

#: The first two episodes of a task; arrays of both have the same shapes.
FIRST, SECOND = "task000_episode000", "task000_episode001"

#: The polynomial of crc32c (RFC 3720), highest power first.
_CRC32C = 0x11EDC6F41

#: Changes the store at the first path; the other one is of another seed, with equal shapes.
Attack = Callable[[Path, Path], object]


def exchange(one: Path, other: Path) -> None:
    """Let two files or folders change places."""
    aside = one.with_name(one.name + ".aside")
    one.rename(aside)
    other.rename(one)
    aside.rename(other)


def files_of(episode: Path, array: str) -> list[Path]:
    """The files of an array's chunks."""
    return sorted(file for file in (episode / array).rglob("*") if file.is_file() and file.name != "zarr.json")


def exchange_index_entries(shard: Path, one: int, other: int, chunks: int) -> None:
    """Let two entries of a shard's index change places; the index gets its right checksum."""
    content = shard.read_bytes()
    size = 16 * chunks + 4
    index = np.frombuffer(content[-size:-4], dtype="<u8").reshape(-1, 2).copy()
    index[[one, other]] = index[[other, one]]
    shard.write_bytes(content[:-size] + with_checksum(index.tobytes()))


def with_checksum(content: bytes) -> bytes:
    """The bytes with their crc32c at the end, as in chunks and indices."""
    return content + int(google_crc32c.value(content)).to_bytes(4, "little")


def forge_chunk(content: bytes, number: int, chunks: int, keys: int) -> bytes:
    """A shard of rows in which bits of one chunk are flipped so that its crc32c stays, and rows have other sums.

    A multiple of the checksum's polynomial is added to the chunk. Most frames of Blosc decode all the same.
    """
    index = np.frombuffer(content[-16 * chunks - 4 : -4], dtype="<u8").reshape(-1, 2)
    start, length = index[number].tolist()
    frame = content[start : start + length - 4]
    before = _sums_of(frame, keys)
    assert before is not None
    for bit in range(8 * 16, 8 * len(frame) - 33):
        other = bytearray(frame)
        for power in range(33):
            if _CRC32C >> 32 - power & 1:  # the highest power comes first, and in each byte the lowest bit
                other[(bit + power) // 8] ^= 1 << (bit + power) % 8
        after = _sums_of(bytes(other), keys)
        if after is not None and (np.abs(after / before - 1) > 0.005).any():
            forged = bytes(other) + content[start + length - 4 : start + length]
            assert forged == with_checksum(bytes(other))
            return content[:start] + forged + content[start + length :]
    raise AssertionError("no such bits were found")


def _sums_of(frame: bytes, keys: int) -> np.ndarray | None:
    """The sums of the rows in a frame that pass for rows: finite numbers, not negative, with sums of at most 1.5.

    Rows of ten mantissa bits: float16 of p x 2^15.
    """
    try:
        rows = np.frombuffer(blosc.decompress(frame), np.float16).reshape(-1, keys) / np.float32(2**15)
    except (RuntimeError, ValueError):
        return None
    rows = rows[~np.isnan(rows).all(axis=1)]  # a block that is not full is filled with NaN
    sums = rows.sum(axis=1, dtype=np.float64)
    return sums if (rows >= 0).all() and (sums <= 1.5).all() else None


def flip_bit(episode: Path, array: str) -> None:
    """Flip a bit in the first chunk of an array."""
    file = files_of(episode, array)[0]
    content = bytearray(file.read_bytes())
    content[20] ^= 1
    file.write_bytes(content)


def root_leaves(path: Path) -> dict[str, tuple[Any, ...]]:
    """The fields of the root's attributes that are neither the format nor records of the job: name to path in JSON."""
    attributes = json.loads((path / "zarr.json").read_text())["attributes"]
    found = {}
    for section in ("policy", "protocol", "recording", "sites"):
        for place in _leaves(attributes[section]):
            if (section, *place) != ("policy", "checkpoint"):
                found[".".join(map(str, (section, *place)))] = (section, *place)
    return found


def _leaves(value: Any) -> Iterator[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if inner is None:
        yield ()
        return
    for key, item in inner:
        for rest in _leaves(item):
            yield (key, *rest)


def edit_root(path: Path, place: tuple[Any, ...]) -> None:
    """Change one field of the root's attributes to another value of its kind."""
    document = json.loads((path / "zarr.json").read_text())
    holder = document["attributes"]
    for key in place[:-1]:
        holder = holder[key]
    old = holder[place[-1]]
    if isinstance(old, bool):
        new: Any = not old
    elif isinstance(old, (int, float)):
        new = old + 1
    else:
        new = "base_0_rgb" if old is None else {"joint": "self", "mean": "all"}.get(old, f"{old}_x")
    holder[place[-1]] = new
    (path / "zarr.json").write_text(json.dumps(document))


def attacks(arrays: list[str]) -> dict[str, Attack]:
    """All attacks but those on the root, by name, on stores whose episodes have these arrays."""
    found: dict[str, Attack] = {}
    for array in arrays:
        found[f"files of {array} exchanged"] = lambda path, other, array=array: [
            exchange(*pair) for pair in zip(*(files_of(episode, array) for episode in two(path)), strict=True)
        ]
        found[f"{array} exchanged"] = lambda path, other, array=array: exchange(
            *(episode / array for episode in two(path))
        )
        found[f"{array} of another store"] = lambda path, other, array=array: exchange(
            *(store / "episodes" / FIRST / array for store in (path, other))
        )
        found[f"{array} with another bit"] = lambda path, other, array=array: flip_bit(first(path), array)
    for one, two_ in (("frames/base_0_rgb", "frames/left_wrist_0_rgb"), ("joint/key_role", "joint/atoms")):
        found[f"{one} exchanged with {two_}"] = lambda path, other, pair=(one, two_): exchange(
            *(files_of(first(path), array)[0] for array in pair)
        )
    for what, one_, other_ in (("layers", 0, 2), ("denoise steps", 0, 1), ("replans", 0, 4)):
        found[f"index of rows: {what} exchanged"] = lambda path, other, pair=(one_, other_): exchange_index_entries(
            shard(path), *pair, 12
        )
    found["chunks of rows: other bits of the same crc32c"] = lambda path, other: shard(path).write_bytes(
        forge_chunk(shard(path).read_bytes(), 3, 12, 39)
    )
    found["attributes exchanged"] = lambda path, other: exchange(*(episode / "zarr.json" for episode in two(path)))
    found["seals exchanged"] = lambda path, other: exchange(*(episode / "seal" for episode in two(path)))
    found["seals and attributes exchanged"] = lambda path, other: [
        exchange(*(episode / name for episode in two(path))) for name in ("seal", "zarr.json")
    ]
    found["episodes exchanged"] = lambda path, other: exchange(*two(path))
    found["an episode under another name"] = lambda path, other: first(path).rename(renamed(path))
    found["an episode copied under another name"] = lambda path, other: shutil.copytree(first(path), renamed(path))
    found["an episode of another run"] = lambda path, other: exchange(first(path), first(other))
    found["the root of another run"] = lambda path, other: exchange(path / "zarr.json", other / "zarr.json")
    return found


def two(path: Path) -> tuple[Path, Path]:
    """The folders of the two episodes."""
    return path / "episodes" / FIRST, path / "episodes" / SECOND


def first(path: Path) -> Path:
    """The folder of the first episode."""
    return two(path)[0]


def renamed(path: Path) -> Path:
    """A folder for an episode that the store does not hold."""
    return path / "episodes" / "task000_episode007"


def shard(path: Path) -> Path:
    """The file of the first episode's rows: three blocks of replans, two layers, two denoise steps."""
    (file,) = files_of(first(path), "joint/rows")
    index = np.frombuffer(file.read_bytes()[-196:-4], dtype="<u8")
    assert index[1::2].sum() + 196 == file.stat().st_size
    return file
