"""The part `kill` of `reliability.py`: runs that end in every way, and what is in their stores then.

Every case runs the command line in a forked process: a capture, or a rerun or replay where its name says so. Where it
says "simulator", that is the real one (the suite `cubes`); other captures have a `StillScene`, because they are about
files only. After each case the episodes that were committed before have to be the same to the byte, and the checks of
`vla-attention store verify` have to accept the store. Later cases of a series go on with its store; one that is
complete has to be the undisturbed one, to the byte.
"""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random
from typing import Any, Literal

import pytest
from reliability_state import Results

from tests.kit import forks
from tests.kit.boundaries import end_before, limit_file_sizes
from tests.kit.races import faults_of, file_digests, prepare, unlike
from tests.kit.still_scene import capture_without_simulator

EXIT_SIGTERM, EXIT_CTRL_C, EXIT_REFUSED = 75, 130, 2
#: Small episodes, so that a store is complete after some kills.
_TASKS, _EPISODES = (0, 1), 3
_ARGUMENTS = "pi --checkpoint untrained-tiny --task-suite cubes --replan-steps 4 --max-steps 12"
#: Where the policy calls come from: so many simulators (0: a still scene), a store, or a data set.
Calls = int | Literal["rerun", "replay"]
_NOBODY = 65534
#: The longest pause after the first episode's beginning, of which nobody knows yet how long it takes.
_PAUSE_S = 1.0


@dataclass(frozen=True)
class Run:
    """A run of three episodes of each task into a store, for a process of its own.

    source: of a rerun the store, of a replay the data set. before: called first, with the path of the store.
    """

    store: Path
    calls: Calls
    source: Path
    before: Callable[[Path], object] = field(default=lambda store: None)
    tasks: tuple[int, ...] = _TASKS

    def __call__(self) -> int:
        """Run the command line."""
        from vla_attention.capture.__main__ import main

        if self.calls == 0:
            capture_without_simulator(pytest.MonkeyPatch())
        self.before(self.store)
        if self.calls == "rerun":
            words = ["rerun", str(self.source), "--noise-seed", "3", "--check", "0"]
        elif self.calls == "replay":
            words = ["replay", str(self.source), "--checkpoint", "untrained-tiny", "--every", "2"]
        else:
            words = [*_ARGUMENTS.split(), "--task-id", *map(str, self.tasks), "--num-episodes", str(_EPISODES)]
            words += ["--num-envs", str(self.calls or 1)]
        return main([*words, "--output", str(self.store), "--resume"])


@dataclass
class Series:
    """Cases of one kind, whose captures go on with one store after another."""

    name: str
    folder: Path
    calls: Calls
    reference: Path
    source: Path
    tasks: tuple[int, ...] = _TASKS

    @property
    def store(self) -> Path:
        """The present store."""
        return self.folder / "run.zarr"

    def begin(self) -> None:
        """Remove what is left of an earlier store."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)

    def committed(self) -> dict[str, dict[str, str]]:
        """Name to digests of the files of each episode that is in the store."""
        return {one.name: file_digests(one) for one in sorted((self.store / "episodes").glob("task*"))}

    def start(self, before: Callable[[Path], object] = lambda store: None) -> int:
        """Start a capture; returns its process."""
        (self.folder / "log").unlink(missing_ok=True)
        run = Run(self.store, self.calls, self.source, before, self.tasks)
        return forks.start(run, log=self.folder / "log")

    def mid_episode(self, process: int, random: Random) -> bool:
        """Wait for a random moment of an episode, after none to two others were committed; False if all end before.

        The moments are those of a share of the time that the first or the last episode took, however busy the machine.
        """
        writing = self.store / ".writing"
        began, committed, wanted = time.monotonic(), len(self._names()), random.randint(0, 2)
        took = 0.0
        while not forks.ended(process):
            now = len(self._names())
            if now > committed:
                took, began, wanted, committed = time.monotonic() - began, time.monotonic(), wanted - 1, now
            try:
                is_written = any(name.startswith("task") and "-" in name for name in os.listdir(writing))
            except FileNotFoundError:  # between two episodes
                is_written = False
            if wanted <= 0 and is_written:
                time.sleep(random.uniform(0, took or _PAUSE_S))
                return not forks.ended(process)
            time.sleep(0.003)
        return False

    def _names(self) -> list[Path]:
        return list((self.store / "episodes").glob("task*"))

    def case(self, number: int, before: dict[str, dict[str, str]], code: int, expected: set[int]) -> dict[str, Any]:
        """What is to be told of a case: compares what was committed, and verifies the store."""
        problems = []
        log = (self.folder / "log").read_text(errors="replace")
        if code not in expected:
            problems.append(f"exit code {code}, expected {sorted(expected)}; it printed {log[-2000:]!r}")
        if "Traceback" in log:
            problems.append(f"a traceback: {log[-3000:]!r}")
        now = self.committed()
        changed = sorted(name for name, files in before.items() if now.get(name) != files)
        problems += [f"{name} changed" for name in changed]
        complete = len(now) == len(self.tasks) * _EPISODES
        found = unlike(self.store, self.reference) if complete else ()
        different = [file for file in found if not file.startswith(".writing/")]  # of the process that was killed
        problems += [f"unlike the undisturbed store: {', '.join(different[:5])}"] if different else []
        # What is equal to the undisturbed store is as whole as that one, which was verified.
        faults = forks.answer_of(faults_of, self.store) if self.store.exists() and (different or not complete) else []
        problems += faults
        return {
            "series": self.name,
            "number": number,
            "code": code,
            "compared": len(before),
            "changed": len(changed),
            "faulty": bool(faults),
            "completed": complete,
            "unlike": bool(different),
            "problems": problems,
        }


def run(folder: Path, results: Results, counts: dict[str, int]) -> None:
    """Try every series up to its count; cases that the results have are not repeated."""
    prepare()
    import vla_attention.capture.environments.cubes.table
    import vla_attention.capture.replay.family_replay
    import vla_attention.capture.rerun.command  # noqa: F401

    for name, (calls, cases) in SERIES.items():
        reference = _reference(folder, min(calls, 1) if isinstance(calls, int) else calls)
        series = Series(name, folder / name.replace(" ", "_"), calls, reference, _source(folder, calls))
        missing = results.missing(name, range(counts.get(name, 0)))
        if missing:
            series.begin()
            for case in cases(series, missing):
                results.add(case)
                if case["problems"]:
                    shutil.copytree(series.folder, folder / "problems" / f"{series.folder.name}-{case['number']}")
                if case["completed"] or case["problems"]:
                    series.begin()
            shutil.rmtree(series.folder)


def _source(folder: Path, calls: Calls) -> Path:
    """What a rerun or a replay takes its policy calls from; of captures a path at which nothing is."""
    if calls == "rerun":
        return _reference(folder, 0)
    data = folder / "data"
    if calls == "replay" and not data.exists():
        forks.answer_of(_write_data_set, data)
    return data


def _write_data_set(folder: Path) -> str:
    from tests.kit.lerobot_data_sets import made_up_episodes, write_data_set  # in the fork: it imports polars

    made = made_up_episodes((6,) * (len(_TASKS) * _EPISODES), ("image", "wrist_image"), state=8, action=7)
    return str(write_data_set(folder, "v2.1", made))


def _reference(folder: Path, calls: Calls, tasks: tuple[int, ...] = _TASKS) -> Path:
    """The undisturbed store, which one run fills."""
    path = folder / f"undisturbed{calls}-{len(tasks)}" / "run.zarr"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        log = path.with_name("log")
        if forks.wait(forks.start(Run(path, calls, _source(folder, calls), tasks=tasks), log=log)):
            raise AssertionError(log.read_text())
        if faults := forks.answer_of(faults_of, path):
            raise AssertionError(str(faults))
    return path


def _signalled(
    number: int, expected: set[int], before_run: Callable[[Path], object] = lambda store: None
) -> Callable[[Series, list[int]], Iterator[dict[str, Any]]]:
    """Cases in which a signal comes while an episode is under way, at a random moment."""

    def cases(series: Series, missing: list[int]) -> Iterator[dict[str, Any]]:
        for case in missing:
            random = Random(f"{series.name} {case}")
            process = series.start(before_run)
            running = series.mid_episode(process, random)
            simulators = _simulators_of(process)
            before = series.committed()
            if running:
                os.kill(process, number)
            told = series.case(case, before, forks.wait(process), expected | {0})
            told["problems"] += _still_there(simulators)
            yield told

    return cases


def _refuse_links(store: Path) -> None:
    """Let hard links be refused, as exFAT, gcsfuse and others do."""

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    os.link = refuse


def _stopped(series: Series, missing: list[int]) -> Iterator[dict[str, Any]]:
    """A capture stands still beyond its lock's time, another completes the store, and the first goes on."""
    log, of_stopped = series.folder / "log", series.folder / "log.stopped"
    for case in missing:
        process = series.start()
        running = series.mid_episode(process, Random(f"{series.name} {case}"))
        if running:
            os.kill(process, signal.SIGSTOP)
            for lock in (series.store / ".writing").glob("*.lock"):
                os.utime(lock, (1000, 1000))
        before = series.committed()
        log.rename(of_stopped)
        second = series.case(case, before, forks.wait(series.start()), {0})
        before = series.committed()
        if running:
            os.kill(process, signal.SIGCONT)
        code = forks.wait(process)
        of_stopped.rename(log)
        told = series.case(case, before, code, {0})
        yield {**told, "problems": second["problems"] + told["problems"]}


def _simulators_of(process: int) -> list[int]:
    """Processes of simulators that a capture has started."""
    found = subprocess.run(["pgrep", "-P", str(process)], capture_output=True, text=True, check=False)
    return [int(word) for word in found.stdout.split()]


def _still_there(processes: list[int]) -> list[str]:
    """Simulators that go on after their capture."""
    until = time.monotonic() + 30
    left = [process for process in processes if Path(f"/proc/{process}").exists()]
    while left and time.monotonic() < until:
        time.sleep(0.05)
        left = [process for process in left if Path(f"/proc/{process}").exists() and not _is_zombie(process)]
    return [f"simulators {left} go on"] if left else []


def _is_zombie(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def _simulator_killed(series: Series, missing: list[int]) -> Iterator[dict[str, Any]]:
    """A simulator is killed in the middle of an episode; the capture starts another one and completes the store."""
    for case in missing:
        random = Random(f"{series.name} {case}")
        process = series.start()
        series.mid_episode(process, random)
        simulators = _simulators_of(process)
        before = series.committed()
        if simulators:
            os.kill(random.choice(simulators), signal.SIGKILL)
        told = series.case(case, before, forks.wait(process), {0})
        told["problems"] += [] if told["completed"] else ["the store is not complete"]
        yield told


def _every_boundary(series: Series, missing: list[int]) -> Iterator[dict[str, Any]]:
    """The capture ends before each call that changes files, while it adds the last episode; then it is resumed."""
    series = replace(series, tasks=(0,), reference=_reference(series.folder.parent, 0, (0,)))
    all_but_one(series)
    total = forks.answer_of(_count_changes, series)
    order = [number for number in missing if number < total]
    Random(0).shuffle(order)  # a run that is cut short has tried some of all
    for case in order:
        series.begin()
        all_but_one(series)
        before = series.committed()
        code = forks.wait(series.start(lambda store, case=case: end_before(store.parent, case)))
        told = series.case(case, before, code, {-signal.SIGKILL, 0})
        resumed = series.case(case, series.committed(), forks.wait(series.start()), {0})
        resumed["problems"] = told["problems"] + resumed["problems"]
        resumed["problems"] += [] if resumed["completed"] else ["the store is not complete"]
        yield {**resumed, "of": total}


def all_but_one(series: Series) -> None:
    """Let the series have a store that lacks its last episode."""
    shutil.copytree(series.reference, series.store)
    shutil.rmtree(max((series.store / "episodes").glob("task*")))


def _count_changes(series: Series) -> int:
    counted: list[Callable[[], int]] = []
    before: Callable[[Path], object] = lambda path: counted.append(end_before(path.parent, -1))  # noqa: E731
    count = Run(series.store, 0, series.source, before, series.tasks)
    with (series.folder / "log").open("w") as log, redirect_stdout(log):
        count()
    return counted[0]()


def _grown(*, kill: bool) -> Callable[[Series, list[int]], Iterator[dict[str, Any]]]:
    """A file cannot grow beyond a random size: the process is killed in the middle of it, or the write fails."""

    def cases(series: Series, missing: list[int]) -> Iterator[dict[str, Any]]:
        sizes = sorted({file.stat().st_size for file in series.reference.rglob("*") if file.is_file()})
        for case in missing:
            random = Random(f"{series.name} {case}")
            # A lock that is cut off has no known holder, who counts as dead after five minutes only.
            most = max(1000, random.choice(sizes) * random.randint(1, 99) // 100)
            code = forks.wait(series.start(lambda store, most=most: limit_file_sizes(most, kill=kill)))
            expected = {-signal.SIGXFSZ, 0} if kill else {EXIT_REFUSED, 0}
            told = series.case(case, {}, code, expected)
            before = series.committed()
            resumed = series.case(case, before, forks.wait(series.start()), {0})
            resumed["problems"] = told["problems"] + resumed["problems"]
            yield resumed

    return cases


def _full_disk(series: Series, missing: list[int]) -> Iterator[dict[str, Any]]:
    """A file system of a random size, smaller than the store; resumed after it has grown."""
    size = sum(file.stat().st_size for file in series.reference.rglob("*") if file.is_file())
    for case in missing:
        most = Random(f"{series.name} {case}").randint(size // 10, size)
        disk = series.folder / "disk"
        disk.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={most}", "none", str(disk)], check=True)
        try:
            small = Series(series.name, disk, 0, series.reference, series.source)
            code = forks.wait(small.start())
            refused = small.case(case, {}, code, {EXIT_REFUSED})
            before = small.committed()
            subprocess.run(["mount", "-o", f"remount,size={4 * size}", str(disk)], check=True)
            told = small.case(case, before, forks.wait(small.start()), {0})
        finally:
            subprocess.run(["umount", str(disk)], check=True)
        told["problems"] = refused["problems"] + told["problems"]
        yield told


def _read_only(series: Series, missing: list[int]) -> Iterator[dict[str, Any]]:
    """Another user resumes a store in a folder that only its owner can write to."""
    for case in missing:
        store = series.store
        some = Random(f"{series.name} {case}").randint(0, len(_TASKS) * _EPISODES - 1)
        shutil.copytree(series.reference, store)
        for episode in sorted((store / "episodes").glob("task*"))[some:]:
            shutil.rmtree(episode)
        before = series.committed()
        everything = file_digests(series.folder)
        refused = series.case(case, before, forks.wait(series.start(_become_nobody)), {EXIT_REFUSED})
        after = {path: digest for path, digest in file_digests(series.folder).items() if path != "log"}
        refused["problems"] += [] if after == everything else ["files were changed"]
        told = series.case(case, before, forks.wait(series.start()), {0})
        told["problems"] = refused["problems"] + told["problems"]
        yield told


def _become_nobody(store: Path) -> None:
    os.setgid(_NOBODY)
    os.setuid(_NOBODY)
    assert not os.access(store, os.W_OK)


#: Name of a series -> where its policy calls come from, its cases.
SERIES: dict[str, tuple[Calls, Callable[[Series, list[int]], Iterator[dict[str, Any]]]]] = {
    "SIGKILL, one simulator": (1, _signalled(signal.SIGKILL, {-signal.SIGKILL})),
    "SIGKILL, two simulators": (2, _signalled(signal.SIGKILL, {-signal.SIGKILL})),
    "SIGTERM, one simulator": (1, _signalled(signal.SIGTERM, {EXIT_SIGTERM})),
    "SIGTERM, two simulators": (2, _signalled(signal.SIGTERM, {EXIT_SIGTERM})),
    "Ctrl-C, one simulator": (1, _signalled(signal.SIGINT, {EXIT_CTRL_C})),
    "Ctrl-C, two simulators": (2, _signalled(signal.SIGINT, {EXIT_CTRL_C})),
    "SIGKILL, rerun": ("rerun", _signalled(signal.SIGKILL, {-signal.SIGKILL})),
    "SIGKILL, replay": ("replay", _signalled(signal.SIGKILL, {-signal.SIGKILL})),
    "SIGTERM, rerun": ("rerun", _signalled(signal.SIGTERM, {EXIT_SIGTERM})),
    "SIGTERM, replay": ("replay", _signalled(signal.SIGTERM, {EXIT_SIGTERM})),
    "SIGKILL, no hard links": (0, _signalled(signal.SIGKILL, {-signal.SIGKILL}, _refuse_links)),
    "a simulator killed": (2, _simulator_killed),
    "stopped beyond its lock's time": (0, _stopped),
    "killed before each change of a file": (0, _every_boundary),
    "killed within a file": (0, _grown(kill=True)),
    "a write fails within a file": (0, _grown(kill=False)),
    "full disk": (0, _full_disk),
    "read-only folder": (0, _read_only),
}
#: How many cases of each series a whole run has. In some of the first ones the capture ends before it is killed.
COUNTS = {
    "SIGKILL, one simulator": 200,
    "SIGKILL, two simulators": 80,
    "SIGTERM, one simulator": 10,
    "SIGTERM, two simulators": 5,
    "Ctrl-C, one simulator": 10,
    "Ctrl-C, two simulators": 5,
    "SIGKILL, rerun": 60,
    "SIGKILL, replay": 60,
    "SIGTERM, rerun": 5,
    "SIGTERM, replay": 5,
    "SIGKILL, no hard links": 40,
    "a simulator killed": 10,
    "stopped beyond its lock's time": 40,
    "killed before each change of a file": 10_000,
    "killed within a file": 40,
    "a write fails within a file": 20,
    "full disk": 10,
    "read-only folder": 5,
}
