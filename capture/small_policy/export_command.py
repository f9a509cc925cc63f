"""`export`: write a training's averaged weights as a checkpoint folder."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("training", type=Path, metavar="OUTPUT", help="folder of `train`, also while it runs")
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="new folder for vla-capture pi --checkpoint")
    parser.add_argument("--name", metavar="NAME", help="name of the policy in stores (default: that of FOLDER)")


def run(arguments: argparse.Namespace) -> int:
    """Export; returns the exit code."""
    from vla_attention.capture.small_policy.export import export

    name = arguments.name or arguments.folder.absolute().name
    card = export(arguments.training, arguments.folder, name)
    print(
        f"{arguments.folder}: {card['parameters']:,} parameters after {card['steps']} steps, control {card['control']}"
    )
    print(f"Next: python -m vla_attention.capture.small_policy evaluate {arguments.folder}")
    return 0
