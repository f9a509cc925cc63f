"""Many captures that fill one store at the same time, with overlapping lists of tasks, of which one is killed.

Usage: python -m tests.kit.races FOLDER [--rounds 2] [--processes 8] [--seed 0]; prints a line of JSON for each round.

The command line, the policy (of test size), locks, writer and store are the real ones; the simulator is a
`StillScene`, so that a capture takes a second. Processes are forked, see `forks.py`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random

import pytest

from tests.kit import forks
from tests.kit.still_scene import capture_without_simulator
from vla_attention.capture.jobs.worker_log import read_logs

#: Of the suite `robosuite`, of which a `StillScene` shows nothing.
TASKS, EPISODES = 8, 1
_ARGUMENTS = "pi --checkpoint untrained-tiny --task-suite robosuite --replan-steps 4 --max-steps 8 --num-envs 1"


@dataclass(frozen=True)
class Round:
    """What came of a round.

    Attributes:
        lists: the tasks that each process was asked for.
        victim: which process was killed, and `killed_after` how many seconds after some episodes were committed.
        committed: episodes that were in the store when it was killed.
        changed: files of these that were not the same at the end.
        exit_codes: of every process; -9 for the victim, 0 if it had ended before.
        twice: episodes that two processes say they committed.
        faults: what `vla-attention store verify` finds.
        unlike: files that differ from those of a store that one process filled, or are in one of both only.
        left: what was beside the store after one more `--resume`, other than the logs of the workers.
        tracebacks: what the processes wrote, where it has one.
    """

    lists: tuple[tuple[int, ...], ...]
    victim: int
    killed_after: float
    committed: int
    changed: tuple[str, ...]
    exit_codes: tuple[int, ...]
    twice: tuple[str, ...]
    faults: tuple[str, ...]
    unlike: tuple[str, ...]
    left: tuple[str, ...]
    tracebacks: tuple[str, ...]

    @property
    def problems(self) -> list[str]:
        """What must never happen; empty if all is well."""
        wrong = {
            f"process {number} ended with {code}"
            for number, code in enumerate(self.exit_codes)
            if code != 0 and (number, code) != (self.victim, -signal.SIGKILL)
        }
        named = {"changed": self.changed, "committed twice": self.twice, "unlike one process's": self.unlike}
        named |= {"left over": self.left, "tracebacks": self.tracebacks, "faults": self.faults}
        return sorted(wrong) + [f"{what}: {found}" for what, found in named.items() if found]


def file_digests(folder: Path) -> dict[str, str]:
    """Path in the folder to sha256, of every file."""
    return {
        file.relative_to(folder).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def unlike(one: Path, other: Path) -> tuple[str, ...]:
    """Files that differ between two folders, or that one of them lacks."""
    first, second = file_digests(one), file_digests(other)
    return tuple(sorted(path for path in first.keys() | second.keys() if first.get(path) != second.get(path)))


def faults_of(store: Path) -> list[str]:
    """What `vla-attention store verify` finds, without the imports of its command; for a process of its own."""
    from vla_attention.schemas.stores.reader import open_store
    from vla_attention.schemas.stores.verify import verify_store

    return [str(fault) for fault in verify_store(open_store(store))]


def capture(store: Path, tasks: Sequence[int]) -> int:
    """Capture the tasks' episodes; for a process of its own, which it changes."""
    from vla_attention.capture.__main__ import main
    from vla_attention.capture.engine import loop

    patch = pytest.MonkeyPatch()
    capture_without_simulator(patch)
    patch.setattr(loop, "_LOOK_EVERY_S", 0.3)
    chosen = ["--task-id", *map(str, tasks), "--num-episodes", str(EPISODES)]
    return main([*_ARGUMENTS.split(), *chosen, "--output", str(store), "--resume"])


def run_round(folder: Path, undisturbed: Path, number: int, processes: int) -> Round:
    """One race; `undisturbed` is the store that one process filled."""
    random = Random(number)
    lists = overlapping_lists(random, processes)
    store = folder / undisturbed.name  # the name is in nothing that is stored, and differs in nothing
    logs = [folder / f"{process}.log" for process in range(processes)]
    began = [forks.start(capture, store, tasks, log=log) for tasks, log in zip(lists, logs, strict=True)]
    writing = store / ".writing"
    # After some episodes, however busy the machine is, and at any moment of the next ones.
    wanted, victim, pause = random.randint(0, TASKS // 2), random.randrange(processes), random.uniform(0, 0.5)
    while not all(map(forks.ended, began)):
        if list(writing.glob("task*-*")) and len(list((store / "episodes").glob("task*"))) >= wanted:
            break
        time.sleep(0.005)
    time.sleep(pause)
    committed = sorted(episode.name for episode in (store / "episodes").glob("task*"))
    before = {name: file_digests(store / "episodes" / name) for name in committed}
    os.kill(began[victim], signal.SIGKILL)
    codes = tuple(forks.wait(process) for process in began)
    changed = [
        f"{name}/{path}"
        for name, files in before.items()
        for path, digest in files.items()
        if file_digests(store / "episodes" / name).get(path) != digest
    ]
    twice = _committed_twice(store)
    # What a killed process leaves is removed by the next capture that is started.
    codes += (forks.wait(forks.start(capture, store, range(TASKS), log=folder / "last.log")),)
    faults = forks.answer_of(faults_of, store)
    left = [entry.name for entry in folder.glob("*.zarr.*") if entry.suffix != ".log"]
    left += [entry.relative_to(folder).as_posix() for entry in store.glob(".writing/*")]
    return Round(
        lists,
        victim,
        pause,
        len(committed),
        tuple(changed),
        codes,
        twice,
        tuple(faults),
        unlike(store, undisturbed),
        tuple(left),
        tuple(log.read_text() for log in logs if "Traceback" in log.read_text()),
    )


def overlapping_lists(random: Random, processes: int) -> tuple[tuple[int, ...], ...]:
    """Tasks for each process, in any order; every task is on at least two lists."""
    while True:
        lists = tuple(tuple(random.sample(range(TASKS), random.randint(2, TASKS))) for _ in range(processes))
        if all(sum(task in one for one in lists) >= 2 for task in range(TASKS)):
            return lists


def _committed_twice(store: Path) -> tuple[str, ...]:
    """Episodes that are in the logs of two workers."""
    names = [event.episode for event in read_logs(store) if event.event == "committed"]
    return tuple(sorted({name for name in names if names.count(name) > 1}))


def rounds(folder: Path, numbers: Sequence[int], processes: int) -> list[Round]:
    """Rounds of these numbers, in folders that are removed after each."""
    prepare()
    undisturbed = folder / "undisturbed" / "race.zarr"
    undisturbed.parent.mkdir(parents=True, exist_ok=True)
    if not undisturbed.exists():
        log = folder / "undisturbed.log"
        if forks.wait(forks.start(capture, undisturbed, range(TASKS), log=log)):
            raise AssertionError(log.read_text())
    found = []
    for number in numbers:
        of_round = folder / f"round{number}"
        shutil.rmtree(of_round, ignore_errors=True)
        of_round.mkdir()
        found.append(run_round(of_round, undisturbed, number, processes))
        if not found[-1].problems:
            shutil.rmtree(of_round)
    return found


def prepare() -> None:
    """Import what a capture imports; no threads are started."""
    import torch

    from vla_attention.capture.policies.pi import family, policy
    from vla_attention.capture.run import capture_run

    torch.set_num_threads(1)
    assert all((capture_run, family, policy))


def main(argv: Sequence[str] | None = None) -> int:
    """Run races and print what came of each; exit code 1 after a problem."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--processes", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0, help="number of the first round")
    arguments = parser.parse_args(argv)
    numbers = range(arguments.seed, arguments.seed + arguments.rounds)
    found = rounds(arguments.folder, numbers, arguments.processes)
    for one in found:
        print(json.dumps({**asdict(one), "problems": one.problems}), flush=True)
    return int(any(one.problems for one in found))


if __name__ == "__main__":
    sys.exit(main())
