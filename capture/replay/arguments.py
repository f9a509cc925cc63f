"""The arguments of `vla-capture replay`. The model's options are those of the family that `--policy` names."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from vla_attention.capture.effects.arguments import add_effect_arguments
from vla_attention.capture.engine.recording_arguments import add_recording_arguments
from vla_attention.capture.interventions.arguments import add_intervention_arguments
from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.policies.families import policy_families
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.capture.policies.model_arguments import POLICY_THREADS
from vla_attention.capture.policies.robot import NONE
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.threads import add_threads, use_threads

REPLAY_EXAMPLES = """\
  vla-attention capture replay data/so101_pick --checkpoint my/pi05_so101 --every 15 --episodes 0 1 2-5
  vla-attention capture replay lerobot/droid_100 --checkpoint gs://openpi-assets/checkpoints/pi05_droid \\
      --action action.joint_velocity action.gripper_position
  vla-attention capture replay data/so101_pick --policy my_smolvla.py --every 15
  vla-capture replay data/bimanual --checkpoint my/pi0 --camera left_wrist_0_rgb=wrist --camera right_wrist_0_rgb=none
"""


def add_replay_arguments(parser: argparse.ArgumentParser, given: Sequence[str]) -> None:
    """Add all options. given: what will be parsed; a policy among it decides the model's options."""
    families = tuple(family for family in policy_families() if family.reads_data_sets)
    parser.add_argument("data_set", metavar="DATASET", help="folder of a LeRobotDataset, or ORG/NAME of the hub")
    family = _family_among(given, families)
    parser.add_argument(
        "--policy",
        default=families[0].name,
        metavar="NAME|FILE.py",
        help=f"{listing(family.name for family in families)}, or a file with a function load(device) that returns any "
        "torch policy as a va.datasets.ReplayPolicy, see docs/data-sets.md (default: %(default)s)",
    )
    of_file = is_policy_file(_policy_among(given))
    if of_file:
        group = parser.add_argument_group("model")
        group.add_argument("--device", default="auto", help="auto (default: a GPU if there is one), cpu, cuda ...")
        add_threads(group, POLICY_THREADS)
    else:
        family.add_arguments(parser)
        parser.set_defaults(family=family)
    _add_column_arguments(parser, of_file=of_file)
    _add_frame_arguments(parser, "as the file says, else 1" if of_file else family.replan_default)
    if of_file:
        _add_change_arguments(parser)
    if not of_file:
        add_effect_arguments(parser)
    add_recording_arguments(parser, f"block indices (default: all){'' if of_file else family.layers_note}")
    _add_output_arguments(parser)
    parser.set_defaults(command=_run)


def is_policy_file(name: str) -> bool:
    """Whether a `--policy` names a file."""
    return name.endswith(".py")


def _family_among(given: Sequence[str], families: Sequence[PolicyFamily]) -> PolicyFamily:
    """Return the family that `--policy` names; the first one if nothing does, or an error comes later."""
    named = _policy_among(given)
    return next((family for family in families if family.name == named), families[0])


def _policy_among(given: Sequence[str]) -> str:
    """Return what a command line gives as `--policy`; empty for nothing."""
    named = ""
    for position, word in enumerate(given):
        if word.startswith("--policy="):
            named = word.removeprefix("--policy=")
        elif word == "--policy":
            named = " ".join(given[position + 1 : position + 2])
    return named


def check_policy_name(name: str) -> None:
    """Raise `BadArgument` unless this is a file, or the name of a family that reads data sets."""
    families = [family.name for family in policy_families() if family.reads_data_sets]
    if name not in families and not is_policy_file(name):
        raise BadArgument(f"Cannot use --policy {name}; expected {listing(families)}, or a file FILE.py.")


def _add_column_arguments(parser: argparse.ArgumentParser, *, of_file: bool) -> None:
    group = parser.add_argument_group("what the policy reads of the data set")
    if of_file:  # a family has the option itself
        group.add_argument(
            "--camera",
            action="append",
            default=[],
            metavar="POLICY=COLUMN",
            help=f"pictures of one camera of the policy; {NONE} leaves it black and masked (default: the column of "
            "the same name, or a usual one)",
        )
    group.add_argument(
        "--state",
        nargs="+",
        default=[],
        metavar="COLUMN",
        help="columns of numbers that make up the state, in this order (default: observation.state, state, or "
        "joint_position gripper_position)",
    )
    group.add_argument(
        "--action",
        nargs="+",
        default=[],
        metavar="COLUMN",
        help=f"columns of the recorded actions, which are kept beside the policy's; {NONE} keeps none (default: action "
        "or actions)",
    )
    if not of_file:
        group.add_argument(
            "--relative-actions",
            type=int,
            metavar="N",
            help="the first N numbers of openpi's actions are differences to the state (default: as its configuration "
            "says, 6 for pi0_libero, else 0)",
        )
    group.add_argument("--instruction", metavar="TEXT", help="what the policy reads instead of the data set's tasks")


def _add_frame_arguments(parser: argparse.ArgumentParser, every: str) -> None:
    group = parser.add_argument_group("which frames")
    group.add_argument(
        "--every",
        type=int,
        metavar="N",
        help=f"a policy call at frame 0, N, 2N ... of each episode (default: {every})",
    )
    group.add_argument(
        "--episode",
        dest="episodes",
        nargs="+",
        metavar="N",
        help="numbers of episodes, and ranges as 3-7 (default: all)",
    )
    group.add_argument("--num-episodes", type=int, metavar="N", help="the first N of these (default: all)")
    group.add_argument("--seed", type=int, default=7, metavar="N", help="seed of all noise (default: %(default)s)")


def _add_change_arguments(parser: argparse.ArgumentParser) -> None:
    add_intervention_arguments(parser)
    parser.add_argument(
        "--rerun-of",
        type=Path,
        metavar="BASE.zarr",
        help="the replay of the same frames without interventions, with which `vla-attention compare` then pairs the "
        "calls of this one, replan by replan",
    )


def _add_output_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("output")
    group.add_argument(
        "--output",
        dest="store",
        type=Path,
        metavar="NAME.zarr",
        help="store to write (default: runs/DATASET.zarr)",
    )
    existing = group.add_mutually_exclusive_group()
    existing.add_argument("--resume", action="store_true", help="continue an existing store with what is missing")
    existing.add_argument("--overwrite", action="store_true", help="delete an existing store first")


def _run(arguments: argparse.Namespace, termination: Termination) -> int:
    check_policy_name(arguments.policy)
    threads = use_threads(arguments.threads)  # before torch is loaded

    # Imported here: the command line's help needs neither torch nor polars.
    from vla_attention.capture.replay.command import run_replay

    return run_replay(arguments, threads, termination)
