"""Masses of every selected episode as arrays, and as tables: a row per replan, layer, denoise step (and head)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.baselines import uniform_keys, uniform_masses
from vla_attention.analyze.measures.frames import (
    EPISODE_KEYS,
    Axis,
    Tables,
    denoise_axis,
    episode_id,
    head_axis,
    layer_axis,
    long_table,
    replan_axis,
    tables_of_each,
)
from vla_attention.analyze.measures.kept import digest_of_weights, measured_once
from vla_attention.analyze.measures.masses import (
    group_measures,
    masses,
    ratio,
    relative_to_uniform,
    sides,
    uniform_ratio,
)
from vla_attention.analyze.measures.not_in_memory import MadeWhenAsked, OnDisk
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import (
    SelectedEpisode,
    check_not_empty,
    refuse_empty_groups,
    resolve_all,
    resolve_episode,
)
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import ResolvedGrouping, check_names, stack_over_keys
from vla_attention.schemas.progress_bar import progress_bar
from vla_attention.schemas.segments import segment_members, weights_on_segments

#: The arrays of a `MeasuredEpisode`.
MEASURED_ARRAYS = ("mass", "valid_mass", "row_sum", "num_keys", "num_valid", "uniform_mass", "uniform_valid")


@dataclass(frozen=True)
class MeasuredEpisode:
    """The masses of a grouping's groups in one episode. All further numbers follow from these arrays.

    Attributes:
        item: the episode.
        selection: which layers, denoise steps and heads the axes hold; with `per_head` false the axis of heads has
            length 1.
        mass: (replan, layer, denoise, head, group), mean over the stored queries.
        valid_mass: (replan, layer, denoise, head), mass of all valid keys.
        row_sum: (replan, layer, denoise, head), sums of the rows before storage rounded them.
        num_keys: (replan or 1, group), fractional where objects cover parts of patches.
        num_valid: (replan or 1,), number of valid keys.
        uniform_mass, uniform_valid: `mass` and `valid_mass` of uniform attention; axes along which nothing changes may
            have length 1.
    """

    item: SelectedEpisode
    selection: Selection
    mass: NDArray[np.float64]
    valid_mass: NDArray[np.float64]
    row_sum: NDArray[np.float64]
    num_keys: NDArray[np.float64]
    num_valid: NDArray[np.int64]
    uniform_mass: NDArray[np.float64]
    uniform_valid: NDArray[np.float64]

    def over_heads(self) -> MeasuredEpisode:
        """The same with heads averaged."""
        return replace(
            self,
            selection=replace(self.selection, per_head=False),
            mass=self.mass.mean(axis=3, keepdims=True),
            valid_mass=self.valid_mass.mean(axis=3, keepdims=True),
            row_sum=self.row_sum.mean(axis=3, keepdims=True),
            uniform_mass=self.uniform_mass.mean(axis=3, keepdims=True),
            uniform_valid=self.uniform_valid.mean(axis=3, keepdims=True),
        )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """`MEASURED_ARRAYS` by name, in C order."""
        return {name: np.ascontiguousarray(getattr(self, name)) for name in MEASURED_ARRAYS}

    def at_denoise(self, position: int) -> MeasuredEpisode:
        """One denoise step alone, by its position in the selection."""
        part, selection = slice(position, position + 1), self.selection
        of_uniform = part if self.uniform_valid.shape[2] > 1 else slice(None)
        return replace(
            self,
            selection=replace(selection, denoise=selection.denoise[part], denoise_steps=selection.denoise_steps[part]),
            mass=self.mass[:, :, part],
            valid_mass=self.valid_mass[:, :, part],
            row_sum=self.row_sum[:, :, part],
            uniform_mass=self.uniform_mass[:, :, of_uniform],
            uniform_valid=self.uniform_valid[:, :, of_uniform],
        )


def measure_episode(
    item: SelectedEpisode, resolved: ResolvedGrouping, selection: Selection, site: str
) -> MeasuredEpisode:
    """Masses of one episode.

    Uses the stored segment masses when no group cuts a segment, and reads rows otherwise.
    """
    row_sum = row_sums(item, selection, site)
    weights = with_valid(resolved.weights, item.valid)
    of_segments = segment_weights(item, weights, site)
    if of_segments is not None:
        atoms = selected_cells(item.episode.read(f"{site}/atoms"), selection)
        mass = masses(_reduce(atoms, selection, axis=-2), of_segments)
    else:
        mass = np.empty((*row_sum.shape, weights.shape[2]))
        for part in layer_rows(item.store.attributes, item.episode, selection, site):
            mass[:, part.layer, part.denoise] = masses(part.rows, weights)
    return measured_from(item, resolved, selection, mass, row_sum, weights)


def measured_from(
    item: SelectedEpisode,
    resolved: ResolvedGrouping,
    selection: Selection,
    mass: NDArray[np.float64],
    row_sum: NDArray[np.float64],
    weights: NDArray[np.float32] | None = None,
) -> MeasuredEpisode:
    """A `MeasuredEpisode` from masses (replan, layer, denoise, head, group + 1); the last mass is of all valid keys.

    weights: `with_valid`, made here unless they are given.
    """
    if weights is None:
        weights = with_valid(resolved.weights, item.valid)
    uniform = uniform_masses(uniform_keys(item, selection), weights)
    # In C order, as they come from the cache and from other processes: numpy's sums depend on the order in memory.
    arrays = (mass[..., :-1], mass[..., -1], row_sum, uniform[..., :-1], uniform[..., -1])
    groups, valid, row_sum, of_groups, of_valid = map(np.ascontiguousarray, arrays)
    return MeasuredEpisode(
        item, selection, groups, valid, row_sum, resolved.num_keys, resolved.num_valid, of_groups, of_valid
    )


def measure_episodes(
    question: Question,
    resolved: Sequence[ResolvedGrouping] | None = None,
    progress: Callable[[int], object] | None = None,
    per_head: bool | None = None,
) -> Sequence[MeasuredEpisode]:
    """Masses of every selected episode of a question. Shows progress at a terminal unless `progress` is given.

    They are kept on disk: each episode's are read when they are asked for.

    Args:
        question: stores, selection and grouping.
        resolved: the grouping on every episode; resolved here unless it is given.
        progress: called with 1 after each episode.
        per_head: keep heads apart; as in the question unless it is given.
    """
    selection = question.selection if per_head is None else replace(question.selection, per_head=per_head)
    selected = question.selected
    if progress is not None:
        return _measured_or_kept(question, selection, resolved, progress)
    with progress_bar(len(selected), "episodes") as advance:
        return _measured_or_kept(question, selection, resolved, advance)


def _measured_or_kept(
    question: Question,
    selection: Selection,
    resolved: Sequence[ResolvedGrouping] | None,
    progress: Callable[[int], object],
) -> Sequence[MeasuredEpisode]:
    """`measure_episodes`: from the cache what it holds. The grouping is resolved on the other episodes only."""
    grouping, selected = question.grouping, question.selected
    # Whether a group is empty is decided with its sinks.
    if resolved is None and any(item.without for item in selected):
        resolved = resolve_all(grouping, selected, question.vocabulary)
    if resolved is None:
        check_names(grouping, question.vocabulary, selected[0].tokens.layout)

    def measure(positions: Sequence[int]) -> Iterator[dict[str, NDArray[Any]]]:
        if resolved is None and len(positions) == len(selected):
            refuse_empty_groups(grouping, selected)
        pairs = [(selected[i], None if resolved is None else resolved[i]) for i in positions]
        each = partial(_measured_arrays, grouping=grouping, selection=selection, site=question.site)
        return each_episode(each, pairs, progress)

    measured = measured_once(
        "masses",
        selected,
        selection,
        question.site,
        measure,
        {
            "groups": [[name, list(selectors)] for name, selectors in grouping.groups.items()],
            "overlap": grouping.overlap,
        },
        None if resolved is None else [digest_of_weights(one) for one in resolved],
        progress,
    )
    num_keys: list[NDArray[np.float64]] = []

    def noting_keys() -> Iterator[dict[str, NDArray[Any]]]:
        for arrays in measured:
            num_keys.append(arrays["num_keys"].max(axis=0, keepdims=True))
            yield arrays

    kept = measured_on_disk(selected, selection, noting_keys())
    if resolved is None:
        check_not_empty(grouping, num_keys)
    return kept


def measured_on_disk(
    selected: Sequence[SelectedEpisode], selection: Selection, arrays: Iterable[Mapping[str, NDArray[Any]]]
) -> Sequence[MeasuredEpisode]:
    """The episodes with their `arrays`, which are written to disk now and read when an episode is asked for."""
    kept = OnDisk(arrays)
    return MadeWhenAsked(lambda i: MeasuredEpisode(selected[i], selection, **kept[i]), range(len(kept)))


def in_order_of_episodes(measured: Sequence[MeasuredEpisode]) -> Sequence[MeasuredEpisode]:
    """The episodes that have replans, by suite, task and number."""
    ids = {i: episode_id(one.item) for i, one in enumerate(measured) if len(one.mass)}
    return MadeWhenAsked(measured.__getitem__, sorted(ids, key=ids.__getitem__))


def _measured_arrays(
    pair: tuple[SelectedEpisode, ResolvedGrouping | None], grouping: Grouping, selection: Selection, site: str
) -> dict[str, NDArray[Any]]:
    # Resolved here, one episode at a time: weights of objects are megabytes an episode.
    item, resolved = pair
    return measure_episode(item, resolved or resolve_episode(grouping, item), selection, site).arrays()


def step_tables(measured: Sequence[MeasuredEpisode], grouping: Grouping) -> Tables:
    """Every (episode, replan, layer, denoise step[, head]).

    Returns:
        cells: `EPISODE_KEYS`, replan, env_step, layer, block, denoise_step, denoise_time, head (null where heads were
            averaged), row_sum, valid_mass, num_valid; with a ratio numerator_mass, denominator_mass, ratio,
            uniform_ratio, ratio_lift (ratio / uniform_ratio), log2_ratio.
        groups: suite, task_id, episode_index, replan, layer, block, denoise_step, head, group, mass, fraction, keys,
            density, lift (see `masses.group_measures`).
    """
    return tables_of_each(measured, partial(_episode_steps, grouping=grouping))


def _episode_steps(measured: MeasuredEpisode, grouping: Grouping) -> Tables:
    return Tables(lambda: _step_cells(measured, grouping), lambda: _step_groups(measured, grouping))


def _step_cells(measured: MeasuredEpisode, grouping: Grouping) -> pl.DataFrame:
    item, selection, mass = measured.item, measured.selection, measured.mass
    times = item.episode.read("denoise_time")[list(selection.denoise)].astype(np.float64)
    steps: Axis = {"denoise_step": selection.denoise_steps, "denoise_time": times}
    cells = {
        "row_sum": measured.row_sum,
        "valid_mass": measured.valid_mass,
        "num_valid": measured.num_valid[:, None, None, None],
    }
    if grouping.ratio is not None:
        above, below = sides(mass, grouping)
        value, uniform = ratio(above, below), uniform_ratio(measured.uniform_mass, grouping)
        cells |= {"numerator_mass": above, "denominator_mass": below, "ratio": value, "uniform_ratio": uniform}
        cells |= relative_to_uniform(value, uniform)
    return long_table(
        item, [replan_axis(item), layer_axis(selection), steps, head_axis(selection)], cells, EPISODE_KEYS
    )


def _step_groups(measured: MeasuredEpisode, grouping: Grouping) -> pl.DataFrame:
    selection, mass = measured.selection, measured.mass
    axes: list[Axis] = [
        {"replan": range(len(mass))},
        layer_axis(selection),
        denoise_axis(selection),
        head_axis(selection),
        {"group": grouping.names},
    ]
    measures = group_measures(
        mass, measured.valid_mass, measured.num_keys, measured.uniform_mass, measured.uniform_valid
    )
    return long_table(measured.item, axes, measures.columns())


def row_sums(item: SelectedEpisode, selection: Selection, site: str) -> NDArray[np.float64]:
    """Stored sums of the rows (replan, layer, denoise, head or 1), as they were before storage rounded the rows."""
    return _reduce(selected_cells(item.episode.read(f"{site}/row_sum"), selection), selection).astype(np.float64)


def segment_weights(item: SelectedEpisode, weights: NDArray[np.float32], site: str) -> NDArray[np.float32] | None:
    """Weights (replan or 1, key, group) as weights (replan or 1, segment, group); None where a group cuts a segment."""
    tokens, segments = item.tokens, item.episode.attributes.segments[site]
    roles = tokens.static_roles
    # The first replan alone tells most groups that cut a segment.
    if weights_on_segments(weights[:1], segment_members(tokens.layout, roles[:1], segments)) is None:
        return None
    return weights_on_segments(weights, segment_members(tokens.layout, roles, segments))


def with_valid(weights: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Weights (replan or 1, key, group) with one more group: the valid keys (replan or 1, key)."""
    columns = [weights[:, :, i] for i in range(weights.shape[2])]
    return stack_over_keys([*columns, valid.astype(np.float32)])


def selected_cells(values: NDArray[np.float32], selection: Selection) -> NDArray[np.float32]:
    """The selected layers, denoise steps and heads of an array whose axes begin with (replan, layer, denoise, head)."""
    return values[:, list(selection.layers)][:, :, list(selection.denoise)][:, :, :, list(selection.heads)]


def _reduce(values: NDArray[np.float32], selection: Selection, axis: int = -1) -> NDArray[np.float32]:
    """Average over queries (the given axis) and, unless heads are kept apart, over heads (the axis before it)."""
    values = values.mean(axis=axis)
    return values if selection.per_head else values.mean(axis=axis, keepdims=True)


def role_masses(question: Question) -> dict[str, float]:
    """Mean mass of the keys of each role, by the role's name.

    Means over replans, selected layers, denoise steps, heads and queries, then over episodes. They come from the stored
    masses of segments, which are exact while stored rows are rounded. Their sum is the mean row sum (1).
    """
    selection = question.selection
    totals: dict[str, float] = {}
    for item in question.selected:
        atoms = selected_cells(item.episode.read(f"{question.site}/atoms"), selection)
        masses = atoms.reshape(-1, atoms.shape[-1]).mean(axis=0, dtype=np.float64)
        for segment, mass in zip(item.episode.attributes.segments[question.site], masses.tolist(), strict=True):
            totals[segment.role] = totals.get(segment.role, 0.0) + mass
    return {role: total / len(question.selected) for role, total in totals.items()}
