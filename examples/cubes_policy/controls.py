"""`controls`: demonstrations, trainings and checkpoints of all policies whose dependence is known, one by one."""

from __future__ import annotations

import argparse
from pathlib import Path

from examples.cubes_policy import demonstrate, train
from examples.cubes_policy.dataset import CONTROLS, find_control
from vla_attention.schemas.errors import BadArgument

#: Folder of the trainings, beside the checkpoints.
TRAININGS = "trainings"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `controls`; the defaults are those of docs/validation.md."""
    parser.add_argument("demonstrations", type=Path, metavar="DEMONSTRATIONS", help="folder; what is missing is made")
    parser.add_argument("policies", type=Path, metavar="POLICIES", help="folder for a checkpoint of each training")
    parser.add_argument(
        "--controls", nargs="+", default=list(CONTROLS), metavar="NAME", help=f"default: {' '.join(CONTROLS)}"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], metavar="S", help="default: 0 1 2")
    parser.add_argument("--parts", type=int, default=50, metavar="N", help="parts of demonstrations (default: 50)")
    parser.add_argument("--steps", type=int, default=900, metavar="N", help="of each training (default: 900)")
    parser.add_argument("--tasks", type=int, default=12, metavar="N", help="learn the first N tasks (default: 12)")
    parser.add_argument("--threads", type=int, default=1, metavar="T", help="CPU threads (default: 1)")


def run(arguments: argparse.Namespace) -> int:
    """Make what is missing, and go on with a training that was stopped; returns the exit code."""
    from examples.cubes_policy import export  # loads torch, which --help does without

    wanted = [(find_control(control), seed) for control in arguments.controls for seed in arguments.seeds]
    if min(arguments.seeds) < 0:
        raise BadArgument(f"--seeds has {min(arguments.seeds)}; it must be at least 0.")
    made = argparse.Namespace(demonstrations=arguments.demonstrations, parts=arguments.parts, workers=2, seed=0)
    code = demonstrate.run(made)
    if code:
        return code
    for number, (control, seed) in enumerate(wanted, start=1):
        name = f"{control}_{seed}"
        folder = arguments.policies / name
        print(f"[{number}/{len(wanted)}] {folder}{' is there' if folder.exists() else ''}", flush=True)
        if folder.exists():
            continue
        training = arguments.policies / TRAININGS / name
        train.run(
            argparse.Namespace(
                demonstrations=arguments.demonstrations,
                output=training,
                steps=arguments.steps,
                seed=seed,
                threads=arguments.threads,
                control=control,
                tasks=arguments.tasks,
                resume=True,
                new_demonstrations=False,
                checkpoint_minutes=3.0,
            )
        )
        export.run(argparse.Namespace(training=training, folder=folder, name=f"cubes_{control}_seed{seed}"))
    print(
        f"Next: python -m benchmarks.validation {arguments.policies} --shipped pi05_cubes --replans 2 --work DIR "
        "(in a checkout)"
    )
    return 0
