"""`vla-analyze repair`: move damaged episodes out of a store, and remove what killed processes left beside it."""

from __future__ import annotations

import argparse

from vla_attention.schemas.command_line import command_parser
from vla_attention.schemas.stores.repair_command import DESCRIPTION, EXAMPLES, add_repair_arguments, run_repair


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-analyze repair STORE ...`."""
    parser = command_parser("vla-analyze repair", DESCRIPTION, EXAMPLES.replace("NAME", "vla-analyze"))
    add_repair_arguments(parser)
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Repair every store; 1 if a damaged episode is left."""
    return run_repair(arguments.stores, verify=arguments.verify, dry_run=arguments.dry_run)
