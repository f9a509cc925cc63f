"""The control for spatial bias as columns of the table `objects`: episodes are sorted into tasks, items are matched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import polars as pl

from vla_attention.analyze.measures.frames import Axis, long_table
from vla_attention.analyze.measures.not_in_memory import MadeWhenAsked, OnDisk
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.objects.control_masks import Control, ControlSource, controls


@dataclass(frozen=True)
class ControlParts:
    """What the control needs of an episode, by picture, and the axes and items of its table `objects`."""

    sources: Mapping[str, ControlSource]
    axes: Sequence[Axis]
    items: Sequence[tuple[str, str, str]]


def control_columns(episodes: Sequence[SelectedEpisode], parts: Sequence[ControlParts]) -> Sequence[pl.DataFrame]:
    """The columns of the control, in the rows of each episode's `objects`; kept on disk."""
    of_task: dict[tuple[str, int], list[int]] = {}
    for i, item in enumerate(episodes):
        of_task.setdefault(task_of(item), []).append(i)
    columns: OnDisk[pl.DataFrame] = OnDisk()
    for members in of_task.values():
        of_members = {i: parts[i] for i in members}
        found = _controls(of_members)
        for i, part in of_members.items():
            columns.append(_columns(episodes[i], part, found[i]))
    places = {i: place for place, i in enumerate(i for members in of_task.values() for i in members)}
    return MadeWhenAsked(columns.__getitem__, [places[i] for i in range(len(episodes))])


def _controls(parts: Mapping[int, ControlParts]) -> dict[int, dict[str, Control]]:
    """The controls of the episodes of one task, by picture."""
    members = list(parts)
    found: dict[int, dict[str, Control]] = {i: {} for i in members}
    # Episodes of a task have the same things; a thing that one lacks is out of its sight.
    known = list(dict.fromkeys(item[:2] for i in members for item in parts[i].items))
    places = {i: [known.index(item[:2]) for item in parts[i].items] for i in members}
    for picture in dict.fromkeys(picture for i in members for picture in parts[i].sources):
        showing = [i for i in members if picture in parts[i].sources]
        sources = [parts[i].sources[picture].of_items(places[i], len(known)) for i in showing]
        for i, control in zip(showing, controls(sources), strict=True):
            found[i][picture] = control.of_items(places[i])
    return found


def _columns(item: SelectedEpisode, part: ControlParts, of_picture: Mapping[str, Control]) -> pl.DataFrame:
    names = ("control_enrichment", "control_balanced", "control_overlap")
    tables = []
    for picture in part.sources:
        control = of_picture[picture]
        values = (control.enrichment, control.balanced, control.overlap[None, None])
        tables.append(long_table(item, part.axes, dict(zip(names, values, strict=True))).select(names))
    return pl.concat(tables)


def task_of(item: SelectedEpisode) -> tuple[str, int]:
    """Suite and task of an episode."""
    return item.store.suite, item.episode.attributes.task_id
