"""What the page is told of the heads of a layer over a run: how much they look at something, episode by episode."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import polars as pl

from vla_attention.analyze.core.measure import Items, Measured, means, measure
from vla_attention.analyze.core.naming import told_things
from vla_attention.analyze.core.recorded_effects import selected_items
from vla_attention.analyze.measures.question import ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.selection import select
from vla_attention.schemas.errors import UnknownName, UserError
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import check_names
from vla_attention.schemas.groupings.selector_parser import parse_selector
from vla_attention.schemas.groupings.selectors import SelectorError, quoted
from vla_attention.schemas.stores.reader import Store, StoredEpisode

#: What stands for the objects that each episode's own sentence names.
NAMED = "named"
#: Episodes of one answer: the page shows what is there, and asks for the next ones.
_AT_ONCE = 16


def heads_of_run(store: Store, site: str, layer: int, selector: str, first: int) -> dict[str, Any]:
    """`heads.json`: how much every head of a layer looks at a selector's keys, from an episode of the store on.

    selector: or `NAMED`.

    Returns:
        heads: their numbers. episodes: each with lift (replan, head), and that of the layer as a whole (replan), null
        where none of it is there; episodes without any of it are left out. failed: names of those that cannot be read.
        next: where the next answer begins; null: nowhere.

    Raises:
        SelectorError: it is none.
        BadArgument: the run has no such site or layer.
    """
    select(store.attributes, [layer], site=site)
    if selector != NAMED:
        parse_selector(selector)
    batch = store.episodes[first : first + _AT_ONCE]
    end = first + len(batch)
    settings, failed = AnalysisSettings(site=site, layers=(layer,)), list[str]()
    return {
        "heads": list(store.attributes.recording_of(site).heads),
        "episodes": list(_measured(store, batch, settings, selector, failed)) if batch else [],
        "failed": failed,
        "next": end if end < len(store.episodes) else None,
    }


def _measured(
    store: Store, batch: Sequence[StoredEpisode], settings: AnalysisSettings, selector: str, failed: list[str]
) -> Iterator[dict[str, Any]]:
    items_of = _named_items if selector == NAMED else partial(selected_items, selectors=(selector,), absent="zero")
    try:
        question = ask([replace(store, episodes=tuple(batch))], settings)
        if selector != NAMED:
            check_names(Grouping("heads", {"target": (selector,)}), question.vocabulary)
        found = [_lifts(one) for one in measure(question, items_of, ("head",))]
    except (SelectorError, UnknownName):  # none of them has what it names, or one alone has
        if len(batch) > 1:
            for episode in batch:
                yield from _measured(store, [episode], settings, selector, failed)
        return
    except UserError:
        if len(batch) == 1:
            failed.append(batch[0].name)
        else:  # one of them is the reason
            for episode in batch:
                yield from _measured(store, [episode], settings, selector, failed)
        return
    for item, lifts in zip(question.selected, found, strict=True):
        if any(one is not None for one in lifts["layer"]):
            yield {"name": item.episode.name} | lifts


def _lifts(measured: Measured) -> dict[str, Any]:
    heads, layer = (
        means(measured, ("replan", "layer", *more)).filter(pl.col("layer_number").is_not_null())["lift"].to_list()
        for more in (("head",), ())
    )
    every = [one if one is not None and math.isfinite(one) else None for one in heads]
    across = len(every) // len(layer)
    return {
        "lift": [every[at : at + across] for at in range(0, len(every), across)],
        "layer": [one if one is not None and math.isfinite(one) else None for one in layer],
    }


def _named_items(item: SelectedEpisode) -> Items:
    """The objects in sight that the episode's sentence names, as one item."""
    things = told_things(item) or set()
    seen = [thing.name for thing in item.tokens.objects if thing.name in things]
    if seen and item.tokens.coverage:
        return selected_items(item, (" | ".join(f"object:{quoted(name)}" for name in seen),), "zero")
    weights = np.zeros((1, item.tokens.layout.num_keys, 1), np.float32)
    return Items({"selector": pl.Series([""])}, weights, absent="zero")
