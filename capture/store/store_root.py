"""The root of a store for a run: create it in one step, delete it, and check that it belongs to the same run."""

from __future__ import annotations

import time
from pathlib import Path

import zarr

from vla_attention.capture.store.unpublished import UnpublishedFolder
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.stores.digest import run_differences, with_digest
from vla_attention.schemas.stores.durable_files import publish
from vla_attention.schemas.stores.locks import WHOLE_STORE, Held, store_locks
from vla_attention.schemas.stores.root import read_root
from vla_attention.schemas.stores.store_format import (
    EPISODES_GROUP,
    FormatTooNew,
    RootAttributes,
    RunMismatch,
    StoreError,
)

#: Seconds between two looks whether another process has created the store.
_LOOK_EVERY_S = 0.05


def check_same_run(path: Path, existing: RootAttributes, wanted: RootAttributes) -> None:
    """Raise `RunMismatch` for the first field of the run's configuration that differs."""
    for where, old, new in run_differences(existing, wanted):
        raise RunMismatch(
            f"Cannot resume {path}: its {where} is {old!r}, this run's is {new!r}; "
            "use the same settings, or another --output."
        )


def read_existing_root(path: Path) -> RootAttributes:
    """Attributes of the store that a run is to write to; raises `StoreError` when something else is at `path`."""
    try:
        return read_root(path)
    except FormatTooNew:
        raise
    except StoreError as error:
        raise StoreError(f"{error} Give another --output.") from None


def create_root(path: Path, attributes: RootAttributes, durable: bool) -> RootAttributes:
    """Create an empty store in one step; returns the attributes of the store that is then at `path`.

    Another process may have created it first. `durable`: flush it to disk, see `RunStore`.
    """
    locks = store_locks(path)
    while not path.exists():
        try:
            with locks.part(WHOLE_STORE) as building:
                if not path.exists():
                    root = zarr.create_group(UnpublishedFolder(building), zarr_format=3)
                    root.update_attributes(with_digest(to_json(attributes)))
                    root.create_group(EPISODES_GROUP)
                    publish(building, path, durable)
        except Held:  # by another process of the same array job
            time.sleep(_LOOK_EVERY_S)
        except OSError:
            if not path.exists():  # else another process made it, which took this one for dead
                raise
    return read_existing_root(path)


def delete_store(path: Path) -> None:
    """Delete a store."""
    # Rename it first, so that a crash while deleting cannot leave half a store under the old name.
    with store_locks(path).part(WHOLE_STORE) as folder:
        path.rename(folder)
