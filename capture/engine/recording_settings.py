"""What is recorded of each policy call. Every `--help` imports this module, and nothing heavy."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Literal

from vla_attention.capture.effects.arguments import EffectSettings, effect_settings
from vla_attention.schemas.options import option, read_options
from vla_attention.schemas.precision import DEFAULT_MANTISSA_BITS, parse_precision


@dataclass(frozen=True)
class RecordingSettings:
    """What is recorded of each policy call; None means everything."""

    layers: tuple[int, ...] | None = option("block indices (default: all)", None, group="what is recorded")
    denoise_steps: tuple[int | str, ...] = option(
        "numbers, first, last or all (default: first last)", ("first", "last"), name="denoise", metavar="STEP"
    )
    heads: tuple[int, ...] | None = option("attention heads (default: all)", None)
    queries: Literal["mean", "steps", "all"] = option(
        "mean over the action queries, steps (one mean per action step), or all (default: mean)", "mean"
    )
    mantissa_bits: int = option(
        "mantissa bits kept of each probability, or 'exact' (default: %(default)s, which bounds the error of every "
        "ratio by 0.1 %%)",
        DEFAULT_MANTISSA_BITS,
        name="precision",
        type=str,
        metavar="BITS",
    )
    contributions: bool = option(
        "also record what each part of the keys adds to the residual stream, value-weighted (default: yes)", True
    )
    frames: bool = option("also store the model's input images (default: yes)", True)
    effects: EffectSettings | None = None


def recording_settings(given: argparse.Namespace) -> RecordingSettings:
    """Return what parsed arguments say, effects included."""
    bits = parse_precision(str(given.precision))
    return read_options(RecordingSettings, given, mantissa_bits=bits, effects=effect_settings(given))
