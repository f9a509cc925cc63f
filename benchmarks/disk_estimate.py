"""How far the bound that a run prints before it starts is from what it writes, by policy and precision.

Usage: python benchmarks/disk_estimate.py [--libero-assets PATH] [--policies NAME ...]

Episodes of one or two tasks are recorded at every precision, one simulator at a time. No times are measured, so other
work does not matter.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from measurement import Table, measured, write_rows

from vla_attention.capture.commands.arguments import build_parser
from vla_attention.capture.policies.policy import Policy, stored_picture_sizes
from vla_attention.capture.run.capture_run import run_capture
from vla_attention.capture.run.run_settings import run_settings
from vla_attention.capture.store.disk_estimate import estimate_disk
from vla_attention.capture.store.store_root import read_existing_root
from vla_attention.schemas.command_line import format_bytes

BITS = (4, 7, 10, 12, 23)


@dataclass(frozen=True)
class Case:
    """A policy in a suite. tasks: of the episodes. replans: most of an episode."""

    words: str
    tasks: tuple[int, ...]
    replans: int


CASES = {
    "pi05_cubes": Case("pi --task-suite cubes", (3, 12), 30),
    "pi untrained-tiny": Case("pi --checkpoint untrained-tiny --task-suite robosuite", (1, 5), 30),
    "cosmos untrained-tiny": Case("cosmos --checkpoint untrained-tiny --task-suite robosuite", (1, 5), 20),
    "pi untrained": Case("pi --checkpoint untrained --task-suite robosuite", (1,), 16),
    "pi untrained, LIBERO": Case("pi --checkpoint untrained --task-suite libero_goal", (2,), 16),
    "cosmos untrained": Case("cosmos --checkpoint untrained --task-suite robosuite", (1,), 12),
}


@dataclass(frozen=True)
class Episode:
    """What an episode of so many replans took, and the bound of it, in bytes."""

    replans: int
    written: int
    bound: int


def options(case: Case, *more: str) -> argparse.Namespace:
    """The options of a capture."""
    tasks = [str(task) for task in case.tasks]
    words = [*case.words.split(), "--task-id", *tasks, "--num-episodes", "1", "--num-envs", "1", *more]
    return build_parser(words).parse_args(words)


def record(case: Case, policy: Policy, bits: int, assets: Path | None) -> list[Episode]:
    """Record the episodes of a case at a precision."""
    with tempfile.TemporaryDirectory() as folder:
        more = ["--output", f"{folder}/a.zarr", "--precision", str(bits)]
        more += ["--max-steps", str(case.replans * policy.default_replan_steps)]
        more += ["--libero-assets", str(assets)] if assets is not None else []
        settings = run_settings(options(case, *more))
        episodes = []
        for result in run_capture(settings, policy, "cpu"):
            root = read_existing_root(settings.store)
            pictures = stored_picture_sizes(policy, root.protocol.image_size)
            bound = estimate_disk(root.recording, root.sites, pictures, result.num_replans, 1).total_bytes
            written = sum(file.stat().st_size for file in result.folder.rglob("*") if file.is_file())
            episodes.append(Episode(result.num_replans, written, bound))
        return episodes


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--libero-assets", type=Path, metavar="PATH", help="without them LIBERO is left out")
    parser.add_argument("--policies", nargs="+", choices=CASES, default=list(CASES), metavar="NAME")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.policies:
        if "LIBERO" in name and arguments.libero_assets is None:
            continue
        case = CASES[name]
        of_policy = options(case)
        policy = of_policy.family.read(of_policy).build("cpu")
        for bits in BITS:
            episodes = record(case, policy, bits, arguments.libero_assets)
            replans = sum(episode.replans for episode in episodes)
            rows.append(
                {
                    "policy": name,
                    "bits": str(bits),
                    "replans": str(max(episode.replans for episode in episodes)),
                    "written": format_bytes(sum(episode.written for episode in episodes) / replans),
                    "bound": measured([episode.bound / episode.written for episode in episodes]),
                }
            )
    columns = {
        "policy": "policy",
        "bits": "mantissa bits",
        "replans": "replans",
        "written": "written per replan",
        "bound": "printed bound / written",
    }
    write_rows("disk_estimate", {"policies": Table(columns, rows)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
