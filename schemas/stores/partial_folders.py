"""Folders for what is being written, beside the store: capture writes episodes there, and a copy its copies.

What is whole is renamed into the store, so that readers never see the rest, and what a killed process leaves is
removed by the next one that writes, or by `repair`.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import socket
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vla_attention.schemas.stores.store_format import PARTIAL_SUFFIX, StoreError


def partial_folder(store: Path) -> Path:
    """The folder for what is being written: beside the store, on the same file system, and not in it.

    Raises:
        StoreError: it is a link.
    """
    return no_link(store.with_name(store.name + PARTIAL_SUFFIX))


def no_link(folder: Path) -> Path:
    """A folder in which this program makes, moves and removes things; a link may lead to those of others.

    Raises:
        StoreError: it is a link, which this program never makes.
    """
    if folder.is_symlink():
        raise StoreError(
            f"{folder} is a link, and nothing is written, moved or removed where it leads to: expected a folder, or "
            "nothing. Remove the link and run the command again."
        )
    return folder


def process_tag() -> str:
    """A name that no other process uses: host, process number, random digits, and a mark of `process_space`."""
    return f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}{_space_mark(process_space())}"


def process_space() -> str:
    """Where the numbers of this machine's processes hold; empty where the system does not say it.

    It is the number of the boot, drawn at random when the machine started, and the namespace of process numbers, of
    which a container may have its own: `4f0d2f0e-... pid:[4026531836]`. The name of a host does not tell two nodes
    apart: nodes that start from one image may share it, and all machines have the same first namespace.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _space_mark(space: str) -> str:
    return f"n{hashlib.sha256(space.encode()).hexdigest()[:16]}" if space else ""


def dead_partials(store: Path) -> list[Path]:
    """What killed processes of this machine left beside the store. Those of other machines cannot be checked here.

    Processes before the last start of this machine count as those of another one.
    """
    return [folder for folder in _partials(store) if _process_of(folder) and not _is_running(_process_of(folder))]


def partials_in_use(store: Path) -> list[Path]:
    """What processes that may still run are writing beside the store, here or on other machines."""
    dead = set(dead_partials(store))
    return [folder for folder in _partials(store) if folder not in dead]


def partials_of_others(store: Path) -> list[Path]:
    """What processes of other machines are writing beside the store, or have left there."""
    return [folder for folder in _partials(store) if not _process_of(folder)]


def remove_dead_partials(store: Path) -> None:
    """Remove what `dead_partials` lists."""
    for folder in dead_partials(store):
        shutil.rmtree(folder, ignore_errors=True)
    remove_if_empty(partial_folder(store))


def remove_partials_of(store: Path, purpose: str, host: str, process: int, space: str) -> None:
    """Remove what a process that has ended was writing for a purpose, an episode's name for instance.

    What describes the process may come from a file of somebody else. It is compared with the names of the folders that
    are there, and is part of no path. What a running process of this machine writes stays.

    Args:
        store: beside which it was written.
        purpose: as of `partial_of`.
        host, process, space: of the process, see `Worker`.
    """
    wanted = purpose, host, str(process), _space_mark(space)
    for folder in _partials(store):
        number = _process_of(folder)
        if _parts_of(folder.name) == wanted and not (number and _is_running(number)):
            shutil.rmtree(folder, ignore_errors=True)
    remove_if_empty(partial_folder(store))


def _partials(store: Path) -> list[Path]:
    try:
        return sorted(partial_folder(store).iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []


def _parts_of(name: str) -> tuple[str, str, str, str]:
    """Purpose, host, process and mark of the process space in a folder's name, see `process_tag`."""
    purpose, _, rest = name.partition("-")
    begin, _, unique = rest.rpartition("-")
    host, _, process = begin.rpartition("-")
    return purpose, host, process, unique[unique.find("n") :] if "n" in unique else ""  # digits and a to f before it


def _process_of(folder: Path) -> int:
    """The process of this machine that wrote a folder, by `process_tag`; 0: of another one or a container."""
    _, host, process, mark = _parts_of(folder.name)
    here = mark != "" and (host, mark) == (socket.gethostname(), _space_mark(process_space()))
    return int(process) if here and process.isdecimal() and process.isascii() and len(process) < 10 else 0


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)  # signal 0 only checks that the process exists
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def make_partial(folder: Path) -> None:
    """Create a folder for what is being written; another process may be removing the (empty) parent at this moment."""
    while True:
        folder.parent.mkdir(exist_ok=True)
        try:
            folder.mkdir()
        except FileNotFoundError:
            continue
        return


@contextmanager
def partial_of(store: Path, purpose: str) -> Iterator[Path]:
    """A new folder beside the store for what is being written; after the block what was not renamed is removed."""
    folder = partial_folder(store) / f"{purpose}-{process_tag()}"
    try:
        make_partial(folder)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        remove_if_empty(folder.parent)


def remove_if_empty(folder: Path) -> None:
    """Remove a folder if it is empty."""
    try:
        folder.rmdir()
    except OSError:
        return  # another writer's episode is in it, or another process has removed it
