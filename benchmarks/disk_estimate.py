"""How far the estimate of `--budget` and `vla-capture doctor` is from what is written, by policy and precision.

Usage: python benchmarks/disk_estimate.py [--libero-assets PATH] [--policies NAME ...]

For each policy the first 8 replans of two or three tasks are tried, as `--budget` does. Then longer episodes of other
tasks are rolled out and written at every precision by the store's own writer; the ratio is estimate / written. The
bound is the one that a run prints without `--budget`. No times are measured, so other work does not matter.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from measurement import Table, measured, write_rows

from vla_attention.capture.budget.trial import run_trial
from vla_attention.capture.commands.arguments import build_parser
from vla_attention.capture.environments.base import EnvironmentSettings
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.policies.policy import stored_picture_sizes
from vla_attention.capture.run.capture_run import plan_run
from vla_attention.capture.run.run_settings import run_settings
from vla_attention.capture.store.disk_estimate import SampleOfReplans, estimate_disk, mean_size
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.interventions import Interventions

BITS = (4, 7, 10, 12, 23)


@dataclass(frozen=True)
class Case:
    """A policy in a suite; `tried` are the tasks of the trial, `written` those of the longer episodes."""

    words: str
    tried: tuple[int, ...]
    written: tuple[int, ...]
    replans: int


CASES = {
    "pi05_cubes": Case("pi --task-suite cubes", (0, 8, 16), (3, 12), 30),
    "pi untrained-tiny": Case("pi --checkpoint untrained-tiny --task-suite robosuite", (0, 4, 7), (1, 5), 30),
    "cosmos untrained-tiny": Case("cosmos --checkpoint untrained-tiny --task-suite robosuite", (0, 4, 7), (1, 5), 20),
    "pi untrained": Case("pi --checkpoint untrained --task-suite robosuite", (0, 7), (1,), 16),
    "pi untrained, LIBERO": Case("pi --checkpoint untrained --task-suite libero_goal", (0, 9), (2,), 16),
    "cosmos untrained": Case("cosmos --checkpoint untrained --task-suite robosuite", (0, 7), (1,), 12),
}


def samples_of(case: Case, assets: Path | None) -> tuple[list[SampleOfReplans], list[SampleOfReplans], list[int]]:
    """Return the replans of the trial, those of the longer episodes, and the bytes of the pictures of a call."""
    arguments = build_parser().parse_args([*case.words.split(), "--output", "none.zarr"])
    settings = run_settings(arguments)
    policy = arguments.family.build(arguments, "cpu")
    plan = plan_run(settings, policy, {"made": "by a benchmark"})
    attributes, tasks, environment = plan.attributes, plan.tasks, EnvironmentSettings(plan.evaluation, assets)

    def sample(task: int, **options: int) -> SampleOfReplans:
        changes = RunChanges(Interventions(), {})
        return run_trial(policy, attributes, tasks[task], environment, changes, **options).sample

    tried = [sample(task) for task in case.tried]
    written = [sample(task, most_replans=case.replans) for task in case.written]
    return tried, written, stored_picture_sizes(policy, attributes.protocol.image_size)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--libero-assets", type=Path, metavar="PATH", help="without them LIBERO is left out")
    parser.add_argument("--policies", nargs="+", choices=CASES, default=list(CASES), metavar="NAME")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.policies:
        if "LIBERO" in name and arguments.libero_assets is None:
            continue
        tried, written, pictures = samples_of(CASES[name], arguments.libero_assets)
        replans = len(written[0].records)
        for bits in BITS:
            recording = replace(tried[0].attributes.recording, mantissa_bits=bits)
            expected = mean_size([sample.size(recording) for sample in tried]).bytes_of(replans)
            real = [sample.bytes_written(recording) for sample in written]
            bound = estimate_disk(recording, tried[0].attributes.sites, pictures, replans, 1).total_bytes
            rows.append(
                {
                    "policy": name,
                    "bits": str(bits),
                    "replans": str(replans),
                    "written": format_bytes(sum(real) / len(real) / replans),
                    "ratio": measured([expected / size for size in real]),
                    "bound": measured([bound / size for size in real]),
                }
            )
            print(name, bits, [round(expected / size, 3) for size in real], round(bound / real[0], 2), flush=True)
    columns = {
        "policy": "policy",
        "bits": "mantissa bits",
        "replans": "replans",
        "written": "written per replan",
        "ratio": "measured estimate / written",
        "bound": "printed bound / written",
    }
    write_rows("disk_estimate", {"policies": Table(columns, rows)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
