"""`vla-attention capture doctor`: a line for everything that a run needs. Nothing is loaded or simulated."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.policies.families import default_family, policy_families
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.schemas.errors import INSTALL_CAPTURE
from vla_attention.schemas.safe_text import print_line
from vla_attention.schemas.threads import use_threads

if TYPE_CHECKING:
    from vla_attention.capture.doctor.checks import Finding

DOCTOR_EXAMPLES = """\
  vla-attention capture doctor                                    this machine, for a run of the policy that comes along
  vla-attention capture doctor pi --checkpoint gs://openpi-assets/checkpoints/pi05_libero --task-suite libero_10
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
    add_capture_arguments(parser, family)
    parser.set_defaults(command=run_doctor, family=family)


def run_doctor(arguments: argparse.Namespace, termination: Termination) -> int:
    """Print a line for everything that the run needs; returns 1 when something of it is missing, otherwise 0."""
    missing = []
    for finding in _findings(arguments):
        print_line(finding.describe())
        if finding.status == "missing":
            missing.append(finding.what)
    if missing:
        print(f"\nThe run cannot be made as described: {', '.join(missing)}.")
        return 1
    print("\nNothing is missing for the run.")
    return 0


def _findings(arguments: argparse.Namespace) -> Iterator[Finding]:
    threads = use_threads(arguments.threads)

    from vla_attention.capture.doctor.checks import (
        Finding,
        find_checkpoint,
        find_disk,
        find_drawing,
        find_gpu,
        find_memory,
        find_simulator,
    )
    from vla_attention.capture.run.run_settings import run_settings

    settings = run_settings(arguments)
    yield find_memory(threads)
    simulator = find_simulator(settings.suite, settings.libero_assets)
    yield from simulator
    if any(finding.status == "missing" for finding in simulator):
        yield Finding("drawing", "note", "Not tried before what is missing is there.")
    else:
        yield find_drawing(settings.suite, settings.libero_assets)
    yield find_disk(settings)
    try:
        import torch
    except ImportError as error:
        yield Finding("torch", "missing", f"torch cannot be loaded ({error}).", f"Install it: {INSTALL_CAPTURE}.")
        return  # what reads checkpoints needs it
    yield find_gpu(arguments.device, torch)
    yield find_checkpoint(arguments)
