"""The arguments of `capture rerun`. The model's options are those of the family whose policy the store has."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.capture.effects.arguments import add_effect_options
from vla_attention.capture.engine.settings import RecordingSettings, StoreOutput
from vla_attention.capture.interventions.arguments import InterventionSettings
from vla_attention.capture.policies.families import family_of_kind
from vla_attention.schemas.errors import BadArgument, UnknownName, UserError
from vla_attention.schemas.options import add_options, option, task_option
from vla_attention.schemas.stop_signals import Termination
from vla_attention.schemas.threads import use_threads

if TYPE_CHECKING:
    from vla_attention.capture.policies.family import PolicyFamily
    from vla_attention.schemas.stores.store_format import RootAttributes

RERUN_EXAMPLES = """\
  vla-attention capture rerun runs/libero_10.zarr              how far the calls of one episode are from the stored ones
  vla-attention capture rerun runs/libero_10.zarr --knockout camera:base_0_rgb       without one camera
  vla-attention capture rerun runs/libero_10.zarr --keep role:instruction        with the words of the instruction alone
  vla-attention capture rerun runs/libero_10.zarr --prompt empty --image left_wrist_0_rgb=blank
  vla-attention capture rerun runs/libero_10.zarr --effects text,grouping:default    every word and group, with controls
  vla-attention capture rerun runs/libero_10.zarr --prompts standard                 other sentences, by what they say
  vla-attention capture rerun runs/libero_10.zarr --output more.zarr --layers 0 1 2 --queries all
"""


@dataclass(frozen=True)
class RerunSettings:
    """Which calls of a store are made again."""

    tasks: tuple[int | str, ...] | None = task_option("tasks of the store", group="which policy calls")
    num_episodes: int | None = option("the first N episodes of each task (default: all)", None, least=1)
    check: int | None = option(
        "policy calls of the first episode that are made again unchanged before anything else (default: all of them; "
        "0: none)",
        None,
        least=0,
    )


@dataclass(frozen=True)
class RerunOutput(StoreOutput):
    """Where the store goes, and what its condition is called."""

    name: str = option("name of the condition, for tables (default: made of the options)", "")


def add_rerun_arguments(parser: argparse.ArgumentParser, given: Sequence[str]) -> None:
    """Add all options. given: what will be parsed; a store among it decides the model's options and the defaults."""
    parser.add_argument(
        "base", type=_existing_store, metavar="STORE", help="NAME.zarr; with it, --help lists the model's options too"
    )
    root = _root_among(given)
    if root is not None:
        _refuse_own_loop(root)
        family = _family_of(root)
        add_options(parser, family.settings)
        parser.set_defaults(**family.settings.of_store(root.policy), family=family)
    add_options(parser, InterventionSettings)
    add_options(parser, RerunSettings)
    add_options(parser, RecordingSettings, defaults="as in the store")
    add_effect_options(parser)
    if root is not None:
        _take_recording_of(root, parser)
    place = "the store to write, NAME.zarr (default: beside the base, with the name of the condition)"
    add_options(parser, RerunOutput, store=place)
    parser.set_defaults(command=_run)


def _refuse_own_loop(root: RootAttributes) -> None:
    """Raise `BadArgument` for a store that was recorded from the caller's own code."""
    if root.protocol.name == "recorded":
        raise BadArgument(
            f"Cannot rerun a store that va.record made: the policy '{root.policy.name}' is called by your own code. "
            "Run that again with va.record(..., interventions=va.knockout(...)) into another store; vla-attention "
            "compare pairs the two."
        )


def _family_of(root: RootAttributes) -> PolicyFamily:
    """Return the family that loads a store's policy; `BadArgument` for policies of the caller's own code."""
    try:
        return family_of_kind(root.policy.family)
    except UnknownName:
        raise BadArgument(
            f"Cannot rerun a store of '{root.policy.family}', a policy of the caller's own code, which vla-attention "
            "cannot load; use vla-attention capture replay DATASET --policy FILE.py --knockout SELECTOR --rerun-of "
            "STORE, or va.record(..., interventions=va.knockout(SELECTOR)) (docs/my-policy.md)."
        ) from None


def _existing_store(text: str) -> Path:
    from vla_attention.schemas.stores.root import read_root

    try:
        read_root(Path(text))
    except UserError as error:
        raise argparse.ArgumentTypeError(str(error).removesuffix(".")) from None
    return Path(text)


def _root_among(given: Sequence[str]) -> RootAttributes | None:
    """Return the attributes of the first store among the words of a command line; None if there is none."""
    for word in given:
        if not word.startswith("-") and (Path(word) / "zarr.json").is_file():
            from vla_attention.schemas.stores.root import read_root

            try:
                return read_root(Path(word))
            except UserError:
                continue  # the argument's own error says why
    return None


def _take_recording_of(root: RootAttributes, parser: argparse.ArgumentParser) -> None:
    recording = root.recording
    parser.set_defaults(
        layers=list(recording.layer_labels),
        denoise=[str(step) for step in recording.denoise_steps],
        heads=list(recording.heads),
        queries=recording.queries,
        precision=str(recording.mantissa_bits),
        contributions=recording.contributions,
    )


def _run(arguments: argparse.Namespace, termination: Termination) -> int:
    threads = use_threads(arguments.threads)  # before torch is loaded

    from vla_attention.capture.rerun.command import run_rerun

    return run_rerun(arguments, threads, termination)
