"""Which effects are measured. Every `--help` imports this module, and nothing heavy."""

from __future__ import annotations

import argparse
import re
from dataclasses import dataclass, fields
from typing import get_args

from vla_attention.schemas.effects import EffectReaders, MapBlocks, OtherPrompt
from vla_attention.schemas.errors import BadArgument, did_you_mean, listing
from vla_attention.schemas.options import add_options, option, read_options
from vla_attention.schemas.stores.store_url import StorePlace, store_place

#: Beginning of the item that names a grouping.
GROUPING = "grouping:"
#: Prompt tables: the one that is made of the tasks, and the beginning of one that names a file.
STANDARD, TABLE = "standard", "table:"
#: What effects can be of, as it is typed; a map in one of three forms.
_PLAIN = ("text", "cameras", "objects", "tokens")
ITEMS = (*_PLAIN, "map", "map:8x8", "map:picture:8x8", f"{GROUPING}FILE")
_MAP = re.compile(r"map(?::(?P<picture>picture:)?(?P<rows>\d{1,3})x(?P<columns>\d{1,3}))?")


@dataclass(frozen=True)
class EffectSettings:
    """Which effects are measured; see `EffectsRecorded`. denoise_steps: None takes those of the policy.

    items: of `EffectItems`, and `grouping:NAME` or `grouping:FILE.toml` for the groups of a grouping.
    pictures: the store of whose pictures cameras get the mean; None: in a rerun that of the base, else grey.
    rows: of the prompt table, once it was read.
    """

    items: tuple[str, ...] = option(
        f"{', '.join(ITEMS)} (the groups of a built-in grouping or TOML file), with commas between, or none (default). "
        "Each call is made again without each of them; text,cameras takes the time of 7 calls with a small pi, of 17 "
        "with a large one. map:8x8: which of 8 x 8 blocks of each picture move the action when no token reads them; "
        "map:picture:8x8: when they are filled in the picture; map: every patch, by gradients, of pi0 and pi0.5",
        group="effects: the action without a word, a part, a picture (docs/effects.md)",
        name="effects",
        nargs=None,  # words with commas between
        metavar="ITEMS",
    )
    readers: tuple[EffectReaders, ...] = option(
        "who no longer reads it: all, action (the action queries alone), pictures, text (default: all action)",
        ("all", "action"),
        name="effects-readers",
        metavar="READER",
    )
    every: int = option("at every Nth policy call only (default: %(default)s)", 1, name="effects-every", least=1)
    denoise_steps: int | None = option(
        "denoise steps of the calls that are made again (default: the policy's; half of them take half the time)",
        None,
        name="effects-steps",
        least=1,
    )
    controls: bool = option(
        "also each group, all text and all pictures alone, and as many random tokens (default: yes; without them a "
        "grouping takes a third of the calls)",
        True,
        name="effects-controls",
    )
    pictures: StorePlace | None = option(
        "exchange a camera's picture for the mean of the task's pictures in this store (default: for a grey one; in a "
        "rerun: the store that is run again)",
        None,
        name="effects-pictures",
        type=store_place,
        metavar="STORE",
    )

    prompts: str = option(
        "the instruction exchanged for the sentences of a table, table:FILE.csv or .toml (task, sentence, kind), or "
        "standard: written otherwise (a full stop, a capital), empty, shuffled, of other tasks, a word exchanged, "
        "paraphrased and contradicted, and the cameras",
        "",
        name="prompts",
        metavar="TABLE",
    )
    rows: tuple[OtherPrompt, ...] = ()

    def __post_init__(self) -> None:
        """Check the words, and bring them into their order."""
        if self.prompts not in ("", STANDARD) and not (self.prompts.startswith(TABLE) and self.prompts != TABLE):
            raise BadArgument(f"Cannot use --prompts '{self.prompts}'; expected {STANDARD}, {TABLE}FILE.csv or .toml.")
        if self.prompts == STANDARD:
            object.__setattr__(self, "items", (*self.items, "cameras"))
        groupings = tuple(dict.fromkeys(word for word in self.items if word.startswith(GROUPING)))
        if len(groupings) > 1:
            raise BadArgument(f"Effects take the groups of one grouping, not of {listing(groupings)}.")
        maps = tuple(dict.fromkeys(word for word in self.items if _MAP.fullmatch(word)))
        if len(maps) > 1:
            raise BadArgument(f"Effects (--effects) take one map, not {listing(maps)}.")
        for name, known in (("items", (*_PLAIN, *maps, *groupings)), ("readers", get_args(EffectReaders))):
            words = getattr(self, name)
            for word in words:
                if word not in known:
                    expected = ITEMS if name == "items" else known
                    near = did_you_mean(word, expected)
                    raise BadArgument(f"Effects have no {name[:-1]} '{word}'; expected {listing(expected)}.{near}")
            object.__setattr__(self, name, tuple(word for word in known if word in words))
        self.blocks  # noqa: B018 (raises for a map without blocks)

    @property
    def map_form(self) -> str:
        """The map as it was typed; empty without one."""
        return next((word for word in self.items if _MAP.fullmatch(word)), "")

    @property
    def blocks(self) -> MapBlocks | None:
        """The blocks of the map; None without one, and for one by first order."""
        form = _MAP.fullmatch(self.map_form)
        if form is None or form["rows"] is None:
            return None
        return MapBlocks("picture" if form["picture"] else "hidden", int(form["rows"]), int(form["columns"]))

    @property
    def grouping(self) -> str | None:
        """Name or file of the grouping whose groups are measured."""
        return next((word.removeprefix(GROUPING) for word in self.items if word.startswith(GROUPING)), None)


def add_effect_options(parser: argparse.ArgumentParser) -> None:
    """Add the options; without any of them there are no effects."""
    add_options(parser, EffectSettings, items={"default": "none"})


def effect_settings(given: argparse.Namespace) -> EffectSettings | None:
    """Return what parsed arguments say; None for no effects."""
    words = getattr(given, "effects", "none")
    settings = read_options(EffectSettings, given, items=() if words == "none" else _items(words))
    if settings.items or settings.prompts:
        return settings
    for one in fields(EffectSettings):
        if one.name != "items" and getattr(settings, one.name) != one.default:
            name = one.metadata["name"]
            raise BadArgument(f"Cannot use --{name} without --effects; add for instance --effects text.")
    return None


def settings_of(effects: str | EffectSettings | None) -> EffectSettings | None:
    """Return the settings of items with commas between; settings as they are."""
    return EffectSettings(_items(effects)) if isinstance(effects, str) else effects


def _items(words: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in words.split(","))
