"""Folders as one file: an episode of a copy that is to be carried in few files, and the example stores."""

from __future__ import annotations

import tarfile
from collections.abc import Collection
from pathlib import Path

from vla_attention.schemas.foreign_files import open_regular


def write_tar(folder: Path, path: Path) -> None:
    """Write a folder into a tar file, under its own name; compressed where the file's name ends with `.xz`.

    The same content gives the same bytes.
    """
    with tarfile.open(path, "w:xz") if path.suffix == ".xz" else tarfile.open(path, "w") as tar:
        for file in (folder, *sorted(folder.rglob("*"))):
            entry = tar.gettarinfo(file, arcname=file.relative_to(folder.parent).as_posix())
            entry.mtime = entry.uid = entry.gid = 0
            entry.uname = entry.gname = ""
            entry.mode = 0o755 if file.is_dir() else 0o644
            if file.is_dir():
                tar.addfile(entry)
            else:
                with file.open("rb") as content:
                    tar.addfile(entry, content)


def unpack(path: Path, into: Path, only: Collection[str] = ()) -> None:
    """Unpack a tar file into a folder; nothing is written outside of it, and no more than the file's own bytes.

    Only one whose name ends with `.xz` may be compressed.

    only: names of files in the tar; all without.

    Raises:
        tarfile.TarError: it is no tar file, is damaged, or would write elsewhere.
        KeyError: it lacks one of the files.
    """
    is_compressed = path.suffix == ".xz"
    try:
        handle = open_regular(path)
    except OSError as error:
        raise tarfile.ReadError(error.strerror or str(error)) from None
    with open(handle, "rb") as file, tarfile.open(fileobj=file, mode="r:xz" if is_compressed else "r:") as tar:
        if not is_compressed and sum(member.size for member in tar) > path.stat().st_size:
            raise tarfile.ReadError("its files are larger than itself")
        tar.extractall(into, members=[tar.getmember(name) for name in only] or None, filter="data")
