"""A store opened for adding episodes.

An episode is written into a folder in `.writing`, read back, flushed to disk and then renamed into place. A process
that is killed at any moment leaves the episodes of the store as they were.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.jobs.worker_log import log_folder
from vla_attention.capture.store.episode_writer import EpisodeWriter, naming_the_failure
from vla_attention.capture.store.replan_records import EpisodeStart
from vla_attention.capture.store.store_root import check_same_run, create_root, delete_store, read_existing_root
from vla_attention.schemas.errors import BadArgument, UserError, plural
from vla_attention.schemas.stores.digest import run_differences
from vla_attention.schemas.stores.locks import episode_locks, store_locks
from vla_attention.schemas.stores.root import NAMES_FILE, episode_folders
from vla_attention.schemas.stores.store_format import (
    EPISODES_GROUP,
    RootAttributes,
    StoreExists,
    episode_name,
    parse_episode_name,
)
from vla_attention.schemas.stores.store_place import check_place, check_writable, why_refused

WriteMode = Literal["new", "resume", "overwrite"]


class RunStore:
    """A store opened for adding episodes. Any number of processes may open one; each episode has one writer.

    `durable`: an episode is flushed to disk before it appears in the store, so that it survives a crash of the machine.
    Tests, which write many small stores and delete them, do without.
    """

    def __init__(self, path: Path, attributes: RootAttributes, durable: bool = True) -> None:
        self.path = path
        self.attributes = attributes
        self.durable = durable
        self.locks = episode_locks(path)

    def committed(self) -> set[tuple[int, int]]:
        """(task id, episode index) of every complete episode."""
        return {parse_episode_name(folder.name) for folder in episode_folders(self.path)}

    def has(self, task_id: int, episode_index: int) -> bool:
        """Whether an episode is complete; looks into the store, because other processes may have added it."""
        return (self.path / EPISODES_GROUP / episode_name(task_id, episode_index)).is_dir()

    @contextmanager
    def episode(self, start: EpisodeStart, denoise_times: NDArray[np.float64]) -> Iterator[EpisodeWriter]:
        """Write one episode, which is locked meanwhile; leaving the block without `commit` drops it.

        Raises:
            Held: another process is writing it.
        """
        name = episode_name(start.task_id, start.episode_index)
        with ExitStack() as stack:
            with naming_the_failure(f"episode {name} of {self.path}", self.path):
                folder = stack.enter_context(self.locks.part(name))
                writer = EpisodeWriter(
                    self.path, self.attributes, folder, start, denoise_times, self.locks, self.durable
                )
            with closing(writer):
                yield writer


def open_run(path: Path, attributes: RootAttributes, mode: WriteMode, *, durable: bool = True) -> RunStore:
    """Create a store, continue one, or replace one. `durable`: see `RunStore`.

    Raises:
        StoreExists: a store with episodes is at `path`, or one that another run is writing, and the mode is `new`.
        RunMismatch: the mode is `resume` and the existing run differs; the first differing field is named.
    """
    path = make_way(path, mode)
    with _saying_where(path):
        if mode == "new" and path.exists():
            _take_empty(path, attributes)
        existing = read_existing_root(path) if path.exists() else create_root(path, attributes, durable)
        check_same_run(path, existing, attributes)
        (path / NAMES_FILE).unlink(missing_ok=True)  # of a copy: it would lack what is recorded now
        store = RunStore(path, existing, durable)
        for locks in (store.locks, store_locks(path)):
            locks.sweep()
    return store


def make_way(path: Path, mode: WriteMode) -> Path:
    """Look at the place of a store before it is opened, and delete the one that is to be replaced; returns the place.

    Raises:
        StoreExists: a store with episodes is at `path`, and the mode is `new`.
    """
    check_place(path, "write a store at")
    # A store is made, and deleted, beside itself; a link to it may be on another file system.
    path = path.resolve() if path.is_symlink() else path
    with _saying_where(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if mode == "new":
            refuse_recorded(path)
        if path.exists() and mode == "overwrite":
            read_existing_root(path)
            delete_store(path)
        if mode == "overwrite":  # logs are of the deleted store
            shutil.rmtree(log_folder(path), ignore_errors=True)
    return path


@contextmanager
def _saying_where(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if isinstance(error, UserError):
            raise
        raise BadArgument(
            f"Cannot write a store at {path}: {why_refused(error, path)}; give another --output."
        ) from None


def check_target(path: Path, mode: WriteMode) -> None:
    """Raise an error where a store cannot be written: before the minutes for loading a model, and before anything is.

    Raises:
        StoreExists: a store with episodes is at `path`, and the mode is `new`.
        BadArgument: nothing can be written there.
    """
    if mode == "new":
        refuse_recorded(path)
    check_writable(path.parent, "--output")


#: As a command's option and as an argument of `va.record`.
_OVERWRITE = "--overwrite (overwrite=True)"


def refuse_recorded(path: Path) -> None:
    """Raise `StoreExists` if a store with episodes is at `path`, and `StoreError` if it is no store.

    One without an episode is left by a run that ended before its first one, and a new run may begin there.
    """
    if not path.exists():
        return
    read_existing_root(path)
    if count := len(episode_folders(path)):
        raise StoreExists(
            f"Store {path} exists already and holds {plural(count, 'episode')}; continue it with "
            f"--resume (in Python resume=True), delete it and begin again with {_OVERWRITE}, or write to another store."
        )


def _take_empty(path: Path, attributes: RootAttributes) -> None:
    """Delete the store without an episode at `path`, if it is of another run; that of this run is continued."""
    existing = read_existing_root(path)
    if next(iter(run_differences(existing, attributes)), None) is None:
        return
    if _is_being_recorded(path):
        raise StoreExists(
            f"Store {path} holds no episode yet, and another run is recording its first one; wait for it, delete the "
            f"store and begin again with {_OVERWRITE}, or write to another store."
        )
    delete_store(path)


def remove_without_episodes(path: Path) -> None:
    """Delete a store that this process made and that has no episode, unless another process is recording one."""
    if not episode_folders(path) and not _is_being_recorded(path):
        delete_store(path)
        shutil.rmtree(log_folder(path), ignore_errors=True)


def _is_being_recorded(path: Path) -> bool:
    return any(not holder.is_dead for holder in episode_locks(path).holders())
