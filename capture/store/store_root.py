"""The root of a store: creating it in one step, reading it, and telling whether a run may go on in it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import zarr

from vla_attention.capture.store.durable_files import (
    flush_entry,
    flush_folder,
    make_partial,
    partial_folder,
    process_tag,
    remove_if_empty,
)
from vla_attention.schemas.jsonable import MalformedDocument, from_json, to_json
from vla_attention.schemas.stores.store_format import (
    EPISODES_GROUP,
    RootAttributes,
    RunMismatch,
    StoreError,
    check_format,
)


def check_same_run(path: Path, existing: RootAttributes, wanted: RootAttributes) -> None:
    """Raise `RunMismatch` naming the first field of the run's identity that differs. Provenance may differ; it is kept per episode."""
    # Where the weights lie says nothing about what they are: the digest does.
    moved = replace(wanted, policy=replace(wanted.policy, checkpoint=existing.policy.checkpoint))
    for section in ("format_version", "policy", "protocol", "recording", "sites"):
        difference = _first_difference(to_json(getattr(existing, section)), to_json(getattr(moved, section)), section)
        if difference:
            where, old, new = difference
            raise RunMismatch(
                f"Cannot resume {path}: its {where} is {old!r}, this run's is {new!r}; use the same settings, or another --store."
            )


def _first_difference(old: object, new: object, where: str) -> tuple[str, object, object] | None:
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            found = _first_difference(old.get(key), new.get(key), f"{where}.{key}")
            if found:
                return found
        return None
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new) and where.startswith("sites"):
        pairs = enumerate(zip(old, new, strict=True))
        return next((found for i, (a, b) in pairs if (found := _first_difference(a, b, f"{where}[{i}]"))), None)
    return None if old == new else (where, old, new)


def episode_folders(path: Path) -> list[Path]:
    """Folders of the complete episodes."""
    folder = path / EPISODES_GROUP
    if not folder.is_dir():
        raise StoreError(f"{path} cannot be used as a store: it has no group '{EPISODES_GROUP}'; give another --store.")
    return [entry for entry in folder.iterdir() if entry.is_dir()]


def read_root(path: Path) -> RootAttributes:
    """Attributes of the store at `path`; raises `StoreError` when there is something else."""
    if not path.exists():
        raise StoreError(f"The store {path} has been removed.")
    if not (path / "zarr.json").is_file():
        raise StoreError(f"{path} exists and is not a store; give another --store.")
    try:
        attributes = dict(zarr.open_group(path, mode="r", use_consolidated=False).attrs)
    except (OSError, ValueError, KeyError) as error:
        raise StoreError(f"{path} cannot be read as a store: {error}; give another --store.") from None
    check_format(attributes, path)
    try:
        return from_json(RootAttributes, attributes)
    except MalformedDocument as error:
        raise StoreError(f"{path} has attributes that cannot be read: {error}") from None


def create_root(path: Path, attributes: RootAttributes) -> RootAttributes:
    """Create an empty store in one step; returns what it says of itself, which another process may have written."""
    building = partial_folder(path) / f"root-{process_tag()}"
    try:
        make_partial(building)
        root = zarr.create_group(building, zarr_format=3)
        root.update_attributes(to_json(attributes))
        root.create_group(EPISODES_GROUP)
        flush_folder(building)
        building.rename(path)
        flush_entry(path.parent)
    except OSError:
        # Another process of the same array job was first, unless there is nothing.
        if not path.exists():
            raise
    finally:
        shutil.rmtree(building, ignore_errors=True)
        remove_if_empty(building.parent)
    return read_root(path)


def delete_store(path: Path) -> None:
    """Delete a store."""
    # Renamed first, so that a crash while deleting cannot leave half a store under the old name.
    doomed = partial_folder(path) / f"deleted-{process_tag()}"
    make_partial(doomed)
    path.rename(doomed)
    shutil.rmtree(doomed)
    remove_if_empty(doomed.parent)
