"""The options that say what is recorded of each policy call. Every `--help` imports this module, and nothing heavy."""

from __future__ import annotations

import argparse
from typing import Any

from vla_attention.schemas.options import Numbers, number_range
from vla_attention.schemas.precision import DEFAULT_MANTISSA_BITS


def add_recording_arguments(parser: argparse.ArgumentParser, layers: str, *, rerun: bool = False) -> None:
    """Add the group. layers: help text of `--layers`. rerun: the defaults are those of the store that is run again."""

    def default(text: str) -> str:
        return "" if rerun else f" (default: {text})"

    group = parser.add_argument_group(f"what is recorded{' (default: as in the store)' if rerun else ''}")
    numbers: dict[str, Any] = {"type": number_range, "nargs": "+", "action": Numbers, "metavar": "N"}
    group.add_argument("--layers", **numbers, help=layers)
    group.add_argument(
        "--denoise",
        dest="denoise_steps",
        nargs="+",
        metavar="STEP",
        help=f"numbers, first, last or all{default('first last')}",
    )
    group.add_argument("--heads", **numbers, help=f"attention heads{default('all')}")
    group.add_argument(
        "--queries",
        default="mean",
        help=f"mean over the action queries{'' if rerun else ' (default)'}, steps (one mean per action step), or all",
    )
    bound = "which bounds the error of every ratio by 0.1 %%"
    group.add_argument(
        "--precision",
        metavar="BITS",
        help="mantissa bits kept of each probability, or 'exact'" + default(f"{DEFAULT_MANTISSA_BITS}, {bound}"),
    )
    group.add_argument(
        "--contributions",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="also record what each part of the keys adds to the residual stream, value-weighted" + default("yes"),
    )
    group.add_argument("--no-frames", action="store_true", help="do not store the model's input images")
