"""Writing episodes in a thread, while the simulators and the policy go on.

Compression and the disk leave Python's lock, so one thread writes beside the policy. It takes replans and commits in
the order in which they were given. What waits is bounded: whoever gives more than `MOST_WAITING_BYTES` waits.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.engine.source import Committed, Outcome
from vla_attention.capture.store.episode_writer import EpisodeWriter
from vla_attention.capture.store.replan_records import EpisodeStart, ReplanRecord
from vla_attention.capture.store.store_writer import RunStore

#: Bytes of rows and pictures that may wait for the thread. One replan may always wait.
MOST_WAITING_BYTES = 256_000_000
#: Seconds between two looks whether the process shall stop, while replans cannot be taken.
_LOOK_EVERY_S = 0.5


@dataclass(eq=False)
class EpisodeInBackground:
    """One episode that the thread writes. `append`, `commit` and `drop` return before anything is written."""

    thread: WritingThread
    store: RunStore
    start: EpisodeStart
    denoise_times: NDArray[np.float64]
    committed: Committed | None = field(default=None, init=False)
    #: What ended the writing. What was given afterwards is skipped.
    error: BaseException | None = field(default=None, init=False)
    #: Of the thread alone: the episode's open writer, and what closes it.
    _writer: EpisodeWriter | None = field(default=None, init=False)
    _open: ExitStack = field(default_factory=ExitStack, init=False)
    _num_replans: int = field(default=0, init=False)
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
        self.thread.put(lambda: self._guarded(lambda: self._append(record)), sum(array.nbytes for array in arrays))

    def commit(self, outcome: Outcome) -> None:
        """Commit the episode after the replans given so far."""
        self.thread.put(lambda: self._guarded(lambda: self._commit(outcome)))

    def drop(self) -> None:
        """Forget the episode; nothing of it remains."""
        self._dropped = True  # the thread skips what waits
        self.thread.put(self.close)

    def close(self) -> None:
        """Close the writer; what was not committed is removed. For the thread, or after its end."""
        self._writer = None
        self._open.close()

    def _guarded(self, write: Callable[[], None]) -> None:
        if self._dropped or self.error is not None:
            return
        try:
            write()
        except BaseException as error:
            self.error = error
            self.close()

    def _append(self, record: ReplanRecord) -> None:
        if self._writer is None:
            self._writer = self._open.enter_context(self.store.episode(self.start, self.denoise_times))
        self._writer.append(record)
        self._num_replans += 1

    def _commit(self, outcome: Outcome) -> None:
        if self._writer is None:
            raise ValueError("an episode without replans cannot be committed")
        folder = self._writer.commit(outcome.success, outcome.num_steps, outcome.steps)
        self.close()
        self.committed = Committed(outcome, self._num_replans, folder)


class WritingThread:
    """The thread that writes. Leaving the context completes what is being written and drops everything that waits.

    done: called by the thread after each piece of work.
    check: called while `put` waits; an exception that it raises ends the waiting.
    """

    def __init__(
        self, done: Callable[[], None], check: Callable[[], None], most_waiting_bytes: int = MOST_WAITING_BYTES
    ) -> None:
        self._done = done
        self._check = check
        self._most_waiting_bytes = most_waiting_bytes
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="writing")
        self._waiting: deque[tuple[Future[None], int]] = deque()
        self._episodes: list[EpisodeInBackground] = []

    def __enter__(self) -> WritingThread:
        return self

    def __exit__(self, _t: type[BaseException] | None, _v: BaseException | None, _tb: TracebackType | None) -> None:
        self._executor.shutdown(wait=True, cancel_futures=True)
        for episode in self._episodes:
            episode.close()

    def episode(self, store: RunStore, start: EpisodeStart, denoise_times: NDArray[np.float64]) -> EpisodeInBackground:
        """Begin an episode; its folder is made with its first replan."""
        episode = EpisodeInBackground(self, store, start, denoise_times)
        self._episodes = [known for known in self._episodes if known.committed is None and known.error is None]
        self._episodes.append(episode)
        return episode

    def put(self, work: Callable[[], None], num_bytes: int = 0) -> None:
        """Give the thread some work; waits while too much waits already."""
        while self._waiting_bytes() and self._waiting_bytes() + num_bytes > self._most_waiting_bytes:
            wait([self._waiting[0][0]], _LOOK_EVERY_S)
            self._check()
        future = self._executor.submit(work)
        future.add_done_callback(lambda _: self._done())
        self._waiting.append((future, num_bytes))

    def _waiting_bytes(self) -> int:
        """Bytes of what waits, and of what is being written: it is in memory, too."""
        while self._waiting and self._waiting[0][0].done():
            self._waiting.popleft()
        return sum(num_bytes for _, num_bytes in self._waiting)
