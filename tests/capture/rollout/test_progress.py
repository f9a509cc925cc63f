"""The lines of a log file: one per finished episode, and one every half minute during an episode."""

from __future__ import annotations

import pytest

from vla_attention.capture.rollout import progress as progress_module
from vla_attention.capture.rollout.progress import Progress


class Clock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(progress_module, "time", made)
    return made


def test_lines_of_a_log_file(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    progress = Progress(num_episodes=3, max_steps=200)
    progress.begin(4, 0)
    clock.now += 10
    progress.update(5, 1)  # too early for a line
    clock.now += 25
    progress.update(40, 8)
    clock.now += 25
    progress.update(80, 16)  # 25 s after the last line
    progress.end("success after 80 steps", "lift the red cube")
    progress.skip("task004_episode001")
    progress.begin(4, 2)
    clock.now += 7
    progress.end("no success after 200 steps", "lift the red cube")
    progress.close()
    printed = capsys.readouterr()
    assert printed.out.splitlines() == [
        "[1/3] task 4 episode 0: step 40 of at most 200, 8 replans, 35 s",
        "[1/3] task 4 episode 0: success after 80 steps, 60 s (lift the red cube)",
        "[2/3] task004_episode001: committed by another process.",
        "[3/3] task 4 episode 2: no success after 200 steps, 7 s (lift the red cube)",
    ]
    assert printed.err == ""
