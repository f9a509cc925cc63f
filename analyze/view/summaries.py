"""What Python's analysis says of each episode of a store, computed in a process of its own while pages are served.

The numbers are those of `analyze STORE`: the default grouping, all layers and heads, and what the cache of masses
has is not measured again.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, StoredEpisode

_MODULE = "vla_attention.analyze.view.summary_process"
#: What is said of the whole run.
_OF_RUN = ("ratio", "findings", "leaves", "effects", "effect", "failed")
#: How a line of the process begins that is for the reader.
OURS = "summary "


class Summary:
    """The summary of one store, as far as it is computed; `close` ends the process that computes it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._episodes: dict[str, StoredEpisode] = {}
        self._rows: dict[str, dict[str, Any]] = {}
        self._about: dict[str, Any] = dict.fromkeys(_OF_RUN)
        self._complete = False
        #: Questions that are being answered.
        self._waiting = 0
        self._process: subprocess.Popen[str] | None = None
        self._reader: threading.Thread | None = None

    def begin(self, store: Store) -> None:
        """Compute the summary of a store's episodes in the background; of another state of it, if one is under way.

        Meanwhile the numbers of before stay: of episodes that are the same objects, and of the run while all are there.
        """
        self.close()
        with self._lock:
            before, self._episodes = self._episodes, {one.name: one for one in store.episodes}
            kept = {name for name, one in self._episodes.items() if before.get(name) is one}
            empty = {name: {"name": name, "ratio": None, "lift": None} for name in self._episodes}
            self._rows = {name: self._rows[name] if name in kept else row for name, row in empty.items()}
            self._complete = False
            self._about["failed"] = None
            if kept != before.keys():
                self._about = dict.fromkeys(_OF_RUN)
        # The module is found as this process found it.
        variables = {**os.environ, "PYTHONPATH": os.pathsep.join(path or os.curdir for path in sys.path)}
        command = [sys.executable, "-m", _MODULE, str(store.path)]
        try:
            self._process = subprocess.Popen(
                command,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                stdin=subprocess.DEVNULL,
                encoding="utf-8",
                env=variables,
                # Ctrl-C is for the server, which then ends this process. Of the same session: if the server is killed
                # while this one stands still, the system ends it, too.
                process_group=0,
            )
        except OSError as error:
            self._fail(f"Python could not be started a second time: {error.strerror or error}.")
            return
        self._reader = threading.Thread(target=self._read, args=(self._process,), daemon=True)
        self._reader.start()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Let the process stand still as long as somebody waits for an answer; not on Windows."""
        with self._lock:
            self._waiting += 1
            self._send("SIGSTOP", when=self._waiting == 1)
        try:
            yield
        finally:
            with self._lock:
                self._waiting -= 1
                self._send("SIGCONT", when=self._waiting == 0)

    def _send(self, name: str, when: bool) -> None:
        process = self._process
        if when and process is not None and hasattr(signal, name):
            process.send_signal(getattr(signal, name))

    def document(self) -> dict[str, Any]:
        """`NUMBER.summary.json`: the episodes in the store's order; numbers that are not there yet are null."""
        with self._lock:
            return {"complete": self._complete, **self._about, "episodes": list(self._rows.values())}

    def wait(self) -> str | None:
        """Wait until everything is computed; returns why an episode has no numbers, None where all of them have."""
        if self._reader is not None:
            self._reader.join()
        failed: str | None = self.document()["failed"]
        return failed

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout as lines:
            for line in lines:
                # Other lines are of what Python loads there by itself, which may print too.
                if line.startswith(OURS):
                    self._take(json.loads(line.removeprefix(OURS)))
        code = process.wait()
        if process is self._process and code:
            self._fail("The numbers of the episodes could not be computed; vla-attention analyze STORE says why.")
        with self._lock:
            self._complete = self._complete or process is self._process

    def _take(self, part: Mapping[str, Any]) -> None:
        with self._lock:
            for row in part.get("episodes", ()):
                if row["name"] in self._rows:
                    self._rows[row["name"]] = row
            self._about |= {name: part[name] for name in self._about if name in part}

    def _fail(self, sentence: str) -> None:
        with self._lock:
            self._about["failed"] = self._about["failed"] or visible(sentence)
            self._complete = True

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            with suppress(OSError):
                process.kill()
            process.wait()
        if self._reader is not None:
            self._reader.join()
            self._reader = None
