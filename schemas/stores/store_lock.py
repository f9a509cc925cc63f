"""The lock of a store that is written by `copy` or `repair`: who packs is alone."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path

from vla_attention.schemas.errors import BadArgument


def lock_for_writing(target: Path, *, packing: bool) -> int:
    """Open and lock the `zarr.json` of a copy that is written; closing it, or the end of the process, unlocks it.

    One process at a time packs into a store, because the index that is written last would lack the zips of the other,
    and nobody writes folders into it meanwhile. Several may write folders.

    Raises:
        BadArgument: another copy holds a lock that forbids this one.
    """
    # Locks of NFS need a file that may be written.
    handle = os.open(target / "zarr.json", os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        fcntl.flock(handle, (fcntl.LOCK_EX if packing else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES):
            os.close(handle)
            raise BadArgument(
                f"Cannot write into {target}: another copy is "
                f"{'writing' if packing else 'packing'} into it; run the same command again when that has ended, or "
                "give another name."
            ) from None
        # A file system without locks: there, nothing but the user keeps two copies apart.
    return handle
