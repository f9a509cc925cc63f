"""Changing a store by hand and sealing it again: whoever wants to attack a reader has the right checksums, too."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.kit.attacks import FIRST, files_of, with_checksum
from vla_attention.schemas.stores.digest import bytes_digest, run_digest
from vla_attention.schemas.stores.seal import seal_document

#: The words of an analysis that reads roles, sums, masses and the rows of one word.
WORDS = ("STORE", "--group", "noun=word:bowl", "--output", "OUT", "--no-cache")
VERIFY = ("store", "verify", "STORE", "--values")


@dataclass(frozen=True)
class Case:
    """One hostile file or folder.

    Attributes:
        name: what it does, in words.
        make: changes the store at a path, or writes the file there.
        sentence: a regular expression for what must be said.
        words: the command; STORE, FILE and OUT stand for paths.
        code: its exit code.
    """

    name: str
    make: Callable[[Path], object]
    sentence: str
    words: tuple[str, ...] = WORDS
    code: int = 2


def episode_of(store: Path) -> Path:
    """The folder of the only episode."""
    return store / "episodes" / FIRST


def edit(document: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the attributes in a zarr.json."""
    content = json.loads(document.read_text())
    change(content["attributes"])
    document.write_text(json.dumps(content))


def edit_root(store: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the root's attributes, and seal the episode for the run that they state now."""
    edit(store / "zarr.json", change)
    seal_again(store)


def edit_episode(store: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the episode's attributes, and seal it."""
    edit(episode_of(store) / "zarr.json", change)
    seal_again(store)


def edit_array(store: Path, array: str, change: Callable[[dict[str, Any]], object], shape: Any = None) -> None:
    """Change the zarr.json of an array, and the shape in the episode's attributes if one is given; seal both."""
    document = episode_of(store) / array / "zarr.json"
    content = json.loads(document.read_text())
    change(content)
    if shape is not None:
        content["shape"] = shape
        edit(episode_of(store) / "zarr.json", lambda attributes: attributes["arrays"][array].update(shape=shape))
    document.write_text(json.dumps(content))
    seal_again(store)


def seal_again(store: Path, change: Callable[[dict[str, Any]], object] = lambda files: None) -> None:
    """Seal the episode: sizes and digests of its files as they are, chunks of shards as they were, then `change`."""
    folder = episode_of(store)
    document = folder / "seal" / "zarr.json"
    seal = json.loads(document.read_text())["attributes"]
    for name, record in seal["files"].items():
        file = folder / name
        if file.is_file() and file.stat().st_size < 10**9:
            content = file.read_bytes()
            record |= {"size": len(content), "sha256": bytes_digest(content)}
            if name in seal["documents"]:
                with suppress(ValueError, RecursionError):  # the seal repeats what is a document
                    seal["documents"][name] = json.loads(content)
    root = json.loads((store / "zarr.json").read_bytes())["attributes"]
    seal["run"] = run_digest(root)
    change(seal["files"])
    document.write_bytes(seal_document(seal))


def replace_chunk(store: Path, array: str, content: bytes) -> None:
    """Give the only file of an array other bytes, with their checksum."""
    (file,) = files_of(episode_of(store), array)
    file.write_bytes(with_checksum(content))
    seal_again(store)


def rows_file(store: Path) -> Path:
    """The shard of the rows: one block of replans, two layers, two denoise steps."""
    (file,) = files_of(episode_of(store), "joint/rows")
    return file


def change_index(store: Path, change: Callable[[np.ndarray], np.ndarray | None]) -> None:
    """Change the index (chunk, 2) of the shard of the rows; its checksum and the seal are right."""
    file = rows_file(store)
    content, size = file.read_bytes(), 16 * 4 + 4
    index = np.frombuffer(content[-size:-4], dtype="<u8").reshape(-1, 2).copy()
    other = change(index)
    stored = with_checksum((index if other is None else other).tobytes())
    file.write_bytes(content[:-size] + stored)
    name = f"joint/rows/{file.name}"
    seal_again(store, lambda files: files[name].update(index=bytes_digest(stored)))
