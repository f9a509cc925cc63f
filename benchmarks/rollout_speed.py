"""Episodes a minute: one simulator in the policy's process, several in processes of their own, and without writing.

Usage: OMP_NUM_THREADS=1 python benchmarks/rollout_speed.py [--suite libero_10] [--episodes 8] [--max-steps 30]
           [--rounds 3] [--num-envs 2 3] [--checkpoint untrained]

Every policy and every renderer has one thread. All episodes have the same length, as random weights solve nothing. The
rate of a run counts from the commits of its first `num_envs` episodes to the last commit, so that starting processes
and building scenes is left out. The core-seconds of an episode are those of the same round's run with one simulator, by
part; the bound is the largest of their sum shared by the cores, the policy (one process calls it) and the simulation
shared by the simulators. Beside it stand the core-seconds that each run took, counted like its rate, which say what
beside waiting keeps it from the bound. "without writing" drops every replan instead of giving it to the thread.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.measurement import Table, fix_threads, in_turn, measured, ratios, write_rows  # noqa: E402

fix_threads(1)
os.environ.setdefault("MUJOCO_GL", "egl")

from vla_attention.capture.commands.arguments import build_parser  # noqa: E402
from vla_attention.capture.engine import loop as loops  # noqa: E402
from vla_attention.capture.engine.call import Caller  # noqa: E402
from vla_attention.capture.engine.simulation import Simulation  # noqa: E402
from vla_attention.capture.engine.simulators import SimulatedEpisode, SimulatorProcess  # noqa: E402
from vla_attention.capture.engine.source import Committed  # noqa: E402
from vla_attention.capture.engine.writing import EpisodeInBackground, WritingThread  # noqa: E402
from vla_attention.capture.machine import load_torch  # noqa: E402
from vla_attention.capture.policies.policy import Policy  # noqa: E402
from vla_attention.capture.run import capture_run  # noqa: E402
from vla_attention.capture.run.run_settings import run_settings  # noqa: E402
from vla_attention.capture.store.episode_writer import EpisodeWriter  # noqa: E402
from vla_attention.schemas.threads import use_threads  # noqa: E402


class Parts:
    """The processor time of parts of a run with one simulator, in seconds."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {"simulation": 0.0, "policy": 0.0, "writing": 0.0}

    def timed(self, part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed_call(*given: Any, **options: Any) -> Any:
            began = time.process_time()
            try:
                return call(*given, **options)
            finally:
                self.seconds[part] += time.process_time() - began

        return timed_call


@dataclass(frozen=True)
class Run:
    """Episodes a minute, core-seconds of an episode of all processes, and those of its parts (one simulator)."""

    rate: float
    core_seconds: float
    parts: dict[str, float]


def processor_seconds() -> float:
    """Return the processor time of this process and the simulators that live."""
    children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    stats = [Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split() for child in children]
    return time.process_time() + sum(int(stat[11]) + int(stat[12]) for stat in stats) / os.sysconf("SC_CLK_TCK")


class NotWritten(EpisodeInBackground):
    """Drops its replans; its commit gives a folder that holds nothing."""

    def append(self, record: Any) -> None:
        return

    def commit(self, outcome: Any) -> None:
        name = f"task{self.start.task_id:03d}_episode{self.start.episode_index:03d}"
        self.committed = Committed(outcome, 1, Path(tempfile.gettempdir()) / name)
        self.thread.put(lambda: None)


def measure(policy: Policy, arguments: argparse.Namespace, num_envs: int, written: bool, peak_mb: list[float]) -> Run:
    """Run the episodes; peak_mb: gets the largest memory of each process that simulated."""
    parts = Parts()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        words = ["pi", "--checkpoint", arguments.checkpoint, "--task-suite", arguments.suite, "--task-id", "0"]
        words += ["--num-episodes", str(arguments.episodes), "--max-steps", str(arguments.max_steps)]
        words += ["--output", str(Path(folder) / "run.zarr"), "--num-envs", str(num_envs)]
        settings = run_settings(build_parser().parse_args(words))
        commits: list[tuple[float, float]] = []
        note, made = loops.EpisodeLoop._note_commit, WritingThread.episode

        def note_commit(loop: Any, *given: Any) -> None:
            commits.append((time.monotonic(), processor_seconds()))
            note(loop, *given)

        close = SimulatorProcess.close

        def close_measured(process: Any) -> None:
            status = Path(f"/proc/{process.number}/status").read_text()
            peak_mb.append(float(status.partition("VmHWM:")[2].split()[0]) / 1024)
            close(process)

        loops.EpisodeLoop._note_commit = note_commit  # type: ignore[method-assign]
        SimulatorProcess.close = close_measured  # type: ignore[method-assign]
        if not written:
            WritingThread.episode = lambda self, *given: NotWritten(self, *given)  # type: ignore
        own = {(Simulation, name): getattr(Simulation, name) for name in ("begin", "wait", "advance")} | {
            (EpisodeWriter, name): getattr(EpisodeWriter, name) for name in ("append", "commit")
        }
        call, prepare = Caller.make, SimulatedEpisode._prepared
        if num_envs == 1:
            for (kind, name), method in own.items():
                setattr(kind, name, parts.timed("simulation" if kind is Simulation else "writing", method))
            Caller.make = parts.timed("policy", call)  # type: ignore[method-assign]
            SimulatedEpisode._prepared = parts.timed("policy", prepare)  # type: ignore[method-assign]
        try:
            capture_run.run_capture(settings, policy, "cpu")
        finally:
            SimulatorProcess.close = close  # type: ignore[method-assign]
            loops.EpisodeLoop._note_commit = note  # type: ignore[method-assign]
            WritingThread.episode = made  # type: ignore[method-assign]
            for (kind, name), method in own.items():
                setattr(kind, name, method)
            Caller.make, SimulatedEpisode._prepared = call, prepare  # type: ignore[method-assign]
    num_counted = len(commits) - num_envs
    seconds, core_seconds = (last - first for first, last in zip(commits[num_envs - 1], commits[-1], strict=True))
    shares = {part: each / len(commits) for part, each in parts.seconds.items()}
    return Run(60 * num_counted / seconds, core_seconds / num_counted, shares)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", default="libero_10")
    parser.add_argument("--checkpoint", default="untrained")
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--max-steps", type=int, default=30)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--num-envs", type=int, nargs="+", default=[2, 3])
    parser.add_argument("--folder", help="where the stores are written (default: the folder for temporary files)")
    arguments = parser.parse_args()
    use_threads(1)
    load_torch("cpu", 1)
    words = ["pi", "--checkpoint", arguments.checkpoint]
    given = build_parser().parse_args(words)
    policy = given.family.read(given).build("cpu")
    cores, peak_mb = len(os.sched_getaffinity(0)), list[float]()
    kinds = {"one simulator": (1, True)} | {f"{num} simulators": (num, True) for num in arguments.num_envs}
    several = f"{arguments.num_envs[0]} simulators"
    unwritten = f"{several}, without writing"
    kinds[unwritten] = (arguments.num_envs[0], False)
    runs: dict[str, list[Run]] = {name: [] for name in kinds}

    def measurer(name: str) -> Callable[[], float]:
        def rate() -> float:
            runs[name].append(measure(policy, arguments, *kinds[name], peak_mb))
            return runs[name][-1].rate

        return rate

    rates = in_turn({name: measurer(name) for name in kinds}, arguments.rounds, warm_up=0)
    serial = [run.parts for run in runs["one simulator"]]

    def bounds(num_envs: int) -> list[float]:
        # No process but this one calls the policy, and a simulator is in one episode at a time.
        return [
            60 / max(sum(parts.values()) / cores, parts["policy"], parts["simulation"] / num_envs) for parts in serial
        ]

    rows: list[dict[str, Any]] = [
        {
            "run": name,
            "rate": measured(values),
            "times": measured(ratios(values, rates["one simulator"])),
            "of_bound": measured(ratios(values, bounds(kinds[name][0]))) if name != "one simulator" else None,
            "core_seconds": measured([run.core_seconds for run in runs[name]]),
        }
        for name, values in rates.items()
    ]
    written = measured(ratios(rates[several], rates[unwritten]))
    bound = measured(bounds(arguments.num_envs[0]))
    what = f"{arguments.checkpoint}, {arguments.suite} task 0, {arguments.max_steps} steps an episode"
    note = (
        f"{what}. Bound: {bound.median:.1f} episodes a minute on {cores} cores. With writing {written.median:.3f} "
        f"({written.lowest:.3f} to {written.highest:.3f}) of the rate without. A simulator's process took "
        f"{max(peak_mb):.0f} MB."
    )
    columns = {
        "run": "run",
        "rate": "episodes a minute",
        "times": "times one simulator",
        "of_bound": "of the bound",
        "core_seconds": "core-seconds an episode",
    }
    shares = {part: measured([parts[part] for parts in serial]) for part in serial[0]}
    total = sum(share.median for share in shares.values())
    costs = [{"part": part, "seconds": each, "share": round(each.median / total, 3)} for part, each in shares.items()]
    tables = {
        f"{arguments.suite}": Table(columns, rows, note),
        f"{arguments.suite}-parts": Table(
            {"part": "part", "seconds": "core-seconds an episode", "share": "share"}, costs, f"{what}."
        ),
    }
    path = write_rows("rollout_speed", tables)
    for row in [*rows, *costs]:
        print(row)
    print(note)
    print(f"Written: {path}")


if __name__ == "__main__":
    main()
