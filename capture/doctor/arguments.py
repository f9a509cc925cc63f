"""The arguments of `vla-attention capture doctor`: those of the capture that is described, and `--accept`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.policies.families import default_family, policy_families
from vla_attention.capture.policies.family import PolicyFamily

DOCTOR_EXAMPLES = """\
  vla-attention capture doctor                                    this machine, for a run of the policy that comes along
  vla-capture doctor pi --checkpoint gs://openpi-assets/checkpoints/pi05_libero --task-suite libero_10 --budget 20GB
  vla-attention capture doctor --no-trial --task-suite libero_10       look only: loads no policy, runs no simulator
  vla-attention capture doctor --accept pi05_cubes                 ten episodes, held against the published success rate
"""


def add_doctor_arguments(
    parser: argparse.ArgumentParser,
    given: Sequence[str],
    add_capture_arguments: Callable[[argparse.ArgumentParser, PolicyFamily], None],
) -> None:
    """Add all options. given: what will be parsed; a policy among it decides the model's options.

    add_capture_arguments: adds the options of a capture with a family.
    """
    families = policy_families()
    default = default_family()
    family = next((family for word in given for family in families if family.name == word), default)
    parser.add_argument(
        "policy",
        nargs="?",
        choices=[family.name for family in families],
        default=default.name,
        metavar="POLICY",
        help=f"{', '.join(family.name for family in families)} (default: {default.name}), then the options of the run",
    )
    group = parser.add_argument_group("doctor")
    group.add_argument(
        "--accept",
        metavar="CHECKPOINT",
        help="run this checkpoint on ten episodes, or --num-episodes of each of as many tasks, and hold its success "
        "against the published rate; exit code 1 when it solves too few",
    )
    group.add_argument(
        "--published-rate",
        type=float,
        metavar="SHARE",
        help="with --accept: the rate of a checkpoint that is not known",
    )
    group.add_argument("--no-trial", action="store_true", help="load no policy and run no simulator: look only")
    add_capture_arguments(parser, family)
    # A suite that nobody typed is that of the published rate, and with --accept there are ten episodes.
    parser.set_defaults(
        command=_run,
        family=family,
        task_suite=None,
        num_episodes=None,
        episodes_of_a_run=parser.get_default("num_episodes"),
    )


def _run(arguments: argparse.Namespace, termination: Termination) -> int:
    from vla_attention.capture.doctor.command import run_doctor

    return run_doctor(arguments, termination)
