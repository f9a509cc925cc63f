"""The control for spatial bias as columns of the table `objects`: episodes are sorted into tasks, items are matched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import polars as pl

from vla_attention.analyze.measures.frames import Axis, long_table
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.objects.control_masks import Control, ControlSource, controls


@dataclass(frozen=True)
class ControlParts:
    """What the control needs of an episode, by picture, and the axes and items of its table `objects`."""

    item: SelectedEpisode
    sources: Mapping[str, ControlSource]
    axes: Sequence[Axis]
    items: Sequence[tuple[str, str, str]]


def control_columns(parts: Sequence[ControlParts]) -> list[pl.DataFrame]:
    """The columns of the control, in the rows of each episode's `objects`."""
    found: list[dict[str, Control]] = [{} for _ in parts]
    of_task: dict[tuple[str, int], list[int]] = {}
    for i, part in enumerate(parts):
        of_task.setdefault(task_of(part.item), []).append(i)
    for members in of_task.values():
        # Episodes of a task have the same things; a thing that one lacks is out of its sight.
        known = list(dict.fromkeys(item[:2] for i in members for item in parts[i].items))
        places = {i: [known.index(item[:2]) for item in parts[i].items] for i in members}
        for picture in dict.fromkeys(picture for i in members for picture in parts[i].sources):
            showing = [i for i in members if picture in parts[i].sources]
            sources = [parts[i].sources[picture].of_items(places[i], len(known)) for i in showing]
            for i, control in zip(showing, controls(sources), strict=True):
                found[i][picture] = control.of_items(places[i])
    return [
        pl.concat(
            [
                long_table(
                    part.item,
                    part.axes,
                    {
                        "control_enrichment": of_picture[picture].enrichment,
                        "control_balanced": of_picture[picture].balanced,
                        "control_overlap": of_picture[picture].overlap[None, None],
                    },
                ).select("control_enrichment", "control_balanced", "control_overlap")
                for picture in part.sources
            ]
        )
        for part, of_picture in zip(parts, found, strict=True)
    ]


def task_of(item: SelectedEpisode) -> tuple[str, int]:
    """Suite and task of an episode."""
    return item.store.suite, item.episode.attributes.task_id
