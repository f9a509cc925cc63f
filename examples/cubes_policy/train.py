"""`train`: train the small policy on demonstrations."""

from __future__ import annotations

import argparse
from pathlib import Path

from examples.cubes_policy.dataset import CONTROLS, read_demonstrations
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS
from vla_attention.schemas.errors import BadArgument


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("demonstrations", type=Path, metavar="DEMONSTRATIONS", help="folder written by `demonstrate`")
    parser.add_argument("output", type=Path, metavar="OUTPUT", help="folder for checkpoint and log.csv")
    parser.add_argument("--steps", type=int, default=6000, metavar="N", help="optimiser steps (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of weights, batches, noise (default: 0)")
    parser.add_argument("--threads", type=int, default=2, metavar="T", help="CPU threads (default: %(default)s)")
    parser.add_argument(
        "--control", default="words", choices=CONTROLS, help="what the policy can learn from (default: %(default)s)"
    )
    parser.add_argument("--tasks", type=int, metavar="N", help="learn the first N tasks of the suite (default: all)")
    parser.add_argument(
        "--resume", action="store_true", help="go on from OUTPUT's checkpoint, if there is one; --steps may be changed"
    )
    parser.add_argument(
        "--checkpoint-minutes", type=float, default=3.0, metavar="M", help="between checkpoints (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Train; returns the exit code."""
    if arguments.threads < 1:
        raise BadArgument(f"--threads is {arguments.threads}; it must be at least 1.")
    num_tasks = len(CUBE_TASKS) if arguments.tasks is None else arguments.tasks
    if not 1 <= num_tasks <= len(CUBE_TASKS):
        raise BadArgument(f"Cannot use --tasks {num_tasks}; expected 1 to {len(CUBE_TASKS)}.")
    import torch

    from examples.cubes_policy.training import TrainingSettings, train

    torch.set_num_threads(arguments.threads)
    settings = TrainingSettings(
        steps=arguments.steps,
        seed=arguments.seed,
        control=arguments.control,
        num_tasks=num_tasks,
        checkpoint_minutes=arguments.checkpoint_minutes,
    )
    instructions = tuple(task.instruction for task in CUBE_TASKS)
    demonstrations = read_demonstrations(arguments.demonstrations)
    training = train(demonstrations, instructions, arguments.output, settings, resume=arguments.resume, say=_say)
    _say(f"{training.step} steps are done; {arguments.output} has checkpoint.pt and log.csv.")
    _say(f"Next: python -m examples.cubes_policy export {arguments.output} FOLDER")
    return 0


def _say(line: str) -> None:
    print(line, flush=True)
