"""The options that say which effects are measured. Every `--help` imports this module, and nothing heavy."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import cast, get_args

from vla_attention.schemas.effects import EffectItems, EffectReaders
from vla_attention.schemas.errors import BadArgument, did_you_mean, listing
from vla_attention.schemas.stores.store_url import StorePlace, store_place

NO_EFFECTS = "none"
DEFAULT_READERS: tuple[EffectReaders, ...] = ("all", "action")
_OPTIONS = ("every", "readers", "steps", "pictures")


@dataclass(frozen=True)
class EffectSettings:
    """Which effects are measured; see `EffectsRecorded`. denoise_steps: None takes those of the policy.

    pictures: the store of whose pictures cameras get the mean; None: in a rerun that of the base, else grey.
    """

    items: tuple[EffectItems, ...]
    readers: tuple[EffectReaders, ...] = DEFAULT_READERS
    every: int = 1
    denoise_steps: int | None = None
    pictures: StorePlace | None = None

    def __post_init__(self) -> None:
        """Check the words and numbers, and bring the words into their order."""
        for name, known in (("items", get_args(EffectItems)), ("readers", get_args(EffectReaders))):
            words = list(getattr(self, name))
            _check(f"EffectSettings.{name}", words, known)
            object.__setattr__(self, name, tuple(word for word in known if word in words))
        for name in ("every", "denoise_steps"):
            number = getattr(self, name)
            if number is not None and number < 1:
                raise BadArgument(f"EffectSettings.{name} is {number}; expected at least 1.")


def add_effect_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the group."""
    group = parser.add_argument_group("effects: the action without a word, a part, a picture (docs/effects.md)")
    group.add_argument(
        "--effects",
        metavar="ITEMS",
        default=NO_EFFECTS,
        help=f"{', '.join(get_args(EffectItems))}, with commas between, or none (default). Each call is made again "
        "without each of them; text,cameras takes the time of 7 calls with a small pi, of 17 with a large one",
    )
    group.add_argument(
        "--effects-readers",
        nargs="+",
        metavar="READER",
        help="who no longer reads it: all, action (the action queries alone), pictures, text (default: all action)",
    )
    group.add_argument("--effects-every", type=int, metavar="N", help="at every N replans only (default: 1)")
    group.add_argument(
        "--effects-steps",
        type=int,
        metavar="N",
        help="denoise steps of the calls that are made again (default: the policy's; half of them take half the time)",
    )
    group.add_argument(
        "--effects-pictures",
        type=store_place,
        metavar="STORE",
        help="exchange a camera's picture for the mean of the task's pictures in this store (default: for a grey one; "
        "in a rerun: the store that is run again)",
    )


def effect_settings(arguments: argparse.Namespace) -> EffectSettings | None:
    """Return what the options say; None for no effects."""
    given = {name: getattr(arguments, f"effects_{name}", None) for name in _OPTIONS}
    words = [word.strip() for word in str(getattr(arguments, "effects", NO_EFFECTS)).split(",")]
    if words == [NO_EFFECTS]:
        for name, value in given.items():
            if value is not None:
                raise BadArgument(f"Cannot use --effects-{name} without --effects; add for instance --effects text.")
        return None
    readers = list(DEFAULT_READERS) if given["readers"] is None else given["readers"]
    _check("--effects", words, get_args(EffectItems))
    _check("--effects-readers", readers, get_args(EffectReaders))
    for name in ("every", "steps"):
        number = given[name]
        if number is not None and number < 1:
            raise BadArgument(f"Cannot use --effects-{name} {number}; expected at least 1.")
    return EffectSettings(
        cast("tuple[EffectItems, ...]", tuple(words)),
        cast("tuple[EffectReaders, ...]", tuple(readers)),
        given["every"] or 1,
        given["steps"],
        given["pictures"],
    )


def settings_of(effects: str | EffectSettings | None) -> EffectSettings | None:
    """Return the settings of items with commas between; settings as they are."""
    if not isinstance(effects, str):
        return effects
    return EffectSettings(cast("tuple[EffectItems, ...]", tuple(word.strip() for word in effects.split(","))))


def _check(option: str, words: list[str], known: tuple[str, ...]) -> None:
    for word in words:
        if word not in known:
            raise BadArgument(f"{option} has no '{word}'; expected {listing(known)}.{did_you_mean(word, known)}")
