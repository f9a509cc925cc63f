"""Folders for what is being written, beside the store: capture writes episodes there, and a copy its copies.

What is whole is renamed into the store, so that readers never see the rest, and what a killed process leaves is
removed by the next one that writes, or by `repair`.
"""

from __future__ import annotations

import os
import shutil
import socket
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vla_attention.schemas.stores.store_format import PARTIAL_SUFFIX


def partial_folder(store: Path) -> Path:
    """The folder for what is being written: beside the store, on the same file system, and not in it."""
    return store.with_name(store.name + PARTIAL_SUFFIX)


def process_tag() -> str:
    """A name that no other process uses: host, process number, and what tells containers of one host apart."""
    return f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}{_space_mark()}"


def process_space() -> str:
    """The namespace of process numbers, for instance `pid:[4026531836]`; containers of one host may have their own."""
    try:
        return os.readlink("/proc/self/ns/pid")
    except OSError:
        return ""


def _space_mark() -> str:
    number = "".join(filter(str.isdigit, process_space()))
    return f"n{int(number):x}" if number else ""


def dead_partials(store: Path) -> list[Path]:
    """What killed processes of this machine left beside the store. Those of other machines cannot be checked here."""
    return [folder for folder in _partials(store) if _process_of(folder) and not _is_running(_process_of(folder))]


def partials_of_others(store: Path) -> list[Path]:
    """What processes of other machines are writing beside the store, or have left there."""
    return [folder for folder in _partials(store) if not _process_of(folder)]


def remove_dead_partials(store: Path) -> None:
    """Remove what `dead_partials` lists."""
    for folder in dead_partials(store):
        shutil.rmtree(folder, ignore_errors=True)
    remove_if_empty(partial_folder(store))


def _partials(store: Path) -> list[Path]:
    return sorted(partial_folder(store).glob("*"))


def _process_of(folder: Path) -> int:
    """The process of this machine that wrote a folder, by `process_tag`; 0: of another one or a container."""
    begin, _, unique = folder.name.partition("-")[2].rpartition("-")
    host, _, process = begin.rpartition("-")
    mark = unique[unique.find("n") :] if "n" in unique else _space_mark()  # digits and a to f before it
    here = host == socket.gethostname() and mark == _space_mark()
    return int(process) if here and process.isdigit() and len(process) < 10 else 0


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
