"""The progress of a capture: a bar on a terminal, and otherwise lines for a log file."""

from __future__ import annotations

import sys
import time

from tqdm import tqdm

from vla_attention.schemas.safe_text import plain_stderr

#: Seconds between two lines about one episode in a log file. A GPU completes several replans a second.
_LOG_EVERY_S = 30.0


def say(line: str) -> None:
    """Print one line immediately, also into a file that somebody follows."""
    print(line, flush=True)


class Progress:
    """The progress of one process through its episodes. `close` it at the end.

    num_episodes: number of episodes that the process was started for.
    max_steps: largest number of policy steps of one episode.
    """

    def __init__(self, num_episodes: int, max_steps: int) -> None:
        self._num_episodes = num_episodes
        self._max_steps = max_steps
        self._num_begun = 0
        self._episode = ""
        self._begun_at = self._last_line_at = time.monotonic()
        self._steps_before = 0
        hidden = not sys.stderr.isatty()
        self._bar = tqdm(total=num_episodes * max_steps, unit="step", file=plain_stderr(), disable=hidden)

    def begin(self, task_id: int, episode: int) -> None:
        """Begin an episode."""
        self._num_begun += 1
        self._episode = f"task {task_id} episode {episode}"
        self._bar.set_description(self._episode)
        self._begun_at = self._last_line_at = time.monotonic()
        self._steps_before = self._bar.n

    def update(self, step: int, replans: int) -> None:
        """Show how many environment steps and replans of the current episode are done."""
        self._bar.update(self._steps_before + step - self._bar.n)
        now = time.monotonic()
        if self._bar.disable and now - self._last_line_at >= _LOG_EVERY_S:
            self._last_line_at = now
            say(
                f"{self._position()} {self._episode}: step {step} of at most {self._max_steps}, {replans} replans, "
                f"{now - self._begun_at:.0f} s"
            )

    def end(self, result: str, instruction: str) -> None:
        """Show how the current episode ended."""
        self._bar.update(self._steps_before + self._max_steps - self._bar.n)
        seconds = time.monotonic() - self._begun_at
        self.say(f"{self._position()} {self._episode}: {result}, {seconds:.0f} s ({instruction})")

    def skip(self, name: str) -> None:
        """Show that another process has committed an episode."""
        self._num_begun += 1
        self.say(f"{self._position()} {name}: committed by another process.")

    def say(self, line: str) -> None:
        """Print one line, above the bar if there is one."""
        say(line) if self._bar.disable else self._bar.write(line)

    def close(self) -> None:
        """Remove the bar."""
        self._bar.close()

    def _position(self) -> str:
        return f"[{self._num_begun}/{self._num_episodes}]"
