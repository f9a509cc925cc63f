"""Attention to any set of items in every episode: the one place where rows become numbers.

An item is a named weight per key: a word, an object, a camera, a group of a grouping, a patch. What is measured of it
are means over replans of numbers that follow, at each replan, from masses that were averaged over denoise steps and
heads (and for "layers_avg" over layers), unless these axes are kept.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.masses import finite_mean, masses, uniform_keys, uniform_masses
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.scan import Look, OnDisk, scan
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.measures.tables import (
    EPISODE_KEYS,
    Axis,
    frame_of_episodes,
    head_axis,
    layer_axis,
    long_table,
)
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.rows import LayerRows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import listing
from vla_attention.schemas.groupings.resolve import counted_keys, once_if_unchanged
from vla_attention.schemas.precision import key_error_bound
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.segments import segment_members, weights_on_segments

Array: TypeAlias = NDArray[np.float64]
#: A note names the items whose mass may be changed by more than this part of it where tiny probabilities were rounded.
_UNSURE = 0.01


@dataclass(frozen=True)
class Items:
    """The items of one episode.

    Attributes:
        labels: column -> a value for each item, (item,) each.
        weights: of each key in each item, (replan or 1, key, item) float32, 0..1.
        whole: of whose mass an item's `share` is a part: keys (replan or 1, key), or the first so many items together;
            all valid keys unless given.
        absent: whether a replan without keys of an item is in none of its means (a word that another prompt lacks), or
            counts as 0 (an object out of sight).
    """

    labels: Mapping[str, pl.Series]
    weights: NDArray[np.float32]
    whole: NDArray[np.bool_] | int | None = None
    absent: Literal["left out", "zero"] = "left out"

    def with_totals(self, item: SelectedEpisode) -> NDArray[np.float32]:
        """The weights, then those of `whole` and of all valid keys; keys that were taken out are in none.

        (replan or 1, key, item): once where they are the same at all replans, which makes one product of many.
        """
        totals = [self.whole if isinstance(self.whole, np.ndarray) else item.valid, item.valid]
        parts = [self.weights, *(part[:, :, None].astype(np.float32) for part in totals)]
        each = [once_if_unchanged(part) for part in parts]
        replans = max(map(len, each))
        weights = np.concatenate([np.broadcast_to(part, (replans, *part.shape[1:])) for part in each], axis=2)
        weights[:, list(item.without)] = 0.0
        return weights


@dataclass(frozen=True)
class Measured:
    """The masses of the items of one episode; all numbers follow from these arrays.

    Attributes:
        item: the episode.
        selection: the layers, and the denoise steps and heads where they were kept.
        labels: as in `Items`, and `absent` too.
        mass: (replan, layer, denoise or 1, head or 1, item), mean over the stored queries.
        whole, valid: the masses of `Items.whole` and of all valid keys, (replan, layer, denoise or 1, head or 1).
        keys: number of keys, (replan or 1, item).
        uniform, uniform_valid: `mass` and `valid` of uniform attention; axes along which nothing changes have length 1.
        row_sum: sums of the rows before storage rounded them, as `valid`.
        num_valid: number of valid keys, (replan or 1,).
        env_step, denoise_time: of each replan, (replan,), and of each selected denoise step, (denoise,).
    """

    item: SelectedEpisode
    selection: Selection
    labels: Mapping[str, pl.Series]
    absent: str
    mass: Array
    whole: Array
    valid: Array
    keys: Array
    uniform: Array
    uniform_valid: Array
    row_sum: Array
    num_valid: NDArray[np.int64]
    env_step: NDArray[np.int64]
    denoise_time: Array


def measure(
    question: Question,
    items_of: Callable[[SelectedEpisode], Items],
    keep: Collection[str] = (),
    check: Callable[[Sequence[Array]], None] = lambda num_keys: None,
) -> Sequence[Measured]:
    """Measure the items of every selected episode, see `look_at`."""
    (measured,) = scan(question, [look_at(question, items_of, keep, check)])
    return measured


def look_at(
    question: Question,
    items_of: Callable[[SelectedEpisode], Items],
    keep: Collection[str] = (),
    check: Callable[[Sequence[Array]], None] = lambda num_keys: None,
    positions: Sequence[int] | None = None,
) -> Look[Measured]:
    """The look at the items of every selected episode; what the cache holds of it has a key with the weights' digest.

    Args:
        question: stores, selection and site.
        items_of: gives the items of an episode; a function of a module, or a `functools.partial` of one.
        keep: "denoise" and "head" are kept apart where they are here, see `axes.OF_ROWS`.
        check: called at once with the most keys of the items at a replan, (1, item) per episode.
        positions: of the episodes that are measured; all unless given.
    """
    chosen, selection = question.selected, replace(question.selection, per_head="head" in keep)
    places = range(len(chosen)) if positions is None else positions
    fresh = (chosen[i].fresh() for i in places)
    described: OnDisk[_Described] = OnDisk(contents=each_episode(partial(_described, items_of=items_of), fresh))
    check([one.keys for one in described])
    number = {i: at for at, i in enumerate(places)}
    unsure: dict[str, None] = {}

    def remark(i: int | None, content: dict[str, NDArray[Any]]) -> str | None:
        if i is not None:
            found = content.pop("unsure")
            if found.any():
                labels = described[number[i]].labels
                names = next((labels[name] for name in ("item", "group") if name in labels), [*labels.values()][-1])
                unsure.update(dict.fromkeys(names.filter(pl.Series(found)).drop_nulls().to_list()))
        elif unsure:
            return (
                f"Some policy calls give {visible(listing(unsure, 4))} so little attention that rounding at capture "
                f"may have changed it by more than {_UNSURE:.0%}; a capture with --precision exact keeps it."
            )
        return None

    def made(i: int, content: dict[str, NDArray[Any]]) -> Measured:
        about = described[number[i]]
        return Measured(chosen[i], selection, about.labels, about.absent, **content)

    return Look(
        "items",
        partial(_ItemMasses, items_of=items_of, denoise="denoise" in keep),
        selection.per_head,
        made,
        {"denoise": "denoise" in keep},
        [one.digest for one in described],
        lambda i: described[number[i]],
        positions,
        remark,
    )


@dataclass(frozen=True)
class _Described:
    """What is known of an episode's items before they are measured: for `check`, and for the key of the cache.

    whole: `Items.whole` where it is a number. weights: those `with_totals`, unless they change in the episode; they are
    then made again where they are needed, of thousands of episodes they would fill the disk.
    """

    labels: Mapping[str, pl.Series]
    absent: str
    whole: int | None
    weights: NDArray[np.float32] | None
    keys: Array
    digest: str


def _described(item: SelectedEpisode, items_of: Callable[[SelectedEpisode], Items]) -> _Described:
    items = items_of(item)
    weights = items.with_totals(item)
    digest = hashlib.sha256(f"{weights.shape}".encode())
    digest.update(np.ascontiguousarray(weights).data)
    keys = counted_keys(weights, item.tokens.existing)[:, :-2].max(axis=0, keepdims=True)
    whole, kept = items.whole if isinstance(items.whole, int) else None, weights if len(weights) == 1 else None
    return _Described(items.labels, items.absent, whole, kept, keys, digest.hexdigest())


class _ItemMasses:
    """The arrays of a `Measured`: of items that are made of whole segments from their stored masses, else from rows.

    An item that cuts a segment gets its part of the segment's stored mass, which the rounded rows tell: parts of a
    segment add up to it, and an item's mass does not depend on what else is measured.
    """

    def __init__(
        self,
        item: SelectedEpisode,
        selection: Selection,
        site: str,
        about: _Described,
        items_of: Callable[[SelectedEpisode], Items],
        denoise: bool,
    ) -> None:
        self.item, self.selection, self.site, self.about, self.denoise = item, selection, site, about, denoise
        self.weights = items_of(item).with_totals(item) if about.weights is None else about.weights
        tokens, segments = item.tokens, item.episode.attributes.segments[site]
        members = segment_members(tokens.layout, tokens.static_roles, segments)
        self.of_segments, cut = weights_on_segments(self.weights, members)
        self.cut = np.asarray(cut.any(axis=0))
        atoms = _selected_cells(item.episode.keep(f"{site}/atoms")[..., :-1], selection).mean(axis=-2)
        self.atoms = atoms if selection.per_head else atoms.mean(axis=3, keepdims=True)
        # The parts of segments that items take, then the segments whole.
        self.pairs = [(int(i), int(segment)) for segment, i in np.argwhere(cut)]
        parts = [self.weights[..., i] * members[..., segment] for i, segment in self.pairs]
        self.whole = sorted({segment for _, segment in self.pairs})
        parts += [np.broadcast_to(members[..., segment], parts[0].shape) for segment in self.whole]
        self.parts = np.stack(parts, axis=-1).astype(np.float32) if parts else np.zeros((1, 0, 0), np.float32)
        taken = np.flatnonzero(self.parts.any(axis=(0, 2)))
        self.keys = range(taken[0], taken[-1] + 1) if taken.size else None
        if self.keys is not None:
            self.parts = np.ascontiguousarray(self.parts[:, self.keys.start : self.keys.stop])
        self.found = np.zeros((*self.atoms.shape[:-1], len(parts)), np.float32)

    def add(self, part: LayerRows) -> None:
        """Add the masses of the items that cut a segment."""
        assert self.keys is not None
        own = slice(self.keys.start - part.keys.start, self.keys.stop - part.keys.start)
        self.found[:, part.layer, part.denoise] = masses(part.rows[..., own], self.parts)

    def _masses(self) -> Array:
        """(replan, layer, denoise or 1, head or 1, item), those of `Items.with_totals`."""
        mass = masses(self.atoms, self.of_segments)
        of_rows = self.found[..., len(self.pairs) :]
        scale = self.atoms[..., self.whole] / np.where(of_rows > 0, of_rows, np.inf)
        for at, (i, segment) in enumerate(self.pairs):
            mass[..., i] += self.found[..., at] * scale[..., self.whole.index(segment)]
        return mass if self.denoise else mass.mean(axis=2, keepdims=True)

    def content(self) -> dict[str, NDArray[Any]]:
        """The arrays by name, and `unsure`: which items rounding may have changed."""
        item, about, mass, weights = self.item, self.about, self._masses(), self.weights
        uniform = uniform_masses(uniform_keys(item, self.selection), weights)
        uniform = uniform if self.denoise else uniform.mean(axis=2, keepdims=True)
        keys = counted_keys(weights, item.tokens.existing)[:, :-2]
        rounded = key_error_bound(item.store.attributes.recording.mantissa_bits) * self.cut[:-2] * keys
        # Keys that the run has cut off have no attention, to the last bit.
        seen = mass if item.store.attributes.interventions.keys else uniform
        far = (seen[..., :-2] > 0) & (rounded[:, None, None, None] > _UNSURE * mass[..., :-2])
        # As they were before storage rounded the rows.
        row_sum = _selected_cells(item.episode.row_sum(self.site), self.selection).mean(axis=-1)
        row_sum = row_sum if self.selection.per_head else row_sum.mean(axis=-1, keepdims=True)
        arrays = {
            "mass": mass[..., :-2],
            "whole": mass[..., -2] if about.whole is None else mass[..., : about.whole].sum(axis=-1),
            "valid": mass[..., -1],
            "keys": keys,
            "unsure": far.any(axis=(0, 1, 2, 3)),
            "uniform": uniform[..., :-2],
            "uniform_valid": uniform[..., -1],
            "row_sum": (row_sum if self.denoise else row_sum.mean(axis=2, keepdims=True)).astype(np.float64),
            "num_valid": item.num_valid,
            "env_step": item.episode.read("env_step").astype(np.int64),
            "denoise_time": item.episode.read("denoise_time")[list(self.selection.denoise)].astype(np.float64),
        }
        # In C order, as they come from the cache and from other processes: numpy's sums depend on the order in memory.
        return {name: np.ascontiguousarray(array) for name, array in arrays.items()}


def _selected_cells(values: NDArray[np.float32], selection: Selection) -> NDArray[np.float32]:
    """The selected layers, denoise steps and heads of an array whose axes begin with (replan, layer, denoise, head)."""
    return values[:, list(selection.layers)][:, :, list(selection.denoise)][:, :, :, list(selection.heads)]


def averaged(one: Measured, by: Collection[str] = ()) -> dict[str, Array]:
    """The masses of an episode, means over the axes that are not in `by`; the replans are kept.

    Returns:
        mass and uniform, (replan, layer, denoise or 1, head or 1, item); whole, valid, row_sum and uniform_valid,
        without the items. The layers are those of the selection, then their mean; without "layer" the latter alone. An
        axis along which uniform attention does not change may have length 1.
    """
    selection = one.selection
    for axis, name, labels in ((2, "denoise", selection.denoise), (3, "head", selection.heads)):
        if name in by and one.mass.shape[axis] < len(labels):
            raise ValueError(f"the axis '{name}' was not kept when the items were measured")
    gone = tuple(axis for axis, name in ((2, "denoise"), (3, "head")) if name not in by)

    def of_layers(values: Array) -> Array:
        values = values.mean(axis=gone, keepdims=True)
        if values.shape[1] == 1 and len(selection.layers) > 1:  # the same in all layers
            return values
        average: Array = values[:, list(selection.once)].mean(axis=1, keepdims=True)
        return np.concatenate([values, average], axis=1) if "layer" in by else average

    names = ("mass", "uniform", "whole", "valid", "row_sum", "uniform_valid")
    return {name: of_layers(getattr(one, name)) for name in names}


def axes_of(one: Measured, by: Collection[str] = ()) -> list[Axis]:
    """The labels of the axes of `averaged` but the items; without "replan" those behind it."""
    selection, place = one.selection, slice(None) if "layer" in by else slice(-1, None)
    axes: list[Axis] = [{"replan": range(len(one.env_step)), "env_step": one.env_step}] if "replan" in by else []
    axes.append({name: list(labels)[place] for name, labels in layer_axis(selection).items()})
    steps = selection.denoise_steps if "denoise" in by else [None]
    return [
        *axes,
        {"denoise_step": pl.Series(steps, dtype=pl.Int64)},
        head_axis(replace(selection, per_head="head" in by)),
    ]


def means(measured: Measured, by: Collection[str] = (), more: Collection[str] = ()) -> pl.DataFrame:
    """Means over an episode's replans, or with "replan" the numbers of each.

    more: further columns, of the whole row: "row_sum", "valid", "whole" (masses) and "num_valid", "num_replans"; and
    "uniform", "mass_std", "share_std" of the items.

    Returns:
        One row per item and cell of the axes in `by`: `EPISODE_KEYS`, replan and env_step, layer, layer_number and
        block (the selected layers, then "layers_avg"; without "layer" the latter alone), denoise_step, head, the items'
        labels, and
            keys   number of keys
            mass   part of the row, 0..1
            density  mass / keys
            lift   (mass / what uniform attention gives) / (the same of all valid keys): 1 is uniform attention
            share  mass / mass of `Items.whole`
        Null where a number does not exist.
    """
    one, found = measured, averaged(measured, by)
    mass, uniform = found["mass"], found["uniform"]
    whole, valid, row_sum, of_valid = (
        found[name][..., None] for name in ("whole", "valid", "row_sum", "uniform_valid")
    )
    keys = np.broadcast_to(one.keys[:, None, None, None], mass.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        lift = np.where(uniform > 0, mass / uniform, np.nan) / (valid / of_valid)
        share = np.where(whole > 0, mass / whole, np.nan)
        density = np.where(keys > 0, mass / keys, np.nan)
    values = {"keys": keys, "mass": mass, "density": density, "lift": lift, "share": share}
    replans = np.full((1, 1, 1, 1, 1), len(one.env_step) if "replan" not in by else 1.0)
    further = {
        "row_sum": row_sum,
        "valid": valid,
        "whole": whole,
        "num_valid": one.num_valid[:, None, None, None, None].astype(np.float64),
        "num_replans": replans,
        "uniform": uniform,
    }
    values |= {name: array for name, array in further.items() if name in more}
    if one.absent == "left out":
        values = {name: np.where(keys > 0, array, np.nan) for name, array in values.items()}
    spread = {name: values[name] for name in ("mass", "share") if f"{name}_std" in more}
    if "replan" not in by:
        values = {name: finite_mean(array) for name, array in values.items()}
        for name, array in spread.items():
            values[f"{name}_std"] = np.sqrt(finite_mean((array - values[name]) ** 2))
    return long_table(one.item, [*axes_of(one, by), one.labels], values, EPISODE_KEYS)


def table_of(
    measured: Sequence[Measured],
    by: Collection[str] = (),
    more: Collection[str] = (),
    then: Callable[[pl.DataFrame], pl.DataFrame] = lambda rows: rows,
) -> pl.LazyFrame:
    """`means` of all episodes, and what `then` makes of them, made whenever rows are asked for."""
    return frame_of_episodes(measured, partial(means, by=frozenset(by), more=frozenset(more)), then)
