"""Packed stores: an index and zips that claim what they do not have."""

from __future__ import annotations

import json
import os
import stat
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.thorough.hostile.changes import Case
from vla_attention.schemas.stores.digest import seal_digest

INDEX = r"its index\.json is damaged .*"
ZIP = "Episode task000_episode000 cannot be read: "


def _index(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    """A change of the index, with its right digest."""

    def make(store: Path) -> None:
        document = json.loads((store / "index.json").read_text())
        change(document)
        document["digest"] = seal_digest(document)
        (store / "index.json").write_text(json.dumps(document))

    return make


def _entry(**fields: Any) -> Callable[[Path], None]:
    """Fields of the only episode in the index."""
    return _index(lambda document: next(iter(document["episodes"].values())).update(fields))


def _instead(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def change(store: Path) -> None:
        (store / "index.json").unlink()
        make(store / "index.json")

    return change


def _zip_of(store: Path) -> Path:
    (found,) = store.rglob("*.zip")
    return found


def _zip(change: Callable[[Path], object]) -> Callable[[Path], None]:
    """A change of the zip, whose length the index then states."""

    def make(store: Path) -> None:
        change(_zip_of(store))
        length = _zip_of(store).stat().st_size
        _entry(bytes=length, tail=max(0, length - 10_000_000))(store)

    return make


def _many_members(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as made:
        for i in range(20_000):
            made.writestr(f"x{i}", b"")


def _compressed(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("seal/zarr.json", b"[" * 10**8)


def _large_member(path: Path) -> None:
    """A directory that says of the seal that it has a petabyte."""
    with zipfile.ZipFile(path, "w") as made:
        made.writestr("seal/zarr.json", b"{}")
    content = bytearray(path.read_bytes())
    entry = content.index(b"PK\x01\x02")
    content[entry + 20 : entry + 28] = struct.pack("<II", 2**32 - 2, 2**32 - 2)
    path.write_bytes(content)


def _directory_elsewhere(path: Path) -> None:
    """An end of the zip that says that the directory begins before the file."""
    content = bytearray(path.read_bytes())
    end = content.rindex(b"PK\x05\x06")
    content[end + 12 : end + 20] = struct.pack("<II", 2**32 - 2, 2**32 - 2)
    path.write_bytes(content)


def _linked(store: Path) -> None:
    path, target = _zip_of(store), store.parent / "outside.zip"
    path.rename(target)
    path.symlink_to(target)


def _fifo_zip(store: Path) -> None:
    path = _zip_of(store)
    path.unlink()
    os.mkfifo(path)


def _link_member(path: Path) -> None:
    """What unpacks it makes a link that leads out of the store."""
    with zipfile.ZipFile(path, "a") as made:
        link = zipfile.ZipInfo("joint/link")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        made.writestr(link, "/etc")


def _twice(path: Path) -> None:
    with zipfile.ZipFile(path, "a") as made:
        made.writestr("seal/zarr.json", b"{}")


def _many_episodes(store: Path) -> None:
    entry = {"file": "episodes/x.zip", "bytes": 10, "tail": 5, "seal": "0" * 64}
    _index(lambda document: document.update(episodes={f"x{i}": entry for i in range(400_000)}))(store)


PACKED_CASES = [
    Case("index: a FIFO", _instead(os.mkfifo), "index.json: it is a FIFO and no regular file"),
    Case(
        "index: a device", _instead(lambda index: index.symlink_to("/dev/zero")), "a link that leads out of the store"
    ),
    Case("index: a folder", _instead(Path.mkdir), "index.json: it is a folder and no regular file"),
    Case("index: deep lists", _instead(lambda index: index.write_text("[" * 10**6)), INDEX + "nested more than 64"),
    Case("index: 40 MB", _many_episodes, r"index\.json: it has .* bytes; expected at most 32,000,000"),
    Case(
        "index: a zip of 2^60 bytes", _entry(bytes=2**60, tail=0), INDEX + "a zip of 1152921504606846976 bytes cannot"
    ),
    Case("index: a zip of 30 digits", _entry(bytes=10**30), INDEX + "does not fit into 64 bits"),
    Case("index: a tail of a gigabyte", _entry(bytes=10**9, tail=0), INDEX + "a zip of 1000000000 bytes cannot have"),
    Case("index: a tail behind the zip", _entry(tail=2**40), INDEX + "cannot have its small files from"),
    Case("index: a path out of the store", _entry(file="../outside.zip"), INDEX + "cannot be the path of a file"),
    Case("index: a path of 1 MB", _entry(file="x" * 10**6), INDEX + "The length of the path"),
    Case("index: a version of 300 digits", _index(lambda d: d.update(version=10**300)), INDEX + "its version is 1000"),
    Case("index: no name", _index(lambda d: d.update(episodes={"x\n": d["episodes"].popitem()[1]})), "no episode name"),
    Case("zip: a link out of the store", _linked, ZIP + ".*it is a link that leads out of the store"),
    Case("zip: a FIFO", _fifo_zip, ZIP + ".*it is a FIFO and no regular file"),
    Case("zip: 20,000 files", _zip(_many_members), ZIP + ".*has more than 10,000 files"),
    Case("zip: compressed", _zip(_compressed), ZIP + ".*in another way than vla-attention copy --packed writes it"),
    Case(
        "zip: a seal of 4 GB", _zip(_large_member), ZIP + ".*in another way than vla-attention copy --packed writes it"
    ),
    Case("zip: a directory elsewhere", _zip(_directory_elsewhere), ZIP + ".*cannot be read: "),
    Case("zip: a link", _zip(_link_member), ZIP + ".*in another way than vla-attention copy --packed writes it"),
    Case("zip: two seals", _zip(_twice), ZIP + ".*names a file twice"),
]
