"""Eight captures fill one store, with overlapping lists, and one of them is killed.

`benchmarks/reliability.py race` has twenty rounds. The processes are forks of a process without threads, see
`tests/kit/forks.py`, which pytest's is not.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys

import pytest

from tests.kit.races import EPISODES, TASKS


@pytest.mark.thorough
def test_eight_processes_of_which_one_is_killed_fill_a_store_as_one_does(tmp_path):
    command = [sys.executable, "-m", "tests.kit.races", str(tmp_path), "--rounds", "1"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    rounds = [json.loads(line) for line in ended.stdout.splitlines()]
    assert [one["problems"] for one in rounds] == [[]], ended.stderr
    assert ended.returncode == 0, ended.stderr
    for one in rounds:
        assert len(one["exit_codes"]) == 9
        assert one["exit_codes"][one["victim"]] in (0, -signal.SIGKILL)
    episodes = [path.name for path in (tmp_path / "undisturbed/race.zarr/episodes").glob("task*")]
    assert len(episodes) == TASKS * EPISODES
