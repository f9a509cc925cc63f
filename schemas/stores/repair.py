"""`repair` of both command lines: damaged episodes are moved out of a store, so that --resume records them again.

They go into `NAME.zarr.damaged/`, beside the store as all folders that readers must not see, and none of them is
deleted. What processes left that have ended is removed.
"""

from __future__ import annotations

import json
import os
import uuid
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from vla_attention.schemas.stores.durable_files import publish_file
from vla_attention.schemas.stores.locks import Holder, Locks, episode_locks
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store
from vla_attention.schemas.stores.root import group_document
from vla_attention.schemas.stores.seal import read_seal
from vla_attention.schemas.stores.store_format import EPISODES_DOCUMENT, StoreError
from vla_attention.schemas.stores.store_url import local_path
from vla_attention.schemas.stores.verify import DamagedEpisode, look_at, store_faults

#: Ending of the folder beside the store with the episodes that were moved aside. It may be deleted at any time.
DAMAGED_SUFFIX = ".damaged"
_REASON = "reason.json"


@dataclass(frozen=True)
class Finding:
    """A damaged episode, and what was done about it.

    moved_to: its folder beside the store; None if it is still in the store.
    holder: the process that is writing the episode, which is then left alone.
    """

    damaged: DamagedEpisode
    moved_to: Path | None = None
    holder: Holder | None = None


def damaged_folder(store: Path) -> Path:
    """Return the folder of episodes that were moved aside."""
    return store.with_name(store.name + DAMAGED_SUFFIX)


def repair_store(path: Path, verify: bool = False, dry_run: bool = False) -> list[Finding]:
    """Move every damaged episode of a store aside; other processes may read and fill the store meanwhile.

    An episode is locked before it is moved, and looked at again: a process that has recorded it anew in the meantime
    does not lose it. An episode that another process is writing stays.

    Args:
        path: the store.
        verify: read every byte of every episode instead of a cheap look.
        dry_run: move nothing.

    Raises:
        StoreNotFound: nothing exists at `path`.
        StoreError: something other than a store exists there, its root was changed, or a folder cannot be moved.
    """
    # Episodes are moved beside the store itself; a link to it may be on another file system.
    path = path.resolve() if path.is_symlink() else path
    store = open_store(path, as_recorded=True)
    _check_root(store)
    looks = [(episode, look_at(store, episode, verify)) for episode in store.episodes]
    damaged = [(episode, fault) for episode, fault in looks if fault is not None]
    if dry_run or not damaged:
        return [Finding(fault) for _, fault in damaged]
    with episode_locks(path) as locks:
        return [finding for item, _ in damaged if (finding := _move(store, item, locks, verify)) is not None]


def _check_root(store: Store) -> None:
    """Raise `StoreError` if no episode is of the run that the root states: the root was changed, not the episodes."""
    runs = []
    for episode in store.episodes:
        try:
            runs.append(read_seal(episode.source).run)
        except (OSError, ValueError):
            continue
    if runs and store.run not in runs:
        raise StoreError(
            f"No episode of {store.path} is of the run that its zarr.json states: all {len(runs)} seals are of another "
            "configuration, so the zarr.json was changed, not the episodes. Nothing was moved; put the original "
            "zarr.json back, for instance from a copy of the store."
        )


def _move(store: Store, episode: StoredEpisode, locks: Locks, verify: bool) -> Finding | None:
    """Move one episode aside; None if it is no longer there, or no longer damaged."""
    try:
        holder = locks.acquire(episode.name)
        if not local_path(episode.folder).is_dir():
            return None
        # A new `StoredEpisode`: the old one keeps what it has read.
        damaged = look_at(store, replace(episode), verify)
        if damaged is None or holder is not None:
            return None if damaged is None else Finding(damaged, holder=holder)
        return Finding(damaged, moved_to=_move_aside(local_path(store.path), local_path(episode.folder), damaged))
    except OSError as error:
        raise StoreError(
            f"Cannot move {episode.name} of {store.path} into {damaged_folder(local_path(store.path))}: "
            f"{error.strerror or error}. Episodes before it were moved; remove the cause and run the command again."
        ) from None
    finally:
        locks.release(episode.name)


def _move_aside(store: Path, folder: Path, damaged: DamagedEpisode) -> Path:
    """Rename an episode's folder into a new entry of `NAME.zarr.damaged`, beside a file with the reason."""
    now = datetime.now(UTC)
    entry = _new_entry(damaged_folder(store), f"{damaged.name}-{now:%Y%m%dT%H%M%SZ}")
    reason = {
        "store": store.name,
        "episode": damaged.name,
        "moved_at": now.isoformat(timespec="seconds"),
        "problems": damaged.problems,
    }
    # The reason first: a process that is killed here leaves an entry without an episode, and the episode in the store.
    (entry / _REASON).write_text(json.dumps(reason, indent=1), encoding="utf-8")
    if os.path.lexists(folder):
        folder.rename(entry / folder.name)
    return entry


def _new_entry(damaged: Path, name: str) -> Path:
    """Create a folder that did not exist: the same episode may be moved aside twice within a second."""
    damaged.mkdir(exist_ok=True)
    number = 1
    while True:
        entry = damaged / (name if number == 1 else f"{name}-{number}")
        try:
            entry.mkdir()
        except FileExistsError:
            number += 1
            continue
        return entry


def repair_groups(path: Path, dry_run: bool = False) -> list[str]:
    """Write the `zarr.json` of the group of episodes again where it is lost or damaged: nothing is stated in it.

    Returns:
        A line on every file beside the episodes that is wrong, also on the root's, which nobody can write again.
    """
    lines = []
    for fault in store_faults(open_store(path, as_recorded=True)):
        if fault.where == EPISODES_DOCUMENT:
            if not dry_run:
                building = path / f".{uuid.uuid4().hex}"
                building.write_bytes(group_document({}))
                publish_file(building, path / EPISODES_DOCUMENT)
            lines.append(f"  {'would be written' if dry_run else 'written'} again: {fault.where}, {fault.problem}")
        else:
            lines.append(f"  left as it is: {fault.where}, {fault.problem}")
    return lines
