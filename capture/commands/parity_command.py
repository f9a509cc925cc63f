"""`vla-attention capture parity CASE`: compare a policy with what a reference implementation computed."""

from __future__ import annotations

import argparse

from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.policies.families import policy_families
from vla_attention.capture.policies.family import ParityCases
from vla_attention.schemas.errors import listing
from vla_attention.schemas.threads import use_threads


def run_parity_command(arguments: argparse.Namespace, termination: Termination) -> int:
    """Run a case with the family that recognises it; returns 0 within the limits, 1 beyond them."""
    from vla_attention.capture.machine.device import load_torch

    device = load_torch(arguments.device, use_threads(arguments.threads).number)
    return _cases_of(arguments).run(arguments, device)


def _cases_of(arguments: argparse.Namespace) -> ParityCases:
    """Return the cases of the family that recognises the case; `UnusableCase` if none does."""
    from vla_attention.capture.policies.parity_case import CASE_FILE, UnusableCase, read_case_file

    content = read_case_file(arguments.case)
    families = [family for family in policy_families() if family.parity is not None]
    for family in families:
        if family.parity is not None and family.parity.recognises(content):
            return family.parity
    raise UnusableCase(
        f"'{arguments.case / CASE_FILE}' describes no case of a policy that is known here "
        f"({listing(family.title for family in families)}); it states {listing(sorted(content))}."
    )
