"""Episodes of stores: attributes, seals, links, and files that are none."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.kit.attacks import files_of
from tests.thorough.hostile.changes import VERIFY, Case, edit_array, edit_episode, episode_of, seal_again
from vla_attention.schemas.stores.seal import SEAL_FILE, seal_document

DAMAGED = "Episode task000_episode000 cannot be read: its attributes are damaged .*"
SEAL = "Episode task000_episode000 cannot be read: its seal is damaged .*"


def _set(**fields: Any) -> Callable[[Path], None]:
    """Attributes of the episode."""
    return lambda store: edit_episode(store, lambda attributes: attributes.update(fields))


def _raw(replaced: str, by: str) -> Callable[[Path], None]:
    """A change of the text in which the seal repeats the episode's attributes, of which no JSON has to remain."""

    def make(store: Path) -> None:
        document = episode_of(store) / "seal" / "zarr.json"
        text = document.read_text()
        assert replaced in text
        document.write_text(text.replace(replaced, by, 1))

    return make


def _seal(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    """A change of the seal, with its right digest."""

    def seal(store: Path) -> None:
        file = episode_of(store) / SEAL_FILE
        attributes = json.loads(file.read_bytes())["attributes"]
        change(attributes)
        file.write_bytes(seal_document(attributes))

    return seal


def _record(**fields: Any) -> Callable[[Path], None]:
    """Fields of the record of the rows in the seal."""
    return _seal(lambda seal: seal["files"]["joint/rows/c.0.0.0.0.0.0"].update(fields))


def _instead(file: str, make: Callable[[Path], object]) -> Callable[[Path], None]:
    """Something else in place of a file or folder of the episode; the seal stays as it was."""

    def change(store: Path) -> None:
        path = episode_of(store) / file
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        make(path)

    return change


def _moved(file: str) -> Callable[[Path], None]:
    """A file or folder of the episode that is outside of the store, with a link to it: the bytes are the right ones."""

    def change(store: Path) -> None:
        path, target = episode_of(store) / file, store.parent / "outside"
        path.rename(target)
        path.symlink_to(target)

    return change


def _moved_group(store: Path) -> None:
    (store / "episodes").rename(store.parent / "outside")
    (store / "episodes").symlink_to(store.parent / "outside")


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(10**12)


def _sparse_chunk(store: Path) -> None:
    """A chunk of a terabyte that the seal lists."""
    (file,) = files_of(episode_of(store), "joint/atoms")
    _sparse(file)
    seal_again(store, lambda files: files[f"joint/atoms/{file.name}"].update(size=10**12))


def _many_files(seal: dict[str, Any]) -> None:
    seal["files"] |= {f"x{i}": {"size": 1, "sha256": "0" * 64} for i in range(20_000)}


def _overlapping(store: Path) -> None:
    """Ten thousand words, each of which ten thousand pieces touch."""
    text = "a " * 10_000
    pieces = [{"key": i, "text": "", "start": 0, "stop": len(text)} for i in range(10_000)]
    edit_episode(
        store,
        lambda attributes: [
            prompt.update(text=text, instruction=[0, len(text)], pieces=pieces) for prompt in attributes["prompts"]
        ],
    )


def _many_objects(store: Path) -> None:
    """Objects that no picture shows, of which every key would have a cell."""
    things = [{"name": f"thing{i}", "kind": "object", "of_interest": False} for i in range(100_000)]

    def change(attributes: dict[str, Any]) -> None:
        attributes["objects"] += things

    edit_episode(store, change)


def _petabyte(array: str) -> Callable[[Path], None]:
    def make(store: Path) -> None:
        document = json.loads((episode_of(store) / array / "zarr.json").read_text())
        edit_array(store, array, lambda content: None, shape=[10**12, *document["shape"][1:]])

    return make


LOST = "Episode task000_episode000 cannot be read: .*"
NO_FILE = "its zarr.json cannot be read: "
EPISODE_CASES = [
    # Analyses read in the seal what these files say.
    Case("attributes: a FIFO", _instead("zarr.json", os.mkfifo), NO_FILE + "it is a FIFO and no regular", VERIFY, 1),
    Case(
        "attributes: a link out of the store", _moved("zarr.json"), NO_FILE + "it is a link that leads out", VERIFY, 1
    ),
    Case(
        "attributes: a terabyte", _instead("zarr.json", _sparse), NO_FILE + "it has 1,000,000,000,000 bytes", VERIFY, 1
    ),
    Case("attributes: an instruction of 50 MB", _set(instruction="x" * 50_000_000), r"50,.* bytes; expected at most"),
    Case("attributes: deep lists", _raw('"prompts":[', '"x":' + "[" * 10_000 + '],"prompts":['), "nested more than"),
    Case("attributes: 5,000 digits", _raw('"num_steps":', '"num_steps":' + "9" * 5000), SEAL + "64 bits"),
    Case("attributes: 10^15 replans", _set(num_replans=10**15), DAMAGED + "The number of replans is 1,000,000,000,000"),
    Case(
        "attributes: an infinite time",
        _raw('"denoise_time":[', '"denoise_time":[1e999,'),
        SEAL + "its own digest does not fit",
    ),
    Case("attributes: half a surrogate", _raw('"instruction":"', r'"instruction":"\udc00'), SEAL + "surrogate"),
    Case("attributes: pieces over one another", _overlapping, "The pieces of a prompt overlap: 10000 touch the 10000"),
    Case(
        "attributes: objects in no picture",
        _many_objects,
        r"objects/base_0_rgb has the shape \(2, 12, 5\); expected \(2, 12, 100005\)",
        ("STORE", "--group", "it=object:@interest", "--output", "OUT", "--no-cache"),
    ),
    Case("attributes: an array of a petabyte", _petabyte("joint/rows"), r"joint/rows has the shape .*; expected \(2, "),
    Case("seal: a FIFO", _instead("seal/zarr.json", os.mkfifo), LOST + "a FIFO and no regular file"),
    Case("seal: a terabyte", _instead("seal/zarr.json", _sparse), LOST + "1,000,000,000,000 bytes; expected at most"),
    Case("seal: 20,000 files", _seal(_many_files), SEAL + "The number of files is 20,"),
    Case("seal: a shard of 2^62 bytes", _record(size=2**62), "does not agree with its seal: it has another size"),
    Case("seal: checksums that are none", _record(chunks="xy" * 16), SEAL + "8 hexadecimal digits"),
    Case("seal: a million chunks", _record(chunks="0" * 8 * 10**6), "chunks, and its seal lists 1000000"),
    Case("seal: another index, verified", _record(index="0" * 64), "its index was changed", VERIFY, 1),
    Case("files: the episode is a link", _moved(""), "it is a link that leads out of the store"),
    Case("files: the episodes are a link", _moved_group, "its group 'episodes' is a link"),
    Case("files: a chunk is a FIFO", _instead("joint/atoms/c.0.0.0.0.0.0", os.mkfifo), "it is a FIFO and no regular"),
    Case("files: a chunk is a device", _instead("joint/atoms/c.0.0.0.0.0.0", _device), "a link that leads out of the"),
    Case("files: a chunk of a terabyte", _sparse_chunk, "has 1,000,000,000,000 bytes; expected at most 256,000,000"),
]
