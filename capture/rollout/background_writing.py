"""Writing episodes in a thread, while the simulators and the policy go on.

Compression and the disk leave Python's lock, so one thread writes beside the policy. It takes replans and commits in
the order in which they were given. What waits is bounded: whoever gives more than `MOST_WAITING_BYTES` waits.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.store.episode_writer import EpisodeWriter, ReplanRefused
from vla_attention.capture.store.replan_records import EpisodeStart, RecordedSteps, ReplanRecord
from vla_attention.capture.store.store_writer import RunStore
from vla_attention.schemas.stores.store_format import CorruptEpisode, StoreExists

#: Bytes of rows and pictures that may wait for the thread. One replan may always wait.
MOST_WAITING_BYTES = 256_000_000
#: Seconds between two looks whether the process shall stop, while replans cannot be taken.
_LOOK_EVERY_S = 0.5


@dataclass(frozen=True)
class Committed:
    """The outcome of a commit: the episode's folder and its bytes, or an error of this episode alone.

    `StoreExists`: another process was faster, or has taken the episode. `ReplanRefused`: numbers that cannot be right.
    `CorruptEpisode`: what was read back is not what was written. An error may come before a commit was asked for.
    """

    episode: EpisodeInBackground
    folder: Path | StoreExists | ReplanRefused | CorruptEpisode
    num_bytes: int


@dataclass(eq=False)
class EpisodeInBackground:
    """One episode that the thread writes. All methods return before anything is written."""

    writing: BackgroundWriting
    store: RunStore
    start: EpisodeStart
    denoise_times: NDArray[np.float64]
    max_replans: int
    #: Of the thread alone: the episode's open writer, and what closes it.
    _writer: EpisodeWriter | None = field(default=None, init=False)
    _open: ExitStack = field(default_factory=ExitStack, init=False)
    _dropped: bool = field(default=False, init=False)

    def append(self, record: ReplanRecord) -> None:
        """Add the next replan."""
        arrays: list[NDArray[Any]] = [
            *record.frames.values(),
            *record.camera_frames.values(),
            *record.coverage.values(),
        ]
        for rows in record.rows.values():
            arrays += [rows.rows, *([] if rows.contribution is None else [rows.contribution])]
        self.writing.put(lambda: self._append(record), sum(array.nbytes for array in arrays))

    def commit(self, success: bool, num_steps: int, steps: RecordedSteps | None) -> None:
        """Commit the episode after the replans given so far; `BackgroundWriting.take_commits` tells the outcome."""
        self.writing.put(lambda: self._commit(success, num_steps, steps), 0)

    def drop(self) -> None:
        """Forget the episode; nothing of it remains."""
        self._dropped = True  # the thread skips what waits
        self.writing.put(self.close, 0)

    def _append(self, record: ReplanRecord) -> None:
        if self._dropped:
            return
        try:
            if self._writer is None:
                self._writer = self._open.enter_context(
                    self.store.episode(self.start, self.denoise_times, self.max_replans)
                )
            self._writer.append(record)
        except (StoreExists, ReplanRefused) as error:
            self._end(error)

    def _commit(self, success: bool, num_steps: int, steps: RecordedSteps | None) -> None:
        if self._dropped:
            return
        if self._writer is None:
            raise ValueError("an episode without replans cannot be committed")
        try:
            folder = self._writer.commit(success, num_steps, steps)
        except (StoreExists, CorruptEpisode) as error:
            self._end(error)
        else:
            self.close()
            size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
            self.writing.done(Committed(self, folder, size))

    def _end(self, error: StoreExists | ReplanRefused | CorruptEpisode) -> None:
        """End the episode with an error; what waits of it is skipped."""
        self._dropped = True
        self.close()
        self.writing.done(Committed(self, error, 0))

    def close(self) -> None:
        """Close the writer; what was not committed is removed. For the thread."""
        self._writer = None
        self._open.close()


class BackgroundWriting:
    """The thread that writes. Leaving the context completes what is being written and drops everything that waits.

    notify: called by the thread after each commit and after a failure.
    check: called while `put` waits; an exception that it raises ends the waiting.
    """

    def __init__(
        self,
        notify: Callable[[], None],
        check: Callable[[], None],
        most_waiting_bytes: int = MOST_WAITING_BYTES,
    ) -> None:
        self._notify = notify
        self._check = check
        self._most_waiting_bytes = most_waiting_bytes
        self._changed = threading.Condition()
        self._waiting: deque[tuple[Callable[[], None], int]] = deque()
        self._waiting_bytes = 0
        self._commits: deque[Committed] = deque()
        self._failure: BaseException | None = None
        self._leaving = False
        self._episodes: set[EpisodeInBackground] = set()
        # A daemon: a process that is told twice to stop does not wait for it. What it leaves then is removed by the
        # next process that opens the store.
        self._thread = threading.Thread(target=self._write, name="writing", daemon=True)

    def __enter__(self) -> BackgroundWriting:
        self._thread.start()
        return self

    def __exit__(self, _t: type[BaseException] | None, _v: BaseException | None, _tb: TracebackType | None) -> None:
        with self._changed:
            self._leaving = True
            self._changed.notify_all()
        self._thread.join()

    def episode(
        self, store: RunStore, start: EpisodeStart, denoise_times: NDArray[np.float64], max_replans: int
    ) -> EpisodeInBackground:
        """Begin an episode; its folder is made with its first replan."""
        episode = EpisodeInBackground(self, store, start, denoise_times, max_replans)
        self._episodes.add(episode)
        return episode

    def put(self, job: Callable[[], None], num_bytes: int) -> None:
        """Give the thread a job; waits while too much waits already. Raises what an earlier job raised."""
        with self._changed:
            while self._waiting_bytes and self._waiting_bytes + num_bytes > self._most_waiting_bytes:
                self._raise_failure()
                self._changed.wait(_LOOK_EVERY_S)
                self._check()
            self._raise_failure()
            self._waiting.append((job, num_bytes))
            self._waiting_bytes += num_bytes
            self._changed.notify_all()

    def done(self, committed: Committed) -> None:
        """Note the outcome of a commit. For the thread."""
        self._episodes.discard(committed.episode)
        self._commits.append(committed)
        self._notify()

    def take_commits(self) -> list[Committed]:
        """Return the commits made since the last call. Raises what a job raised, after the commits before it."""
        if not self._commits:
            self._raise_failure()
        return self.commits_before_end()

    def commits_before_end(self) -> list[Committed]:
        """Return the commits made since the last call, also after a failure."""
        return [self._commits.popleft() for _ in range(len(self._commits))]

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _write(self) -> None:
        try:
            while (job := self._next_job()) is not None:
                job()
        except BaseException as error:
            self._failure = error
        finally:
            for episode in list(self._episodes):  # others may begin meanwhile
                episode.close()
        if self._failure is not None:
            with self._changed:
                self._changed.notify_all()
            self._notify()

    def _next_job(self) -> Callable[[], None] | None:
        with self._changed:
            while not self._leaving and not self._waiting:
                self._changed.wait()
            if self._leaving:
                return None
            job, num_bytes = self._waiting.popleft()
        return self._counted(job, num_bytes)

    def _counted(self, job: Callable[[], None], num_bytes: int) -> Callable[[], None]:
        def run() -> None:
            job()
            # Only now: the replan in work is in memory, too.
            with self._changed:
                self._waiting_bytes -= num_bytes
                self._changed.notify_all()

        return run
