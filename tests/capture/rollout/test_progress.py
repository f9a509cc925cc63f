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
    progress = Progress(3, 3 * 200, "step")
    episode = progress.begin("task 4 episode 0", 200)
    clock.now += 10
    episode.update(5, 1)  # too early for a line
    clock.now += 25
    episode.update(40, 8)
    clock.now += 25
    episode.update(80, 16)  # 25 s after the last line
    episode.end("success after 80 steps", "lift the red cube")
    progress.skip("task004_episode001")
    episode = progress.begin("task 4 episode 2", 200)
    clock.now += 7
    episode.end("no success after 200 steps", "lift the red cube")
    progress.close()
    printed = capsys.readouterr()
    assert printed.out.splitlines() == [
        "[1/3] task 4 episode 0: step 40 of at most 200, 8 replans, 35 s",
        "[1/3] task 4 episode 0: success after 80 steps, 60 s (lift the red cube)",
        "[2/3] task004_episode001: committed by another process.",
        "[3/3] task 4 episode 2: no success after 200 steps, 7 s (lift the red cube)",
    ]
    assert printed.err == ""


def test_one_line_is_about_all_episodes_in_progress(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    progress = Progress(9, 9 * 200, "step")
    episodes = [progress.begin(f"task 0 episode {number}", 200) for number in range(2)]
    clock.now += 31
    episodes[1].update(5, 1)
    clock.now += 29
    episodes[0].update(10, 2)  # 29 s after the last line
    episodes[0].end("success after 10 steps", "lift the red cube")
    more = [progress.begin(f"task 1 episode {number}", 200) for number in range(5)]
    clock.now += 1
    more[0].update(1, 1)
    for episode in (episodes[1], *more):
        episode.end("no success after 200 steps", "lift the red cube")
    progress.close()
    assert capsys.readouterr().out.splitlines()[:3] == [
        "[1/9] task 0 episode 0: step 0 of at most 200, 0 replans, 31 s; "
        "[2/9] task 0 episode 1: step 5 of at most 200, 1 replans, 31 s",
        "[1/9] task 0 episode 0: success after 10 steps, 60 s (lift the red cube)",
        "[2/9] task 0 episode 1: step 5 of at most 200, 1 replans, 61 s; "
        "[3/9] task 1 episode 0: step 1 of at most 200, 1 replans, 1 s; "
        "[4/9] task 1 episode 1: step 0 of at most 200, 0 replans, 1 s; "
        "[5/9] task 1 episode 2: step 0 of at most 200, 0 replans, 1 s; 2 more episodes",
    ]


def test_policy_calls_are_counted_where_no_environment_runs(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    progress = Progress(2, 30, "call")
    episode = progress.begin("task000_episode000", 10)
    clock.now += 31
    episode.update(4, 4)
    episode.drop()
    progress.close()
    assert capsys.readouterr().out.splitlines() == ["[1/2] task000_episode000: 4 of 10 policy calls, 31 s"]
