"""Processes of this machine give what threads give, to the last bit; those that die are replaced."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from polars.testing import assert_frame_equal

import vla_attention as va
from tests.kit.episode_work import damaged, defect, die_always, die_once, process_of, square
from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.measures.steps import measure_episodes
from vla_attention.analyze.stores.parallel import Threads, each_episode, episodes_with, map_episodes, workers
from vla_attention.analyze.stores.worker_processes import WorkersDied
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions, KeyKnockout
from vla_attention.schemas.stores.store_format import CorruptEpisode
from vla_attention.testing.stores import StoreSpec, rerun_source, write_store

#: The ends of the folders' names in the files.
OWN, OTHERS = b"/a/", b"/b/"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("processes") / "a.zarr", episodes=3, contributions=True)


@pytest.fixture(scope="module")
def two():
    with workers(2):
        yield


def test_results_come_in_order_from_other_processes(two):
    counted = []
    assert map_episodes(square, range(20), counted.append) == [i * i for i in range(20)]
    assert counted == [1] * 20
    found = set(map_episodes(process_of, range(20)))
    assert os.getpid() not in found
    assert len(found) <= 2


def tables(path, rerun):
    run = va.open(path)
    yield from (
        run.ratios(level, groups={"bowl": "word:bowl", "rest": "*"}) for level in ("tasks", "episodes", "steps")
    )
    yield run.masses("steps", per_head=True)
    yield run.contributions()
    yield run.words()
    yield from (run.heads(table) for table in ("heads", "depth", "denoise"))
    yield run.row_metrics()
    yield run.sinks()
    yield from (run.objects(table) for table in ("objects", "pointing", "iou"))
    yield run.time()
    yield run.effects(rerun, "episodes")


def test_every_question_has_the_same_answer_to_the_last_bit(two, store, tmp_path):
    knockout = Interventions("without_visual", keys=(KeyKnockout("role:image"),))
    spec = StoreSpec(interventions=knockout, rerun_of=rerun_source(store), plant_actions=lambda *_: np.ones((3, 5, 7)))
    rerun = write_store(tmp_path / "r.zarr", spec=spec)
    there = list(tables(store, rerun))
    with episodes_with(Threads()):
        here = list(tables(store, rerun))
    for one, other in zip(here, there, strict=True):
        assert_frame_equal(one, other, check_exact=True)


def test_a_process_that_is_killed_in_the_middle_is_replaced(store):
    question = question_about(store)
    with episodes_with(Threads()):
        here = measure_episodes(question)
    killed = []
    before = set(multiprocessing.active_children())

    def kill_once(_: int) -> None:
        if not killed:
            killed.append((set(multiprocessing.active_children()) - before).pop().pid)
            os.kill(killed[0], signal.SIGKILL)

    with workers(2):
        there = measure_episodes(question, progress=kill_once)
    assert killed
    for one, other in zip(here, there, strict=True):
        assert other.item is one.item
        assert one.mass.tobytes() == other.mass.tobytes()


def test_an_episode_with_which_a_process_dies_is_begun_again(tmp_path):
    with workers(2):
        assert map_episodes(partial(die_once, marker=tmp_path / "died"), range(8)) == list(range(8))
    assert (tmp_path / "died").exists()


def test_an_episode_with_which_processes_always_die_ends_with_a_sentence():
    with workers(2), pytest.raises(WorkersDied, match=r"ended 3 times without a result, the last time at .*3"):
        map_episodes(die_always, range(8))


def test_errors_are_raised_as_in_this_process(two):
    results = each_episode(damaged, range(100))
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(CorruptEpisode, match=r"^Episode 2 is damaged\.$"):
        next(results)
    with pytest.raises(ZeroDivisionError, match="a defect at 0"):
        map_episodes(defect, range(3))
    assert map_episodes(square, range(3)) == [0, 1, 4]


def test_no_process_is_left_behind(store):
    before = set(multiprocessing.active_children())
    with workers(2):
        va.open(store).ratios()
        assert len(set(multiprocessing.active_children()) - before) == 2
    assert set(multiprocessing.active_children()) <= before


def runs(pid: str) -> bool:
    """Whether a process has not ended; one that its new parent has not waited for yet has."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except FileNotFoundError:
        return False
    return status.rpartition(")")[2].split()[0] not in "ZX"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at /proc")
def test_processes_end_when_their_asker_is_killed():
    code = """
import os, signal
from tests.kit.episode_work import process_of
from vla_attention.analyze.stores.parallel import map_episodes, workers
if __name__ == "__main__":
    with workers(2):
        print(*sorted(set(map_episodes(process_of, range(40)))), flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
"""
    # Workers hold the other end of this pipe: it ends when the last of them has.
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, timeout=120, check=False)
    assert done.returncode == -signal.SIGKILL
    until = time.monotonic() + 30
    while left := [pid for pid in done.stdout.split() if runs(pid)]:  # the pipe ends a moment before the process does
        assert time.monotonic() < until, left
        time.sleep(0.05)


@pytest.mark.parametrize("stdin", [False, True])
def test_a_script_needs_no_guard(store, tmp_path, stdin):
    script = tmp_path / "script.py"
    script.write_text(
        "import vla_attention as va\n"
        "with va.workers(2):\n"
        f"    print(len(va.open({str(store)!r}).masses('episodes')))\n"
        "print(__name__)\n"
    )
    done = subprocess.run(
        [sys.executable, *([] if stdin else [str(script)])],
        input=script.read_text() if stdin else None,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    rows, name = done.stdout.split()
    assert (int(rows), name) == (len(va.open(store).masses("episodes")), "__main__")


def test_the_command_line_takes_a_number_of_workers(store, tmp_path, capsys):
    before = set(multiprocessing.active_children())
    for folder, options in (("a", []), ("b", ["--workers", "2"])):
        assert main([str(store), "--no-plots", "--output", str(tmp_path / folder), *options]) == 0
    assert set(multiprocessing.active_children()) <= before
    files = sorted(file.name for file in (tmp_path / "a").iterdir())
    assert files == sorted(file.name for file in (tmp_path / "b").iterdir())
    for file in files:
        assert (tmp_path / "a" / file).read_bytes().replace(OWN, OTHERS) == (tmp_path / "b" / file).read_bytes(), file


@pytest.mark.parametrize("number", ["0", "-2"])
def test_no_workers_are_refused(store, tmp_path, capsys, number):
    assert main([str(store), "--no-plots", "--output", str(tmp_path), "--workers", number]) == 2
    assert f"Cannot use --workers {number}; expected at least 1." in capsys.readouterr().err
    with pytest.raises(BadArgument), workers(int(number)):
        pass
