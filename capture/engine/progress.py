"""The progress through episodes: a bar on a terminal, and otherwise lines for a log file."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from tqdm import tqdm

from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import plural
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


def duration(seconds: float) -> str:
    """Return seconds as text: 40 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def seconds_of_job(environment: Mapping[str, str], now: float) -> float | None:
    """Return the seconds until a SLURM job's time limit; None in no job, or where SLURM does not say it.

    environment: variables. now: seconds since the epoch.
    """
    end = environment.get("SLURM_JOB_END_TIME", "")
    return float(end) - now if end.isdecimal() else None


def describe_rest(
    seconds: float, size: int, share: float, left: int, at_a_time: int, room: int, job_seconds: float | None
) -> str:
    """Return what the episodes that are left will take, if they are like the first one.

    Args:
        seconds: of the first episode.
        size: its bytes.
        share: how much of its longest length it had, above 0 and at most 1: a longer one takes more.
        left: episodes that this process has yet to complete.
        at_a_time: episodes that run at a time.
        room: bytes that are free on the disk.
        job_seconds: until the SLURM job's time limit; None without one.
    """
    likely, most = seconds * left / at_a_time, seconds * left / at_a_time / share
    time_left, disk = f"about {duration(likely)}", f"about {format_bytes(size * left)}"
    if share < 1:
        time_left += f" (at most {duration(most)}, if all run to their last step)"
        disk += f" (at most {format_bytes(size * left / share)})"
    line = (
        f"The first episode took {duration(seconds)} and {format_bytes(size)}. For {plural(left, 'more episode')}, "
        f"{at_a_time} at a time: {time_left}, {disk} of {format_bytes(room)} that are free."
    )
    if job_seconds is None:
        return line
    limit = f" The job's time limit, in {duration(max(0.0, job_seconds))}, "
    if most <= job_seconds:
        return f"{line}{limit}suffices."
    if likely <= job_seconds:
        return f"{line}{limit}suffices unless episodes run to their last step."
    return f"{line}{limit}does NOT suffice: another job with --resume adds what is missing then."


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

    @property
    def seconds(self) -> float:
        """Seconds since it was begun."""
        return time.monotonic() - self.begun_at

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

    def end(self, episode: EpisodeProgress, result: str = "", *, again: bool = False) -> None:
        """Show an episode no more, and how it ended. again: it will begin again, and counts as not begun."""
        self._running.remove(episode)
        if again:
            self._num_begun -= 1
        else:
            self._done += episode.size
        self._update_bar()
        self._describe_bar()
        if result:
            self.say(f"{episode.position} {episode.name}: {result}")

    def skip(self, name: str) -> None:
        """Show that another process has committed an episode."""
        self._num_begun += 1
        self.say(f"{self._position()} {name}: committed by another process.")

    def say(self, line: str) -> None:
        """Print one line, above the bar if there is one."""
        say(line) if self._bar.disable else self._bar.write(visible(line))

    def say_rest(self, seconds: float, size: int, share: float, at_a_time: int, room: int) -> None:
        """Print what the episodes that are left will take, if there are any: arguments as in `describe_rest`."""
        left = self._num_episodes - self._num_begun + len(self._running)
        if left:
            of_job = seconds_of_job(os.environ, time.time())
            self.say(describe_rest(seconds, size, share, left, at_a_time, room, of_job))

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
