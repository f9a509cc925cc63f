"""Small stores that are written as captures write them, flushed to the disk, and what is found of them there."""

from __future__ import annotations

import functools
from pathlib import Path

from tests.kit.stores import StoreSpec
from tests.kit.stores import write_store as write_made_up_store
from vla_attention.schemas.stores.reader import open_store

#: Flushes files to the disk, as captures do.
write_store = functools.partial(write_made_up_store, durable=True)
SPEC = StoreSpec(tasks=(0,), episodes=2, replans=9, layers=(0,), heads=(0,), frames=False)


def store_bytes(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def names(path: Path) -> list[str]:
    return [episode.name for episode in open_store(path).episodes]


def leftovers(path: Path) -> list[Path]:
    return [*path.with_name(path.name + ".partial").glob("*"), *path.glob(".writing")]
