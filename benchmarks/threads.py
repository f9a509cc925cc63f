"""Seconds of a policy call and of a scan: alone, and beside two processes that keep a core busy each.

Usage: python benchmarks/threads.py [--rounds 7] [--busy 2] [--threads N]

Three processes make the untrained pi0.5's calls in turn, so that all of them see the same machine: with torch's own
defaults, with the number of threads and the sleeping that `capture` sets, and with one thread. Two more scan a
store of ten episodes through the Python API: with numpy's default threads, and with one BLAS thread inside the scan, as
the product does. Medians are printed; on a machine with other work, "alone" is not alone.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.analysis_speed import make_store  # noqa: E402 - a script, and not part of the package

#: Variables that a run of this benchmark must not inherit.
NAMES = ("OMP_", "GOMP_", "KMP_", "MKL_", "OPENBLAS_", "POLARS_")


def serve(call: Callable[[], object]) -> None:
    """Answer every line of stdin with the seconds of one call; the first call is not counted."""
    call()
    print("ready", flush=True)
    for _ in sys.stdin:
        began = time.perf_counter()
        call()
        print(time.perf_counter() - began, flush=True)


def policy_call(settings: str) -> None:
    from vla_attention.schemas.threads import use_threads

    if settings != "default":
        threads = use_threads(int(settings) if settings else None).number
    import torch

    if settings != "default":
        torch.set_num_threads(threads)
    import numpy as np

    from vla_attention.capture.environments.base import Observation
    from vla_attention.capture.policies.pi.embedded import embedded_policy

    frame = np.random.default_rng(0).integers(0, 255, (256, 256, 3), dtype=np.uint8)
    observation = Observation(
        images={"agentview": frame, "robot0_eye_in_hand": frame},
        eef_pos=np.array([-0.2, 0.05, 1.0]),
        eef_quat=np.array([1.0, 0, 0, 0]),
        gripper_qpos=np.array([0.03, -0.03]),
    )
    policy = embedded_policy()
    given = policy.prepare(observation, "put the black bowl on the plate")
    serve(lambda: policy.act(given, 0))


def scan(settings: str, store: str) -> None:
    from vla_attention.analyze.stores import parallel

    if settings == "default":
        parallel.one_blas_thread = contextlib.nullcontext  # type: ignore[assignment]
    import vla_attention as va
    from vla_attention.analyze.core.levels import levels_of

    groups = {"soup": "word:soup", "rest": "*"}  # cuts a segment: every row is read and multiplied
    serve(lambda: levels_of(va.open(store).ask(groups=groups)))


def busy() -> None:
    number = 0
    while True:
        number += 1


@contextlib.contextmanager
def beside(count: int) -> Iterator[None]:
    others = [multiprocessing.Process(target=busy, daemon=True) for _ in range(count)]
    for other in others:
        other.start()
    time.sleep(1)
    yield
    for other in others:
        other.terminate()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--busy", type=int, default=2, help="processes that keep a core busy each")
    parser.add_argument("--threads", default="", help="number of threads (default: what the product chooses)")
    parser.add_argument("--serve", nargs="+", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        what, *rest = arguments.serve
        {"policy": policy_call, "scan": scan}[what](*rest)
        return
    from vla_attention.schemas.threads import threads_of_this_process

    environment = {name: value for name, value in os.environ.items() if not name.startswith(NAMES)}
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}. {threads_of_this_process().describe()}")
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "a.zarr"
        make_store(store, episodes=10, replans=20)
        cases = {
            "policy call, torch's defaults": ["policy", "default"],
            "policy call, as vla-attention capture": ["policy", arguments.threads],
            "policy call, one thread": ["policy", "1"],
            "scan, numpy's defaults": ["scan", "default", str(store)],
            "scan, as in the Python API": ["scan", "", str(store)],
        }
        processes = {
            name: subprocess.Popen(
                [sys.executable, __file__, "--serve", *words],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for name, words in cases.items()
        }
        for process in processes.values():
            process.stdout.readline()
        seconds = {}
        for count in (0, arguments.busy):
            with beside(count):
                for _ in range(arguments.rounds):
                    for name, process in processes.items():
                        process.stdin.write("\n")
                        process.stdin.flush()
                        seconds.setdefault((name, count), []).append(float(process.stdout.readline()))
        for process in processes.values():
            process.stdin.close()
            process.wait()
    print(f"{'seconds, median (worst)':32}{'alone':>16}{f'beside {arguments.busy} busy':>18}{'times':>8}")
    for name in cases:
        alone, loaded = (seconds[name, count] for count in (0, arguments.busy))
        middle = [statistics.median(values) for values in (alone, loaded)]
        cells = [f"{statistics.median(values):.2f} ({max(values):.2f})" for values in (alone, loaded)]
        print(f"{name:32}{cells[0]:>16}{cells[1]:>18}{middle[1] / middle[0]:>8.1f}")


if __name__ == "__main__":
    main()
