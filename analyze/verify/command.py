"""`vla-attention verify`: read everything back and check it, and with --repair move damaged episodes aside."""

from __future__ import annotations

import argparse

from vla_attention.analyze.arguments import add_workers
from vla_attention.schemas.command_line import command_parser
from vla_attention.schemas.stores.verify_command import DESCRIPTION, EXAMPLES, add_verify_arguments, run_verify_command


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention verify STORE ...`."""
    parser = command_parser("vla-attention verify", DESCRIPTION, EXAMPLES.replace("NAME", "vla-attention"))
    add_verify_arguments(parser)
    add_workers(parser)
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Verify every store; 1 if anything is wrong, or with --repair if a damaged episode is left."""
    from vla_attention.analyze.stores.checking import reports_of_store

    return run_verify_command(arguments, reports_of_store)
