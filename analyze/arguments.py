"""Command-line arguments of `vla-analyze`."""

from __future__ import annotations

import argparse
from pathlib import Path

from schemas.command_line import OneSentenceParser

_EXAMPLES = """examples:
  vla-analyze runs/libero_10.zarr
  vla-analyze runs/libero_10.zarr --list
  vla-analyze runs/libero_10.zarr --grouping cameras --layers 25 26 27
  vla-analyze runs/libero_10.zarr --group bowl='object:akita_black_bowl_1' --group noun=word:bowl --ratio bowl/noun
  vla-analyze verify runs/libero_10.zarr
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-analyze STORE ...`."""
    parser = OneSentenceParser(
        prog="vla-analyze",
        description="Masses, fractions and ratios from stored attention rows, for any grouping of tokens. Without the model.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("stores", nargs="+", type=Path, metavar="STORE", help="one or several NAME.zarr")
    parser.add_argument(
        "--list", action="store_true", help="say what the stores hold (layout, words, objects) and stop"
    )
    grouping = parser.add_argument_group("grouping")
    grouping.add_argument(
        "--grouping",
        metavar="NAME|FILE",
        help="default, instruction, cameras, objects, reference, or a TOML file (default: default)",
    )
    grouping.add_argument(
        "--group",
        action="append",
        default=[],
        metavar="NAME=SELECTOR",
        help="a group of your own; may be repeated. Added to --grouping if that is given, else the rest is one more group",
    )
    grouping.add_argument("--ratio", metavar="A,B/C", help="groups of the ratio's numerator and denominator")
    chosen = parser.add_argument_group("selection")
    chosen.add_argument(
        "--site", metavar="NAME", help="softmax family: joint (pi), self or cross (Cosmos); default: the first one"
    )
    chosen.add_argument("--layers", type=int, nargs="+", metavar="N", help="layers (default: all recorded)")
    chosen.add_argument(
        "--denoise", nargs="+", metavar="STEP", help="denoise steps, first, last or all (default: all recorded)"
    )
    chosen.add_argument("--heads", type=int, nargs="+", metavar="N", help="heads (default: all recorded)")
    chosen.add_argument("--per-head", action="store_true", help="keep heads apart in the steps table")
    chosen.add_argument("--tasks", type=int, nargs="+", metavar="N", help="task ids (default: all)")
    output = parser.add_argument_group("output")
    output.add_argument("--output", type=Path, metavar="PATH", help="folder (default: results/STORE/GROUPING)")
    output.add_argument("--save-viz", action="store_true", help="also a picture per episode and layer")
    output.add_argument("--no-plots", action="store_true", help="numbers only")
    output.add_argument("--seed", type=int, default=0, help="seed of the bootstrap (default: 0)")
    return parser


def build_verify_parser() -> argparse.ArgumentParser:
    """The parser of `vla-analyze verify STORE ...`."""
    parser = OneSentenceParser(
        prog="vla-analyze verify",
        description="Read everything back and check counts, missing chunks, digests and row sums. Exit code 1 if anything is wrong.",
    )
    parser.add_argument("stores", nargs="+", type=Path, metavar="STORE", help="one or several NAME.zarr")
    return parser
