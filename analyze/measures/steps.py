"""The steps table: one row per (episode, replan, layer, denoise step[, head]) with the measures of every group."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.masses import group_measures, masses, ratio
from vla_attention.analyze.measures.selected import SelectedEpisode, resolve_all
from vla_attention.analyze.stores.parallel import map_episodes
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import ResolvedGrouping
from vla_attention.schemas.segments import segment_members, weights_on_segments


def steps_table(
    selected: Sequence[SelectedEpisode],
    grouping: Grouping,
    selection: Selection,
    site: str,
    progress: Callable[[int], object] | None = None,
    resolved: Sequence[ResolvedGrouping] | None = None,
) -> pl.DataFrame:
    """Measure every selected episode; `progress` is called with 1 after each.

    `resolved` is the grouping on every episode where it is known already; else it is resolved here.
    """
    resolved = resolve_all(grouping, selected) if resolved is None else resolved

    def measure(pair: tuple[SelectedEpisode, ResolvedGrouping]) -> pl.DataFrame:
        return _episode_steps(*pair, grouping, selection, site)

    return pl.concat(map_episodes(measure, list(zip(selected, resolved, strict=True)), progress))


def episode_masses(
    item: SelectedEpisode, resolved: ResolvedGrouping, selection: Selection, site: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Masses (replan, layer, denoise, head or 1, group + 1) and row sums (replan, layer, denoise, head or 1) of one episode.

    The last mass is that of all valid keys.

    Averaged over the stored queries and, unless heads are kept apart, over the selected heads. Uses the stored segment
    masses when the grouping does not cut through a segment, and reads rows otherwise.
    """
    row_sum = row_sums(item, selection, site)
    weights = with_valid(resolved.weights, item.valid)
    of_segments = segment_weights(item, weights, site)
    if of_segments is not None:
        atoms = _cells(item.episode.read(f"{site}/atoms"), selection)
        return masses(_reduce(atoms, selection, axis=-2), of_segments), row_sum
    result = np.empty((*row_sum.shape, weights.shape[2]))
    for part in layer_rows(item.episode, selection, site):
        rows = part.rows if selection.per_head else part.rows.mean(axis=1, keepdims=True)
        result[:, part.layer, part.denoise] = masses(rows, weights)
    return result, row_sum


def row_sums(item: SelectedEpisode, selection: Selection, site: str) -> NDArray[np.float64]:
    """Stored sums of the rows (replan, layer, denoise, head or 1), as they were before storage rounded the rows."""
    return _reduce(_cells(item.episode.read(f"{site}/row_sum"), selection), selection).astype(np.float64)


def segment_weights(item: SelectedEpisode, weights: NDArray[np.float32], site: str) -> NDArray[np.float32] | None:
    """Weights (replan or 1, key, group) on the stored segments (replan or 1, segment, group); None where a group cuts one."""
    tokens, segments = item.tokens, item.episode.attributes.segments[site]
    return weights_on_segments(weights, segment_members(tokens.layout, tokens.static_roles, segments))


def with_valid(weights: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Weights (replan or 1, key, group) with one more group: the valid keys (replan or 1, key)."""
    replans = max(len(weights), len(valid))
    parts = [
        np.broadcast_to(part, (replans, *part.shape[1:])) for part in (weights, valid[:, :, None].astype(np.float32))
    ]
    return np.concatenate(parts, axis=2)


def _cells(values: NDArray[np.float32], selection: Selection) -> NDArray[np.float32]:
    """The selected layers, denoise steps and heads of an array whose axes begin with (replan, layer, denoise, head)."""
    return values[:, list(selection.layers)][:, :, list(selection.denoise)][:, :, :, list(selection.heads)]


def _reduce(values: NDArray[np.float32], selection: Selection, axis: int = -1) -> NDArray[np.float32]:
    """Average over queries (the given axis) and, unless heads are kept apart, over heads (the axis before it)."""
    values = values.mean(axis=axis)
    return values if selection.per_head else values.mean(axis=axis, keepdims=True)


def _episode_steps(
    item: SelectedEpisode, resolved: ResolvedGrouping, grouping: Grouping, selection: Selection, site: str
) -> pl.DataFrame:
    return episode_steps(item, resolved, grouping, selection, *episode_masses(item, resolved, selection, site))


def episode_steps(
    item: SelectedEpisode,
    resolved: ResolvedGrouping,
    grouping: Grouping,
    selection: Selection,
    mass: NDArray[np.float64],
    row_sum: NDArray[np.float64],
) -> pl.DataFrame:
    """One episode's part of the steps table, from what `episode_masses` gives."""
    mass, valid_mass = mass[..., :-1], mass[..., -1]
    measures = group_measures(mass, valid_mass, resolved.num_keys, resolved.num_valid)
    shape = row_sum.shape
    attributes, episode = item.episode.attributes, item.episode

    def along(values: Any, axis: int) -> NDArray[Any]:
        expanded = np.asarray(values).reshape([-1 if i == axis else 1 for i in range(4)])
        return np.broadcast_to(expanded, shape).ravel()

    columns: dict[str, Any] = {
        "suite": item.store.suite,
        "task_id": attributes.task_id,
        "instruction": attributes.instruction,
        "episode_index": attributes.episode_index,
        "success": attributes.success,
        "num_steps": attributes.num_steps,
        "replan": along(np.arange(shape[0]), 0),
        "env_step": along(episode.read("env_step").astype(np.int64), 0),
        "layer": along(np.array(selection.layer_labels, dtype=np.int64), 1),
        "block": along(np.array(selection.blocks, dtype=np.int64), 1),
        "denoise_step": along(np.array(selection.denoise_steps, dtype=np.int64), 2),
        "denoise_time": along(episode.read("denoise_time")[list(selection.denoise)].astype(np.float64), 2),
        "head": along(np.array(selection.head_numbers, dtype=np.int64), 3) if selection.per_head else None,
        "row_sum": row_sum.ravel(),
        "valid_mass": valid_mass.ravel(),
        "num_valid": along(np.broadcast_to(resolved.num_valid, shape[:1]), 0),
    }
    for i, name in enumerate(grouping.names):
        columns[f"{name}_mass"] = measures.mass[..., i].ravel()
        columns[f"{name}_fraction"] = measures.fraction[..., i].ravel()
        columns[f"{name}_keys"] = along(np.broadcast_to(resolved.num_keys[:, i], shape[:1]), 0)
        columns[f"{name}_density"] = measures.density[..., i].ravel()
        columns[f"{name}_lift"] = measures.lift[..., i].ravel()
    if grouping.ratio is not None:
        columns.update(_ratio_columns(grouping, measures.mass, resolved.num_keys, along))
    frame = pl.DataFrame({name: values for name, values in columns.items() if isinstance(values, np.ndarray)})
    return frame.select(_expression(name, values) for name, values in columns.items())


def _expression(name: str, values: NDArray[Any] | str | bool | int | None) -> pl.Expr:
    """A column of the steps table, from its numbers or the one value that all of its rows have."""
    if not isinstance(values, np.ndarray):
        dtype = pl.String if isinstance(values, str) else pl.Boolean if isinstance(values, bool) else pl.Int64
        return pl.lit(values, dtype=dtype).alias(name)
    # NaN stands for "undefined" in numpy; in tables that is null. Infinite ratios stay what they are.
    return pl.col(name).fill_nan(None) if values.dtype == np.float64 else pl.col(name)


def _ratio_columns(
    grouping: Grouping,
    mass: NDArray[np.float64],
    num_keys: NDArray[np.float64],
    along: Callable[[Any, int], NDArray[Any]],
) -> dict[str, NDArray[Any]]:
    assert grouping.ratio is not None
    top = [grouping.names.index(name) for name in grouping.ratio.numerator]
    bottom = [grouping.names.index(name) for name in grouping.ratio.denominator]
    numerator, denominator = mass[..., top].sum(axis=-1), mass[..., bottom].sum(axis=-1)
    value = ratio(numerator, denominator)
    uniform = np.broadcast_to(ratio(num_keys[:, top].sum(axis=1), num_keys[:, bottom].sum(axis=1)), mass.shape[:1])
    with np.errstate(divide="ignore", invalid="ignore"):
        return {
            "numerator_mass": numerator.ravel(),
            "denominator_mass": denominator.ravel(),
            "ratio": value.ravel(),
            "uniform_ratio": along(uniform, 0),
            "ratio_lift": (value / uniform[:, None, None, None]).ravel(),
            "log2_ratio": np.log2(value).ravel(),
        }
