"""The progress through episodes: a bar on a terminal, and otherwise lines for a log file."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import Literal

from tqdm import tqdm

from vla_attention.schemas.safe_text import plain_stderr, print_line, visible

#: What is counted of an episode: environment steps, or policy calls where no environment runs.
Unit = Literal["step", "call"]

#: Seconds between two lines about episodes in progress in a log file. A GPU completes several replans a second.
_LOG_EVERY_S = 30.0
#: Episodes in progress that one line names.
_MOST_SHOWN = 4


def say(line: str) -> None:
    """Print one line immediately, also into a file that somebody follows; see `safe_text.print_line`."""
    print_line(line)


@dataclass(eq=False)
class EpisodeProgress:
    """The progress of one episode. size: most units of it. done: units so far."""

    progress: Progress
    position: str
    name: str
    size: int
    begun_at: float
    done: int = 0
    replans: int = 0

    def update(self, done: int, replans: int) -> None:
        """Show how many units and replans of the episode are done."""
        self.done, self.replans = done, replans
        self.progress.show()

    def end(self, result: str, instruction: str) -> None:
        """Show how the episode ended."""
        self.progress.end(self, f"{result}, {time.monotonic() - self.begun_at:.0f} s ({instruction})")

    def drop(self) -> None:
        """Show the episode no more: another process was faster, or this one stops."""
        self.progress.drop(self)

    def put_back(self) -> None:
        """Show the episode no more: it will begin again."""
        self.progress.put_back(self)

    def describe(self, unit: Unit, now: float) -> str:
        """Return what is done as text for a log file."""
        done = f"step {self.done} of at most {self.size}, {self.replans} replans"
        if unit == "call":
            done = f"{self.done} of {self.size} policy calls"
        return f"{self.position} {self.name}: {done}, {now - self.begun_at:.0f} s"


class Progress:
    """The progress of one process through its episodes, of which several may run at a time. `close` it at the end.

    num_episodes: number of episodes that the process was started for. size: most units of all of them.
    """

    def __init__(self, num_episodes: int, size: int, unit: Unit) -> None:
        self._num_episodes = num_episodes
        self._unit = unit
        self._num_begun = 0
        self._done = 0
        self._running: list[EpisodeProgress] = []
        self._last_line_at = time.monotonic()
        hidden = not sys.stderr.isatty()
        self._bar = tqdm(total=size, unit=unit, file=plain_stderr(), disable=hidden)

    def begin(self, name: str, size: int) -> EpisodeProgress:
        """Begin an episode of at most so many units."""
        self._num_begun += 1
        now = time.monotonic()
        if not self._running:
            self._last_line_at = now
        begun = EpisodeProgress(self, self._position(), name, size, now)
        self._running.append(begun)
        self._describe_bar()
        return begun

    def show(self) -> None:
        """Show what is done by now."""
        self._update_bar()
        now = time.monotonic()
        if self._bar.disable and now - self._last_line_at >= _LOG_EVERY_S:
            self._last_line_at = now
            shown = [episode.describe(self._unit, now) for episode in self._running[:_MOST_SHOWN]]
            more = len(self._running) - len(shown)
            say("; ".join(shown) + (f"; {more} more episodes" if more else ""))

    def end(self, episode: EpisodeProgress, result: str) -> None:
        """Show how an episode ended."""
        self.drop(episode)
        self.say(f"{episode.position} {episode.name}: {result}")

    def drop(self, episode: EpisodeProgress) -> None:
        """Count an episode as done, and show it no more."""
        self._running.remove(episode)
        self._done += episode.size
        self._update_bar()
        self._describe_bar()

    def put_back(self, episode: EpisodeProgress) -> None:
        """Show an episode no more, and count it as not begun."""
        self._running.remove(episode)
        self._num_begun -= 1
        self._update_bar()
        self._describe_bar()

    def skip(self, name: str) -> None:
        """Show that another process has committed an episode."""
        self._num_begun += 1
        self.say(f"{self._position()} {name}: committed by another process.")

    def say(self, line: str) -> None:
        """Print one line, above the bar if there is one."""
        say(line) if self._bar.disable else self._bar.write(visible(line))

    def close(self) -> None:
        """Remove the bar."""
        self._bar.close()

    def _position(self) -> str:
        return f"[{self._num_begun}/{self._num_episodes}]"

    def _update_bar(self) -> None:
        done = self._done + sum(episode.done for episode in self._running)
        self._bar.update(done - self._bar.n)  # an episode that begins again takes its units back

    def _describe_bar(self) -> None:
        names = [episode.name for episode in self._running]
        more = f" and {len(names) - _MOST_SHOWN} more" if len(names) > _MOST_SHOWN else ""
        self._bar.set_description(", ".join(names[:_MOST_SHOWN]) + more)
