"""What a pi0.5 of full size takes on a GPU: replan time, what recording adds, memory, and how bfloat16 differs.

Usage: python benchmarks/gpu.py [--device cuda] [--rounds 15] [--minutes 7]

It runs unattended, took three minutes on an H200, and writes benchmarks/rows/gpu.json after every part, so that a part
that fails or finds no time takes nothing from the others. The weights are random (3.35 billion parameters, the sizes of
pi05_libero; drawn on the GPU). Without a GPU it says so and ends with exit code 2.

Parts: calls in bfloat16 as they are and recorded (all layers and heads; first and last denoise step, all ten; with and
without contributions) and in the usual way, in turn; largest memory of each kind of call; the rows of bfloat16 against
those of float32 on the same weights.
"""

from __future__ import annotations

import argparse
import gc
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent)]

from capture_overhead import calls_of, make_policy, prepared_input, record_call, recording_of  # noqa: E402
from measurement import Table, measured, ratios, take_turns, write_rows  # noqa: E402

COLUMNS = {"call": "call", "ms": "ms", "times": "times the plain call", "gb": "most memory, GB"}


def timed_table(calls: dict[str, Callable[[], Any]], rounds: int, until: float, note: str) -> Table:
    """Measure calls in turn, as many rounds as there is time for, and the most memory of each."""
    import torch

    calls = {kind: call for kind, call in calls.items() if _works(kind, call)}
    memory = {}
    began = time.perf_counter()
    for kind, call in calls.items():
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        call()
        torch.cuda.synchronize()
        memory[kind] = torch.cuda.max_memory_allocated() / 2**30
    one_round = time.perf_counter() - began
    possible = int((until - time.perf_counter()) / one_round) - 2
    seconds = take_turns(calls, max(3, min(rounds, possible)), warm_up=2)
    rows = [
        {
            "call": kind,
            "ms": measured(values, 1000),
            "times": measured(ratios(values, seconds["plain"])),
            "gb": memory[kind],
        }
        for kind, values in seconds.items()
    ]
    return Table(COLUMNS, rows, note)


def _works(kind: str, call: Callable[[], Any]) -> bool:
    try:
        call()
    except RuntimeError as error:  # no memory for the whole matrices, say; the plain call must work
        if kind == "plain":
            raise
        print(f"{kind}: left out, {str(error).splitlines()[0]}", flush=True)
        return False
    return True


def parity_table(policy: Any, wide: Any) -> Table:
    """Compare a call in bfloat16 with one in float32 on the same weights."""
    import numpy as np

    recording = recording_of(policy, tuple(range(10)), True)
    found, expected = (record_call(each, prepared_input(each), recording) for each in (policy, wide))
    rows, wanted = found.rows["joint"].rows, expected.rows["joint"].rows
    shares = [
        {"what": "rows, largest difference", "value": float(np.abs(rows - wanted).max())},
        {
            "what": "rows, mean over cells of half the sum of differences",
            "value": float(np.abs(rows - wanted).sum(-1).mean() / 2),
        },
        {"what": "actions, largest difference", "value": float(np.abs(found.actions - expected.actions).max())},
        {
            "what": "sums of rows, largest distance from 1",
            "value": float(np.abs(found.rows["joint"].row_sum - 1).max()),
        },
    ]
    return Table({"what": "bfloat16 against float32", "value": "value"}, shares, "Random weights, one call.")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--minutes", type=float, default=7.0, help="no part begins after this time")
    arguments = parser.parse_args()
    import torch

    if not torch.cuda.is_available():
        print("No GPU: torch finds no CUDA device, so that nothing was measured and no row written.", file=sys.stderr)
        return 2
    end = time.perf_counter() + 60 * arguments.minutes
    half = time.perf_counter() + 30 * arguments.minutes
    policy = make_policy("full", arguments.device, "bfloat16")
    wait = torch.cuda.synchronize
    note = "bfloat16, random weights. Recorded calls end with their rows on the processor."
    print(write_rows("gpu", {"eager": timed_table(calls_of(policy, wait), arguments.rounds, half, note)}), flush=True)

    if time.perf_counter() < end:
        wide = make_policy("full", arguments.device, "float32")
        for ours, theirs in zip(wide.model.parameters(), policy.model.parameters(), strict=True):
            ours.data.copy_(theirs)
        gc.collect()
        print(write_rows("gpu", {"bfloat16": parity_table(policy, wide)}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
