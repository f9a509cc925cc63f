"""`vla-capture repair`: moves damaged episodes out of a store, so that a capture with --resume records them again.

They go into `NAME.zarr.quarantine/`, beside the store as all folders that readers must not see. Nothing is deleted.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from vla_attention.capture.jobs.claims import Claims, Holder, jobs_folder
from vla_attention.capture.jobs.damaged_episodes import DamagedEpisode, look_at
from vla_attention.capture.jobs.worker import this_worker
from vla_attention.schemas.stores.partial_folders import remove_if_empty
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store
from vla_attention.schemas.stores.seal import read_seal
from vla_attention.schemas.stores.store_format import StoreError
from vla_attention.schemas.stores.store_url import local_path

#: Ending of the folder beside the store with the episodes that were moved aside. It may be deleted at any time.
QUARANTINE_SUFFIX = ".quarantine"
_REASON = "reason.json"


@dataclass(frozen=True)
class Finding:
    """A damaged episode, and what was done about it.

    moved_to: its folder in the quarantine; None if it is still in the store.
    holder: the process that has claimed the episode, which is then left alone.
    """

    damaged: DamagedEpisode
    moved_to: Path | None = None
    holder: Holder | None = None


def quarantine_folder(store: Path) -> Path:
    """Return the folder of episodes that were moved aside."""
    return store.with_name(store.name + QUARANTINE_SUFFIX)


def repair_store(path: Path, verify: bool = False, dry_run: bool = False) -> list[Finding]:
    """Move every damaged episode of a store aside; other processes may read and fill the store meanwhile.

    An episode is claimed before it is moved, and looked at again: a process that has recorded it anew in the meantime
    does not lose it. An episode that another process has claimed stays.

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
    store = open_store(path)
    _check_root(store)
    looks = [(episode, look_at(store, episode, verify)) for episode in store.episodes]
    damaged = [(episode, found) for episode, found in looks if found is not None]
    if dry_run or not damaged:
        return [Finding(found) for _, found in damaged]
    try:
        with Claims(path, this_worker()) as claims:
            return [finding for item, _ in damaged if (finding := _move(store, item, claims, verify)) is not None]
    finally:
        remove_if_empty(jobs_folder(path))


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


def _move(store: Store, episode: StoredEpisode, claims: Claims, verify: bool) -> Finding | None:
    """Move one episode aside; None if it is no longer there, or no longer damaged."""
    try:
        holder = claims.acquire(episode.name)
        if not local_path(episode.folder).is_dir():
            return None
        # A new `StoredEpisode`: the old one keeps what it has read.
        damaged = look_at(store, StoredEpisode(episode.folder, episode.name, store.run), verify)
        if damaged is None or holder is not None:
            return None if damaged is None else Finding(damaged, holder=holder)
        return Finding(damaged, moved_to=_quarantine(local_path(store.path), local_path(episode.folder), damaged))
    except OSError as error:
        raise StoreError(
            f"Cannot move {episode.name} of {store.path} into {quarantine_folder(local_path(store.path))}: "
            f"{error.strerror or error}. Episodes before it were moved; remove the cause and run the command again."
        ) from None
    finally:
        claims.release(episode.name)


def _quarantine(store: Path, folder: Path, damaged: DamagedEpisode) -> Path:
    """Rename an episode's folder into a new entry of the quarantine, beside a file with the reason."""
    now = datetime.now(UTC)
    entry = _new_entry(quarantine_folder(store), f"{damaged.name}-{now:%Y%m%dT%H%M%SZ}")
    reason = {
        "store": store.name,
        "episode": damaged.name,
        "moved_at": now.isoformat(timespec="seconds"),
        "problems": damaged.problems,
    }
    # The reason first: a process that is killed here leaves an entry without an episode, and the episode in the store.
    (entry / _REASON).write_text(json.dumps(reason, indent=1), encoding="utf-8")
    folder.rename(entry / folder.name)
    return entry


def _new_entry(quarantine: Path, name: str) -> Path:
    """Create a folder that did not exist: the same episode may be moved aside twice within a second."""
    quarantine.mkdir(exist_ok=True)
    number = 1
    while True:
        entry = quarantine / (name if number == 1 else f"{name}-{number}")
        try:
            entry.mkdir()
        except FileExistsError:
            number += 1
            continue
        return entry


def print_repair(stores: Sequence[Path], verify: bool, dry_run: bool) -> int:
    """Repair stores, and print what was found and done.

    Returns:
        The exit code: 1 if a damaged episode is left in a store, else 0.
    """
    left = 0
    for path in stores:
        findings = repair_store(path, verify, dry_run)
        total = len(open_store(path).episodes) + sum(finding.moved_to is not None for finding in findings)
        print("\n".join(_lines(path, findings, total, verify, dry_run)), flush=True)
        left += sum(finding.moved_to is None for finding in findings)
    return 1 if left else 0


def _lines(path: Path, findings: Sequence[Finding], total: int, verify: bool, dry_run: bool) -> list[str]:
    if not findings:
        looked = "every byte was read" if verify else "seals, presence and sizes; --verify reads every byte"
        return [f"{path}: none of {total} episodes is damaged ({looked})."]
    lines = [f"{path}: {len(findings)} of {total} episodes {'is' if len(findings) == 1 else 'are'} damaged."]
    for finding in findings:
        lines.append(f"  {finding.damaged.describe()}")
        if finding.moved_to is not None:
            lines.append(f"    moved to {finding.moved_to}")
        elif finding.holder is not None:
            lines.append(f"    left in the store, because it is claimed: {finding.holder.describe()}")
    if dry_run:
        lines.append("Nothing was moved (--dry-run).")
    elif any(finding.moved_to is not None for finding in findings):
        lines.append("Run the same capture with --resume to record what was moved aside again.")
    return lines
