"""The arguments of `capture replay`. The model's options are those of the family that `--policy` names."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_attention.capture.effects.arguments import add_effect_options
from vla_attention.capture.engine.settings import RecordingSettings, StoreOutput
from vla_attention.capture.interventions.arguments import InterventionSettings
from vla_attention.capture.policies.families import policy_families
from vla_attention.capture.policies.family import ModelSettings, PolicyFamily
from vla_attention.capture.policies.robot import NONE
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.options import add_options, option
from vla_attention.schemas.stop_signals import Termination
from vla_attention.schemas.threads import use_threads

REPLAY_EXAMPLES = """\
  vla-attention capture replay data/so101_pick --checkpoint my/pi05_so101 --every 15 --episode 0 1 2-5
  vla-attention capture replay lerobot/droid_100 --checkpoint gs://openpi-assets/checkpoints/pi05_droid \\
      --action action.joint_velocity action.gripper_position
  vla-attention capture replay data/so101_pick --policy my_smolvla.py --every 15
  vla-attention capture replay data/bimanual --checkpoint my/pi0 --camera left_wrist_0_rgb=wrist \\
      --camera right_wrist_0_rgb=none
"""


@dataclass(frozen=True)
class ReplaySettings:
    """Which frames of a data set a policy is called on, and what it reads of them.

    state, action: none where they are found by their usual names. every: None takes the policy's number. instruction:
    None takes the data set's tasks.
    """

    camera: tuple[str, ...] = option(
        f"pictures of one camera of the policy; {NONE} leaves it black and masked (default: the column of the same "
        "name, or a usual one)",
        (),
        group="what the policy reads of the data set",
        action="append",
        metavar="POLICY=COLUMN",
    )
    state: tuple[str, ...] = option(
        "columns of numbers that make up the state, in this order (default: observation.state, state, or "
        "joint_position gripper_position)",
        (),
        metavar="COLUMN",
    )
    action: tuple[str, ...] = option(
        f"columns of the recorded actions, which are kept beside the policy's; {NONE} keeps none (default: action or "
        "actions)",
        (),
        metavar="COLUMN",
    )
    relative_actions: int | None = option(
        "the first N numbers of openpi's actions are differences to the state (default: as its configuration says, 6 "
        "for pi0_libero, else 0)",
        None,
    )
    instruction: str | None = option("what the policy reads instead of the data set's tasks", None, metavar="TEXT")
    every: int | None = option(
        "a policy call at frame 0, N, 2N ... of each episode (default: as the file says, else 1)",
        None,
        group="which frames",
        least=1,
    )
    episodes: tuple[int, ...] | None = option(
        "numbers of episodes, and ranges as 3-7 (default: all)", None, name="episode", dest="episodes"
    )
    num_episodes: int | None = option("the first N of these (default: all)", None, least=1)
    seed: int = option("seed of all noise (default: %(default)s)", 7, least=0)


@dataclass(frozen=True)
class ReplayOutput(StoreOutput):
    """Where the store goes, and which one it is compared with."""

    rerun_of: Path | None = option(
        "the replay of the same frames without interventions, with which `vla-attention compare` then pairs the calls "
        "of this one, policy call by policy call",
        None,
        metavar="BASE.zarr",
    )


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
        "torch policy as a va.datasets.ReplayPolicy, see docs/my-data-set.md (default: %(default)s)",
    )
    place = "the store, NAME.zarr, or a folder for it (default: runs/DATASET.zarr)"
    if is_policy_file(_policy_among(given)):
        add_options(parser, ModelSettings, checkpoint=None, config_name=None, dtype=None)
        add_options(parser, ReplaySettings, relative_actions=None)
        add_options(parser, InterventionSettings)
        add_options(parser, RecordingSettings)
        add_options(parser, ReplayOutput, store=place)
    else:
        every = f"a policy call at frame 0, N, 2N ... of each episode (default: {family.replan_default})"
        add_options(parser, family.settings)
        add_options(parser, ReplaySettings, camera=None, every=every)  # the family has a --camera
        add_effect_options(parser)
        add_options(parser, RecordingSettings, layers=f"block indices (default: all){family.layers_note}")
        add_options(parser, ReplayOutput, store=place, rerun_of=None)
    parser.set_defaults(command=_run, family=family)


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


def _run(arguments: argparse.Namespace, termination: Termination) -> int:
    check_policy_name(arguments.policy)
    threads = use_threads(arguments.threads)  # before torch is loaded

    # Imported here: the command line's help needs neither torch nor polars.
    from vla_attention.capture.replay.command import run_replay

    return run_replay(arguments, threads, termination)
