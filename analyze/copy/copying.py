"""Copies of stores with parts left behind: smaller, honest about what is missing, and whole for `verify`.

An episode's attributes list its arrays, and its seal has the digest of every piece of metadata. A copy without some arrays is
therefore not what is left after deleting folders, which is a damaged store. Its attributes list what it has, its root says
what was left behind and from which run it comes, and it is sealed anew. Everything that is kept is copied byte by byte, and before
metadata is rewritten it is held against the seal that it came with: a damaged episode is refused, never sealed as if it were
whole. The values keep the digests that the capture wrote, so damage to them is found in the copy as well.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vla_attention.schemas.errors import BadArgument, unknown_name
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store
from vla_attention.schemas.stores.store_format import (
    EPISODES_GROUP,
    PARTIAL_SUFFIX,
    SEAL_GROUP,
    STORE_SUFFIX,
    CorruptEpisode,
    EpisodeSeal,
    RootAttributes,
    RunMismatch,
)


@dataclass(frozen=True)
class Part:
    """Arrays that may stay behind: what they are for, and a pattern that finds their names, and their files', in an episode."""

    purpose: str
    pattern: str


#: What may stay behind. Rows, atoms, roles and the small arrays are the store, and always come along.
PARTS: dict[str, Part] = {
    "frames": Part("the cameras' pictures; overlays need them", r"^frames/"),
    "objects": Part("what each patch shows; object: groups need it", r"^objects/"),
    "contributions": Part("value-weighted contributions; their norms need them", r"/contribution(/|$)"),
}
REST = "rest"


@dataclass(frozen=True)
class Copied:
    """What a copy came to: episodes added, episodes that were there already, bytes copied and bytes left behind."""

    added: int
    present: int
    copied_bytes: int
    left_bytes: int


def part_sizes(store: Store) -> dict[str, int]:
    """Bytes of each part of a store, of everything else as `rest`."""
    sizes = dict.fromkeys((*PARTS, REST), 0)
    for episode in store.episodes:
        for file in _files(episode.folder):
            sizes[_part_of(file) or REST] += (episode.folder / file).stat().st_size
    return sizes


def check_parts(names: Sequence[str]) -> tuple[str, ...]:
    """Raise `UnknownName` for a part that does not exist; returns each once, in a fixed order."""
    for name in names:
        if name not in PARTS:
            raise unknown_name("part", name, PARTS)
    return tuple(name for name in PARTS if name in names)


def copy_store(
    store: Store, target: Path, without: Sequence[str], progress: Callable[[int], object] | None = None
) -> Copied:
    """Copy every episode of a store; `progress` is called with 1 after each. A copy that exists is brought up to date.

    Raises:
        BadArgument: the target cannot be written, or is the store itself.
        RunMismatch: the target is a store of another run, or a copy without other parts.
        CorruptEpisode: an episode is damaged. Episodes that were copied before it stay.
    """
    without = check_parts(without)
    if target.suffix != STORE_SUFFIX:
        raise BadArgument(f"Cannot copy to {target}: expected a name that ends with '{STORE_SUFFIX}'.")
    if target.resolve() == store.path.resolve():
        raise BadArgument(f"Cannot copy {store.path} to itself; give another name.")
    try:
        return _copy(store, target, without, progress)
    except OSError as error:
        if isinstance(error, (BadArgument, CorruptEpisode)) or error.errno is None:
            raise
        raise BadArgument(f"Cannot copy to {target}: {error.strerror or error}; give another place.") from None


def _copy(store: Store, target: Path, without: tuple[str, ...], progress: Callable[[int], object] | None) -> Copied:
    building = target.with_name(target.name + PARTIAL_SUFFIX) / f"copy-{os.getpid()}"
    root = _root_document(store, without)
    run = hashlib.sha256(root).hexdigest()
    building.mkdir(parents=True)
    try:
        _ensure_root(store, target, root, building)
        present = {entry.name for entry in (target / EPISODES_GROUP).iterdir() if entry.is_dir()}
        added = copied = left = 0
        for episode in store.episodes:
            if episode.name not in present:
                folder = building / episode.name
                sizes = _copy_episode(episode, folder, without, run)
                copied, left, added = copied + sizes[0], left + sizes[1], added + 1
                _rename_new(folder, target / EPISODES_GROUP / episode.name)
            if progress is not None:
                progress(1)
    finally:
        shutil.rmtree(building, ignore_errors=True)
        _remove_if_empty(building.parent)
    return Copied(added, len(store.episodes) - added, copied, left)


def _ensure_root(store: Store, target: Path, root: bytes, building: Path) -> None:
    """Make the empty copy in one step, or check that what is there is a copy of the same run without the same parts."""
    if not target.exists():
        empty = building / "root"
        (empty / EPISODES_GROUP).mkdir(parents=True)
        (empty / "zarr.json").write_bytes(root)
        shutil.copyfile(store.path / EPISODES_GROUP / "zarr.json", empty / EPISODES_GROUP / "zarr.json")
        _rename_new(empty, target)
    if (target / "zarr.json").read_bytes() != root if (target / "zarr.json").is_file() else True:
        open_store(target)  # says so when it is no store at all
        raise RunMismatch(
            f"Cannot continue the copy {target}: it is of another run than {store.path}, or leaves other parts behind; "
            "give another name."
        )


def _copy_episode(episode: StoredEpisode, folder: Path, without: tuple[str, ...], run: str) -> tuple[int, int]:
    """Write the copy of one episode; returns (bytes copied, bytes left behind)."""
    if not episode.is_of_this_run:
        raise CorruptEpisode(f"Episode {episode.name} was recorded under other attributes than its store has now.")
    attributes = episode.attributes
    kept = {name: record for name, record in attributes.arrays.items() if _part_of(name) not in without}
    files = [file for file in _files(episode.folder) if _part_of(file) not in without]
    digests: dict[str, str] = {}
    copied = 0
    for file in files:
        if file == f"{SEAL_GROUP}/zarr.json":
            continue
        place = folder / file
        place.parent.mkdir(parents=True, exist_ok=True)
        if place.name != "zarr.json":
            shutil.copyfile(episode.folder / file, place)
        else:
            content = episode.sealed(file)  # an error when it is not what was written
            if file == "zarr.json":
                content = _with_attributes(content, to_json(replace(attributes, arrays=kept)))
            place.write_bytes(content)
            digests[file] = hashlib.sha256(content).hexdigest()
        copied += place.stat().st_size
    for name in kept:
        if f"{name}/zarr.json" not in digests:
            raise CorruptEpisode(f"Episode {episode.name} lacks the array {name}: its files are gone.")
    seal = (episode.folder / SEAL_GROUP / "zarr.json").read_bytes()
    (folder / SEAL_GROUP).mkdir()
    sealed = _with_attributes(seal, to_json(EpisodeSeal(run=run, files=dict(sorted(digests.items())))))
    (folder / SEAL_GROUP / "zarr.json").write_bytes(sealed)
    left = sum((episode.folder / file).stat().st_size for file in _files(episode.folder) if _part_of(file) in without)
    return copied + len(sealed), left


def _root_document(store: Store, without: tuple[str, ...]) -> bytes:
    """The copy's `zarr.json`: the run's, with what was left behind."""
    content = (store.path / "zarr.json").read_bytes()
    if not without:
        return content
    root = store.attributes
    recording = replace(
        root.recording,
        frames=root.recording.frames and "frames" not in without,
        contributions=root.recording.contributions and "contributions" not in without,
    )
    before = root.provenance.get("copied_without", "")
    everything = [name for name in PARTS if name in without or name in before.split(", ")]
    provenance = dict(root.provenance) | {"copied_without": ", ".join(everything)}
    # The first store of the line: a copy of a copy still names what was captured.
    provenance.setdefault("copied_from", hashlib.sha256(content).hexdigest())
    changed: RootAttributes = replace(root, recording=recording, provenance=provenance)
    return _with_attributes(content, to_json(changed))


def _with_attributes(document: bytes, attributes: dict[str, Any]) -> bytes:
    """A group's `zarr.json` with other attributes."""
    return json.dumps(json.loads(document) | {"attributes": attributes}, indent=2).encode()


def _part_of(path: str) -> str | None:
    """The part that an array, or a file of the episode, belongs to."""
    return next((name for name, part in PARTS.items() if re.search(part.pattern, path)), None)


def _files(folder: Path) -> list[str]:
    """Every file below an episode's folder, relative to it."""
    return sorted(file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())


def _rename_new(source: Path, target: Path) -> None:
    """Rename a folder to a name that nobody uses; another copy may have been first, with the same content."""
    try:
        source.rename(target)
    except OSError as error:
        if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
            raise


def _remove_if_empty(folder: Path) -> None:
    try:
        folder.rmdir()
    except OSError:
        return
