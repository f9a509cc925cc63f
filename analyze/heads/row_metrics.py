"""Entropy, effective keys, top-k mass and sinks of every row, in one pass over the stored rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.heads.entropy import effective_keys, entropies, top_mass
from vla_attention.analyze.measures.frames import (
    EPISODE_ID,
    Tables,
    denoise_axis,
    head_axis,
    layer_axis,
    long_table,
    tables_of_each,
)
from vla_attention.analyze.measures.kept import digest_of_weights, measured_once
from vla_attention.analyze.measures.masses import masses
from vla_attention.analyze.measures.not_in_memory import MadeWhenAsked, OnDisk
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode, resolve_all
from vla_attention.analyze.measures.sinks import KeyShares, SinkRule, UniformShares
from vla_attention.analyze.measures.steps import with_valid
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.groupings.resolve import ResolvedGrouping
from vla_attention.schemas.progress_bar import progress_bar

DEFAULT_TOP = (1, 5, 10)


@dataclass(frozen=True)
class RowOptions:
    """How rows are measured: the numbers k of keys in top-k masses, and the rule for sinks.

    Raises `BadArgument` for a k below 1, or one that is named twice.
    """

    top: tuple[int, ...] = DEFAULT_TOP
    rule: SinkRule = field(default_factory=SinkRule)

    def __post_init__(self) -> None:
        """Check the numbers of keys."""
        if not self.top or min(self.top) < 1 or len(set(self.top)) != len(self.top):
            raise BadArgument(
                f"Cannot take the top {listing(self.top)} keys; expected different whole numbers from 1 on."
            )


@dataclass(frozen=True)
class RowMeasures:
    """The measures of one episode's rows. Axes begin with (replan, layer, denoise, head).

    Attributes:
        entropy: nats, over the chosen groups and, last, over all valid keys: (..., group + 1) float32.
        top: share of the k largest keys: (..., k) float32.
        mass: masses of all groups and, last, of all valid keys: (..., group + 1) float32, or None when they are not
            wanted.
        shares: how much each key takes.
    """

    entropy: NDArray[np.float32]
    top: NDArray[np.float32]
    mass: NDArray[np.float32] | None
    shares: KeyShares

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays by name, in C order."""
        found = {"entropy": self.entropy, "top": self.top, **vars(self.shares)}
        if self.mass is not None:
            found["mass"] = self.mass
        return {name: np.ascontiguousarray(array) for name, array in found.items()}

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> RowMeasures:
        """The measures with these `arrays`."""
        shares = KeyShares(arrays["above"], arrays["held"], arrays["uniform"])
        return cls(arrays["entropy"], arrays["top"], arrays.get("mass"), shares)

    @classmethod
    def empty(
        cls,
        item: SelectedEpisode,
        selection: Selection,
        options: RowOptions,
        uniform: UniformShares,
        num_entropies: int,
        num_masses: int | None = None,
    ) -> RowMeasures:
        """Arrays that `measure_rows` fills."""
        cells = (item.tokens.num_replans, len(selection.layers), len(selection.denoise), len(selection.heads))
        return cls(
            np.empty((*cells, num_entropies), np.float32),
            np.empty((*cells, len(options.top)), np.float32),
            None if num_masses is None else np.empty((*cells, num_masses), np.float32),
            KeyShares.empty(item, selection, uniform),
        )


def measure_rows(
    item: SelectedEpisode,
    resolved: ResolvedGrouping,
    selection: Selection,
    site: str,
    options: RowOptions,
    shown: Sequence[str],
    uniform: UniformShares,
    out: RowMeasures,
) -> None:
    """Read an episode's rows once, a layer and a denoise step at a time; rows are means over the stored queries.

    Args:
        item: the episode.
        resolved: the groups on its keys.
        selection: layers, denoise steps and heads; heads are always kept apart.
        site: the softmax family.
        options: what is measured.
        shown: the groups inside which an entropy is wanted, over their valid keys.
        uniform: what uniform attention gives the episode's keys.
        out: is filled; with masses where it has an array for them.
    """
    valid = item.valid
    weights = with_valid(resolved.weights, valid)
    # Half of the keys of a usual site are never valid: without them the measures take half the time.
    used = np.flatnonzero(valid.any(axis=0))
    inside = valid[:, used]
    columns = [*(resolved.names.index(name) for name in shown), weights.shape[2] - 1]
    within = np.ascontiguousarray(weights[:, used][:, :, columns] * inside[:, :, None])
    for part in layer_rows(item.store.attributes, item.episode, selection, site, per_head=True):
        rows = part.rows if len(used) == part.rows.shape[2] else part.rows[:, :, used]
        out.entropy[:, part.layer, part.denoise] = entropies(rows, within)
        out.top[:, part.layer, part.denoise] = top_mass(rows, inside, options.top)
        if out.mass is not None:
            out.mass[:, part.layer, part.denoise] = masses(part.rows, weights)
        limit = options.rule.factor * uniform.at(part.layer, part.denoise)
        limit = limit[..., used] if limit.shape[-1] > 1 else limit
        out.shares.add(part.layer, rows, inside, limit, selection, used)


def row_tables(
    items: Sequence[SelectedEpisode],
    measures: Sequence[RowMeasures],
    shown: Sequence[str],
    selection: Selection,
    options: RowOptions,
) -> Tables:
    """Every row (episode, replan, layer, denoise step, head).

    Returns:
        cells: row (its number), suite, task_id, episode_index, replan, layer, block, denoise_step, head; `entropy`
            (nats) and `effective_keys` (its exp) over the valid keys; `top{k}_mass`, the share of the valid keys' mass
            on the k largest.
        groups: row, group, `entropy` and `effective_keys` inside each group, over its valid keys; null where it has no
            mass or no such key. There are millions of them: they name their cell by its number alone.
    """
    axes_of = replace(selection, per_head=True)
    of_replan = len(selection.layers) * len(selection.denoise) * len(selection.heads)
    ends = np.cumsum([0, *(item.tokens.num_replans * of_replan for item in items)]).tolist()

    def part(i: int) -> Tables:
        measured, first, end = measures[i], ends[i], ends[i + 1]
        return Tables(lambda: cells(items[i], measured, first), lambda: groups(measured, first, end))

    def cells(item: SelectedEpisode, measured: RowMeasures, first: int) -> pl.DataFrame:
        entropy = measured.entropy[..., len(shown)]
        values = {"entropy": entropy, "effective_keys": effective_keys(entropy)}
        values |= {f"top{k}_mass": measured.top[..., j] for j, k in enumerate(options.top)}
        axes = [{"replan": range(len(entropy))}, layer_axis(axes_of), denoise_axis(axes_of), head_axis(axes_of)]
        return long_table(item, axes, values).with_row_index("row", first)

    def groups(measured: RowMeasures, first: int, end: int) -> pl.DataFrame:
        entropy = measured.entropy[..., : len(shown)].ravel()
        table = pl.DataFrame(
            {
                "row": np.repeat(np.arange(first, end, dtype=np.uint32), len(shown)),
                "group": pl.Series(shown, dtype=pl.Enum(shown)).gather(np.tile(np.arange(len(shown)), end - first)),
                "entropy": entropy,
                "effective_keys": effective_keys(entropy),
            }
        )
        return table.with_columns(pl.col(pl.Float32).fill_nan(None))

    return tables_of_each(range(len(items)), part)


def episode_layer_means(rows: Tables) -> Tables:
    """Means of `row_tables` over replans, denoise steps and heads, float64.

    Returns:
        cells: suite, task_id, episode_index, layer, block and the measures; groups: the same names, group, entropy,
            effective_keys.
    """
    keys = (*EPISODE_ID, "layer", "block")
    names = rows.group_names()
    cells, groups = [], []

    def means(part: pl.DataFrame) -> pl.DataFrame:
        measured = pl.col(pl.Float32).mean().cast(pl.Float64)
        return part.group_by(keys, maintain_order=True).agg(measured)

    for tables in rows.parts:
        part, of_part = tables.cells, tables.groups
        cells.append(means(part))
        for i, name in enumerate(names):
            own = of_part.gather_every(len(names), i).select("entropy", "effective_keys")
            groups.append(means(part.select(keys).hstack(own)).with_columns(pl.lit(name).alias("group")))
    empty = pl.DataFrame(schema={**cells[0].select(keys).schema, "group": pl.String})
    return Tables(
        pl.concat(cells).sort(EPISODE_ID, maintain_order=True),
        (pl.concat(groups) if groups else empty).sort(EPISODE_ID, maintain_order=True),
    )


def groups_with_valid_keys(items: Sequence[SelectedEpisode], resolved: Sequence[ResolvedGrouping]) -> tuple[str, ...]:
    """The groups that have a valid key in an episode; only these have an entropy."""
    having: set[int] = set()
    for item, groups in zip(items, resolved, strict=True):
        # At the same replan: a key of the prompt may be in the group at one replan and valid at another only.
        there = ((groups.weights > 0) & item.valid[:, :, None]).any(axis=(0, 1))
        having |= set(np.flatnonzero(there).tolist())
    return tuple(name for i, name in enumerate(resolved[0].names) if i in having)


def measure_all_rows(
    question: Question,
    resolved: Sequence[ResolvedGrouping],
    options: RowOptions,
    shown: Sequence[str],
    with_masses: bool = False,
) -> Sequence[RowMeasures]:
    """`measure_rows` of every episode, kept on disk; shows progress."""
    num_masses = len(question.grouping.names) + 1 if with_masses else None
    scan = partial(
        _episode_measures,
        selection=question.selection,
        site=question.site,
        options=options,
        shown=shown,
        num_masses=num_masses,
    )
    with progress_bar(len(question.selected), "episodes' rows") as advance:

        def measure(positions: Sequence[int]) -> Iterator[dict[str, NDArray[Any]]]:
            return each_episode(scan, ((question.selected[i], resolved[i]) for i in positions), advance)

        measured = measured_once(
            "rows",
            f"entropy, top keys and shares of keys of grouping {question.grouping.name}",
            question.selected,
            replace(question.selection, per_head=True),
            question.site,
            measure,
            {
                "top": options.top,
                "factor": options.rule.factor,
                "groups": resolved[0].names,
                "shown": list(shown),
                "masses": with_masses,
            },
            [digest_of_weights(groups) for groups in resolved],
            advance,
        )
        kept = OnDisk(measured)
    return MadeWhenAsked(lambda i: RowMeasures.of(kept[i]), range(len(kept)))


def _episode_measures(
    pair: tuple[SelectedEpisode, ResolvedGrouping],
    selection: Selection,
    site: str,
    options: RowOptions,
    shown: Sequence[str],
    num_masses: int | None,
) -> dict[str, NDArray[Any]]:
    """The arrays of `measure_rows` of one episode."""
    uniform = UniformShares.of(pair[0], selection)
    out = RowMeasures.empty(pair[0], selection, options, uniform, len(shown) + 1, num_masses)
    measure_rows(*pair, selection, site, options, shown, uniform, out)
    return out.arrays()


def row_metrics(question: Question, options: RowOptions | None = None) -> Tables:
    """Entropy, effective keys and top-k mass of every stored row; see `row_tables`."""
    chosen = options or RowOptions()
    resolved = resolve_all(question.grouping, question.selected, question.vocabulary)
    shown = groups_with_valid_keys(question.selected, resolved)
    measures = measure_all_rows(question, resolved, chosen, shown)
    return row_tables(question.selected, measures, shown, question.selection, chosen)
