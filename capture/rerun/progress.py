"""The progress of a rerun: a bar on a terminal, and otherwise lines for a log file."""

from __future__ import annotations

import sys
import time

from tqdm import tqdm

from vla_attention.capture.rollout.progress import say
from vla_attention.schemas.safe_text import plain_stderr

#: Seconds between two lines in a log file.
_LOG_EVERY_S = 30.0


class RerunProgress:
    """The progress through episodes and policy calls. `close` it at the end.

    num_episodes, num_calls: of the whole rerun.
    """

    def __init__(self, num_episodes: int, num_calls: int) -> None:
        self._num_episodes = num_episodes
        self._num_begun = 0
        self._episode = ""
        self._calls_before = 0
        self._last_line_at = time.monotonic()
        self._bar = tqdm(total=num_calls, unit="call", file=plain_stderr(), disable=not sys.stderr.isatty())

    def begin(self, episode: str) -> None:
        """Begin an episode."""
        self._num_begun += 1
        self._episode = episode
        self._bar.set_description(episode)

    def update(self, replan: int, num_replans: int) -> None:
        """Show how many policy calls of the current episode are done."""
        self._bar.update(self._calls_before + replan - self._bar.n)
        now = time.monotonic()
        if self._bar.disable and now - self._last_line_at >= _LOG_EVERY_S:
            self._last_line_at = now
            say(f"[{self._num_begun}/{self._num_episodes}] {self._episode}: {replan} of {num_replans} policy calls")

    def end(self, num_replans: int) -> None:
        """Show that the current episode is committed."""
        self._calls_before += num_replans

    def say(self, line: str) -> None:
        """Print one line, above the bar if there is one."""
        say(line) if self._bar.disable else self._bar.write(line)

    def close(self) -> None:
        """Remove the bar."""
        self._bar.close()
