"""What a pi0.5 of full size takes on a GPU: replan time, what recording adds, memory, and how bfloat16 differs.

Usage: python benchmarks/gpu.py [--device cuda] [--size full] [--rounds 15] [--minutes 9]

It runs unattended and writes benchmarks/rows/gpu.json after every part, so that a part that fails or finds no time
takes nothing from the others. The weights are random (3.35 billion parameters, the sizes of pi05_libero; drawn on the
GPU). Without a GPU it says so and ends with exit code 2; `--device cpu --size small` tries the script itself, and
writes nothing.

Parts: calls in bfloat16 as they are and recorded (all layers and heads; first and last denoise step, all ten; with and
without contributions) and in the usual way, in turn, with the largest memory of each kind; the same with compiled
denoise steps; batches of 1 and 8; effects of 14 items and of all words and cameras; the rows of bfloat16 against those
of float32 on the same weights.
"""

from __future__ import annotations

import argparse
import gc
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent)]

from capture_overhead import USUAL, calls_of, make_policy, prepared_input, record_call, recording_of  # noqa: E402
from effects import forget_peak, full_size_table, largest_memory  # noqa: E402
from measurement import Table, measured, ratios, take_turns, write_rows  # noqa: E402

COLUMNS = {"call": "call", "ms": "ms", "times": "times the plain call", "gb": "most memory, GB"}


def timed_table(calls: dict[str, Callable[[], Any]], rounds: int, until: float, note: str, device: str) -> Table:
    """Measure calls in turn, as many rounds as there is time for, and the most memory of each."""
    calls = {kind: call for kind, call in calls.items() if _works(kind, call)}
    memory = {}
    began = time.perf_counter()
    for kind, call in calls.items():
        forget_peak(device)
        call()
        memory[kind] = largest_memory(device) / 2**30
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


def batched_calls(policy: Any, wait: Callable[[], None]) -> dict[str, Callable[[], Any]]:
    """Return calls of one row and of eight, as they are and recorded."""
    from vla_attention.capture.engine.call import Caller, PolicyCall
    from vla_attention.capture.interventions.changed_inputs import CallContext

    given, recording = prepared_input(policy), recording_of(policy, (0, 9), True)

    def plain(count: int) -> Any:
        actions = policy.act(given, 0) if count == 1 else policy.act_batch([given] * count, range(count), [{}] * count)
        wait()
        return actions

    def recorded(count: int) -> Any:
        calls = [PolicyCall(given, seed, CallContext(0, seed, 0), 0, "the benchmark") for seed in range(count)]
        made = Caller(policy, recording).make(calls)
        wait()
        return made

    return {
        "plain": partial(plain, 1),
        "8 in a batch": partial(plain, 8),
        "recorded": partial(recorded, 1),
        "8 in a batch, recorded": partial(recorded, 8),
    }


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
    parser.add_argument("--size", choices=("small", "full"), default="full")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--minutes", type=float, default=9.0, help="no part begins after this time")
    arguments = parser.parse_args()
    import torch

    device, dtype = arguments.device, "bfloat16" if arguments.size == "full" else "float32"
    if device.startswith("cuda") and not torch.cuda.is_available():
        print("No GPU: torch finds no CUDA device, so that nothing was measured and no row written.", file=sys.stderr)
        return 2
    wait = torch.cuda.synchronize if device.startswith("cuda") else lambda: None
    began, note = time.perf_counter(), f"{dtype}, random weights. Recorded calls end with their rows on the processor."
    policy = make_policy(arguments.size, device, dtype)

    def timed(calls: dict[str, Callable[[], Any]], share: float, also: str = "") -> Table:
        return timed_table(calls, arguments.rounds, began + 60 * share * arguments.minutes, note + also, device)

    def compiled() -> Table:
        policy.compile_steps()
        calls = calls_of(policy, wait)
        del calls[USUAL]  # it would be another graph
        first = time.perf_counter()
        calls["plain"]()
        also = f" Denoise steps compiled; the first call took {time.perf_counter() - first:.0f} s."
        try:
            return timed(calls, 0.6, also)
        finally:
            policy.model.compiled = None

    def parity() -> Table:
        wide = make_policy(arguments.size, device, "float32")
        for ours, theirs in zip(wide.model.parameters(), policy.model.parameters(), strict=True):
            ours.data.copy_(theirs)
        gc.collect()
        return parity_table(policy, wide)

    parts: dict[str, Callable[[], Table]] = {
        "eager": lambda: timed(calls_of(policy, wait), 0.3),
        "compiled": compiled,
        "batches": lambda: timed(batched_calls(policy, wait), 0.8),
        "effects": lambda: full_size_table(device, torch.get_num_threads(), policy),
        "bfloat16": parity,
    }
    for name, part in parts.items():
        if time.perf_counter() > began + 60 * arguments.minutes:
            break
        table = part()
        if device.startswith("cuda"):
            print(write_rows("gpu", {name: table}), flush=True)
        else:
            print(name, *table.rows, sep="\n", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
