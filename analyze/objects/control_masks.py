"""The control for spatial bias: the same attention maps on the object's masks of other episodes.

Attention that is fixed to the picture's middle covers an object near the middle far better than uniform attention does,
whatever it is. Objects stand elsewhere in other episodes of the task, so the same map is put on their masks of other
episodes: a map that does not depend on where the object is gets the same there.

    enrichment of a map on masks    share of the map's attention in them / share of the picture that they cover, both
                                    means over replans; over several cameras sum W S / sum W A, with W the map's
                                    attention to a camera, S the share of it in the masks, and A the share of the
                                    picture that they cover: a mean of the cameras' enrichments, so it lies between them
    control of an episode           the enrichment of its maps on the masks of other episodes of its task, mean over
                                    these episodes; with no other episode, on its own masks half an episode away
    enrichment over control         mean enrichment / mean control, over episodes

The interval. With K(e, f) the enrichment of the maps of e on the masks of f, the control is the mean of K(e, f) over
pairs e != f, so that every episode enters it twice, by its maps and by its masks. Resampling episodes with K(e, .)
alone would take the differences between masks for noise, which a fixed map does not have. Resampled is therefore the
first order of such a mean of pairs (Hoeffding 1948, "A class of statistics with asymptotically normal distribution";
Serfling 1980, section 5.3): K(e, .) + K(., e) - mean, which has the same mean over the episodes.

How much the object moves decides what the control can show. `overlap` is the mean over pairs of masks of sum min / sum
max of covered areas (Ruzicka's similarity, the IoU of areas). Above `STILL_OVERLAP` more than two thirds of a mask's
area is the object's own place, and the control cannot tell following from a fixed map.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.frames import Axis, long_table
from vla_attention.analyze.measures.masses import finite_mean
from vla_attention.analyze.measures.not_in_memory import MadeWhenAsked, OnDisk
from vla_attention.analyze.measures.selected import SelectedEpisode, positions_by_task

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

#: Control masks of one episode, at most.
MOST_MASKS = 50
#: From this overlap on, the control cannot tell.
STILL_OVERLAP = 0.5
#: Replans of an episode at which its masks are compared with the control masks.
_MOST_COMPARED = 8


@dataclass(frozen=True)
class ControlSource:
    """What the control needs of one picture (a camera, or all side by side) of one episode.

    Attributes:
        maps: mean over replans of the attention maps, (layer, head, patch) float32: of each camera scaled to the sum
            1, times the camera's mean share of the replan's attention.
        patches: number of patches of each camera, in order.
        masks: covered areas at a few replans, which are control masks of other episodes, (mask, patch, item) float32.
        compared: the same at the replans at which masks are compared, (replan, patch, item).
        half_way: enrichment of the maps on the episode's own masks half an episode away, (layer, head, item), and the
            overlap of these masks with the own ones, (item,); None where there are other episodes, or a single replan.
    """

    maps: Floats
    patches: tuple[int, ...]
    masks: Floats
    compared: Floats
    half_way: tuple[Array, Array] | None = None

    def of_items(self, places: Sequence[int], num_items: int) -> ControlSource:
        """The same with `num_items` items: the i-th one here has the place `places[i]`, the others cover nothing."""
        if list(places) == list(range(num_items)):
            return self
        wider = [np.zeros((*masks.shape[:2], num_items), np.float32) for masks in (self.masks, self.compared)]
        for masks, own in zip(wider, (self.masks, self.compared), strict=True):
            masks[..., places] = own
        return replace(self, masks=wider[0], compared=wider[1])


@dataclass(frozen=True)
class Control:
    """The control of one episode and picture.

    Attributes:
        enrichment: of its maps on control masks, (layer, head, item); NaN where there is no control.
        balanced: what stands for `enrichment` in intervals, with the same mean over the task's episodes.
        overlap: of its masks with its control masks, (item,).
    """

    enrichment: Array
    balanced: Array
    overlap: Array

    def of_items(self, places: Sequence[int]) -> Control:
        """The items at these places."""
        chosen = list(places)
        return Control(self.enrichment[..., chosen], self.balanced[..., chosen], self.overlap[chosen])


def control_source(cameras: Sequence[tuple[NDArray[np.floating], Floats]], num_others: int) -> ControlSource:
    """What the control needs of an episode's cameras: maps (replan, layer, head, patch), areas (replan, patch, item).

    num_others: other episodes of its task. A replan at which a camera's map is all 0 is in no mean of that camera's.
    """
    masses = [maps.sum(axis=-1, keepdims=True, dtype=np.float64) for maps, _ in cameras]
    area = np.concatenate([covered for _, covered in cameras], axis=1)
    replans = len(area)
    with np.errstate(invalid="ignore", divide="ignore"):
        scaled = [maps / mass for (maps, _), mass in zip(cameras, masses, strict=True)]
        weights = [finite_mean(mass / sum(masses)) for mass in masses]  # (layer, head, 1)
    half_way = None
    if num_others == 0 and replans > 1:
        away = half_an_episode_away(replans)
        attended, even = np.zeros((2, *scaled[0].shape[1:-1], area.shape[2]))
        for own, weight, (_, covered) in zip(scaled, weights, cameras, strict=True):
            shares = np.matmul(own, covered[away][:, None].astype(np.float64))  # (replan, layer, head, item)
            attended += weight * finite_mean(shares)
            even += weight * covered.mean(axis=(0, 1), dtype=np.float64)
        with np.errstate(invalid="ignore", divide="ignore"):
            enrichment = np.where(even > 0, attended / even, np.nan)
        overlaps = [mean_overlap(own[None], other[None]) for own, other in zip(area, area[away], strict=True)]
        half_way = enrichment, finite_mean(np.stack(overlaps))
    whole = [weight * finite_mean(own) for own, weight in zip(scaled, weights, strict=True)]
    return ControlSource(
        maps=np.concatenate(whole, axis=-1).astype(np.float32),
        patches=tuple(covered.shape[1] for _, covered in cameras),
        masks=area[replans_of_masks(replans, num_others)],
        compared=area[_spaced(replans, _MOST_COMPARED)],
        half_way=half_way,
    )


def replans_of_masks(num_replans: int, num_others: int) -> NDArray[np.int64]:
    """The replans whose masks an episode lends to `num_others` others: evenly spaced, so many that none gets over 50.

    >>> replans_of_masks(52, 10)
    array([ 5, 15, 26, 36, 46])
    """
    return _spaced(num_replans, max(1, MOST_MASKS // max(1, num_others)))


def half_an_episode_away(num_replans: int) -> NDArray[np.int64]:
    """For every replan the one that is half an episode later or earlier: as far as every replan has one."""
    return (np.arange(num_replans) + num_replans // 2) % num_replans


def offsets(num_episodes: int) -> NDArray[np.int64]:
    """Episode e is controlled by the episodes e + offset (modulo their number): all others, or 50 evenly spaced ones.

    Every episode then lends its masks as often as it borrows.
    """
    return 1 + _spaced(num_episodes - 1, MOST_MASKS)


def enrichment_on(maps: NDArray[np.floating], masks: NDArray[np.floating], patches: Sequence[int]) -> Array:
    """Share of each map in each mask / the share that the same attention to each camera, spread evenly, has there.

    maps: (..., patch) with the sum 1; masks: covered areas (patch, item), means over replans; patches: of each camera,
    in order. Returns (..., item); NaN where a mask covers nothing.
    """
    even: Array = np.zeros((*maps.shape[:-1], masks.shape[1]))
    first = 0
    for count in patches:
        own = slice(first, first + count)
        even += maps[..., own].sum(axis=-1, keepdims=True, dtype=np.float64) * masks[own].mean(axis=0, dtype=np.float64)
        first += count
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(even > 0, (maps @ masks).astype(np.float64) / even, np.nan)


def mean_overlap(first: NDArray[np.floating], second: NDArray[np.floating]) -> Array:
    """Mean over pairs of sum min / sum max of covered areas (mask, patch, item) and (mask, patch, item): (item,).

    NaN for an item that no pair shows.
    """
    common = np.stack([np.minimum(first, mask).sum(axis=1, dtype=np.float64) for mask in second], axis=1)
    either = _area(first)[:, None] + _area(second)[None] - common
    with np.errstate(invalid="ignore", divide="ignore"):
        return finite_mean(common / either, (0, 1))


def controls(sources: Sequence[ControlSource]) -> list[Control]:
    """The controls of all episodes of a task, for one picture. The items of all sources are the same, in one order."""
    if len(sources) == 1:
        return [_own_control(sources[0])]
    shape = (*sources[0].maps.shape[:2], sources[0].masks.shape[2])
    empty = [Control(np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape[2], np.nan)) for _ in sources]
    for i in range(shape[2]):
        shown = [e for e, source in enumerate(sources) if source.masks[:, :, i].any()]
        if len(shown) < 2:
            continue
        maps = np.stack([sources[e].maps for e in shown])
        masks = np.stack([sources[e].masks[:, :, i].mean(axis=0) for e in shown], axis=-1)
        pairs = enrichment_on(maps, masks, sources[0].patches)  # (episode, layer, head, episode)
        steps = offsets(len(shown))
        of_maps, of_masks = np.zeros((2, len(shown), *shape[:2]))
        for position, e in enumerate(shown):
            lenders = (position + steps) % len(shown)
            of_maps[position] = pairs[position][..., lenders].mean(axis=-1)
            of_masks[position] = pairs[(position - steps) % len(shown), ..., position].mean(axis=0)
            others = np.concatenate([sources[shown[lender]].masks[:, :, [i]] for lender in lenders])
            empty[e].overlap[i] = mean_overlap(sources[e].compared[:, :, [i]], others)[0]
        balanced = of_maps + of_masks - of_maps.mean(axis=0)
        for position, e in enumerate(shown):
            empty[e].enrichment[..., i], empty[e].balanced[..., i] = of_maps[position], balanced[position]
    return empty


def _own_control(source: ControlSource) -> Control:
    if source.half_way is None:
        nothing = np.full((*source.maps.shape[:2], source.masks.shape[2]), np.nan)
        return Control(nothing, nothing, np.full(nothing.shape[2], np.nan))
    enrichment, overlap = source.half_way
    return Control(enrichment, enrichment, overlap)


def _spaced(count: int, most: int) -> NDArray[np.int64]:
    """`most` of the numbers 0 .. count - 1, evenly spaced, or all of them."""
    return np.arange(count) if count <= most else ((np.arange(most) + 0.5) * count / most).astype(np.int64)


def _area(masks: NDArray[np.floating]) -> Array:
    return np.asarray(masks.sum(axis=1, dtype=np.float64))


@dataclass(frozen=True)
class ControlParts:
    """What the control needs of an episode, by picture, and the axes and items of its table `objects`."""

    sources: Mapping[str, ControlSource]
    axes: Sequence[Axis]
    items: Sequence[tuple[str, str, str]]


def control_columns(episodes: Sequence[SelectedEpisode], parts: Sequence[ControlParts]) -> Sequence[pl.DataFrame]:
    """The columns of the control, in the rows of each episode's `objects`; kept on disk."""
    of_task = positions_by_task(episodes)
    columns: OnDisk[pl.DataFrame] = OnDisk()
    for members in of_task.values():
        found = _controls(parts, members)
        for i in members:
            columns.append(_columns(episodes[i], parts[i], found[i]))
    places = {i: place for place, i in enumerate(i for members in of_task.values() for i in members)}
    return MadeWhenAsked(columns.__getitem__, [places[i] for i in range(len(episodes))])


def _controls(parts: Sequence[ControlParts], members: Sequence[int]) -> dict[int, dict[str, Control]]:
    """The controls of the episodes of one task, by picture."""
    found: dict[int, dict[str, Control]] = {i: {} for i in members}
    named = {i: (list(part.sources), [item[:2] for item in part.items]) for i in members for part in [parts[i]]}
    # Episodes of a task have the same things; a thing that one lacks is out of its sight.
    known = list(dict.fromkeys(item for _, items in named.values() for item in items))
    places = {i: [known.index(item) for item in items] for i, (_, items) in named.items()}
    # One picture at a time: the masks of all episodes of a task are in memory.
    for picture in dict.fromkeys(picture for pictures, _ in named.values() for picture in pictures):
        showing = [i for i in members if picture in named[i][0]]
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
