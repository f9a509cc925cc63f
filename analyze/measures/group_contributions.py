"""What the keys of each group of a grouping add to the residual stream at one site, from stored Gram matrices.

The matrices are of whole segments (a span's keys of one role), because contributions add up as vectors and not as lengths: the
norm of a union of segments is sqrt(wᵀ G w). A group that takes part of a segment only (a word, a patch, an object) has none.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.aggregate import LAYERS_AVG
from vla_attention.analyze.measures.contributions import joint_norm, selected_gram
from vla_attention.analyze.measures.masses import ratio
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.ratios.summary import WIDTH
from vla_attention.analyze.show.numbers import format_interval, format_number
from vla_attention.analyze.show.text_table import text_table
from vla_attention.analyze.statistics.bootstrap import POSITIVE
from vla_attention.analyze.statistics.episode_intervals import means_with_intervals
from vla_attention.analyze.stores.parallel import map_episodes
from vla_attention.schemas.errors import listing
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import ResolvedGrouping
from vla_attention.schemas.segments import segment_members, weights_on_segments

_EPISODE = ("suite", "task_id", "episode_index")


def whole_segments(item: SelectedEpisode, resolved: ResolvedGrouping, site: str) -> dict[str, NDArray[np.bool_]]:
    """By group, which parts of the Gram matrix are its own, (part,) bool; groups that cut a segment are left out.

    A group must take a segment whole or not at all, and the same ones at every replan that has the segment. The matrix's last
    part is the block's whole update, and belongs to no group.
    """
    tokens, segments = item.tokens, item.episode.attributes.segments[site]
    members = segment_members(tokens.layout, tokens.static_roles, segments)
    present = members.any(axis=1)
    parts = {}
    for i, name in enumerate(resolved.names):
        weights = weights_on_segments(resolved.weights[:, :, i : i + 1], members)
        if weights is None:
            continue
        taken = weights[:, :, 0].max(axis=0)
        if np.isin(taken, (0.0, 1.0)).all() and (~present | (weights[:, :, 0] == taken)).all():
            parts[name] = np.array([*(taken == 1.0), False])
    return parts


def group_contribution_table(question: Question, resolved: Sequence[ResolvedGrouping]) -> pl.DataFrame | None:
    """Norms for every (episode, replan, layer, denoise step), or None when nothing was recorded or every group cuts a segment.

    Columns: suite, task_id, episode_index, replan, env_step, layer, block, denoise_step; `{group}_norm` for every group that is
    made of whole segments in all episodes; and, when the grouping has a ratio of such groups, numerator_norm,
    denominator_norm (of the vector sum of a side's groups) and contribution_ratio, their quotient. Norms are root mean
    squares over the action queries.
    """
    if not all(store.attributes.recording.contributions for store in question.stores):
        return None
    chosen = [
        whole_segments(item, groups, question.site) for item, groups in zip(question.selected, resolved, strict=True)
    ]
    # A group that cannot be measured in one episode would be a mean over the others only.
    names = [name for name in question.grouping.names if all(name in parts for parts in chosen)]
    if not names:
        return None
    return pl.concat(
        map_episodes(
            lambda pair: _episode_frame(pair[0], {name: pair[1][name] for name in names}, question),
            list(zip(question.selected, chosen, strict=True)),
        )
    )


def _episode_frame(item: SelectedEpisode, parts: Mapping[str, NDArray[np.bool_]], question: Question) -> pl.DataFrame:
    selection, grouping = question.selection, question.grouping
    gram = selected_gram(item.episode, question.site, selection)
    norms = {f"{name}_norm": joint_norm(gram, taken) for name, taken in parts.items()}
    if grouping.ratio is not None and {*grouping.ratio.numerator, *grouping.ratio.denominator} <= parts.keys():
        above, below = (
            joint_norm(gram, np.any([parts[name] for name in side], axis=0))
            for side in (grouping.ratio.numerator, grouping.ratio.denominator)
        )
        norms |= {"numerator_norm": above, "denominator_norm": below, "contribution_ratio": ratio(above, below)}
    replans, layers, steps = gram.shape[:3]
    grid = {
        "replan": np.repeat(np.arange(replans), layers * steps),
        "env_step": np.repeat(item.episode.read("env_step").astype(np.int64), layers * steps),
        "layer": np.tile(np.repeat(np.array(selection.layer_labels, dtype=np.int64), steps), replans),
        "block": np.tile(np.repeat(np.array(selection.blocks, dtype=np.int64), steps), replans),
        "denoise_step": np.tile(np.array(selection.denoise_steps, dtype=np.int64), replans * layers),
    }
    attributes = item.episode.attributes
    frame = pl.DataFrame(grid | {name: values.ravel() for name, values in norms.items()}).fill_nan(None)
    return frame.select(
        pl.lit(item.store.suite).alias("suite"),
        pl.lit(attributes.task_id, dtype=pl.Int64).alias("task_id"),
        pl.lit(attributes.episode_index, dtype=pl.Int64).alias("episode_index"),
        pl.all(),
    )


def summarise_group_contributions(table: pl.DataFrame | None, grouping: Grouping, site: str, seed: int) -> str:
    """The summary's section: per layer the mean norms of the groups and the ratio of norms with a two-level interval (95 %)."""
    title = f"CONTRIBUTIONS OF GROUPS  norms of what they add to the residual stream at site '{site}'"
    measured = [name for name in grouping.names if table is not None and f"{name}_norm" in table.columns]
    cut = [name for name in grouping.names if name not in measured]
    note = (
        f"Not of {listing(cut)}: contributions are stored for whole segments (a span's keys of one role), and "
        f"{'this group takes' if len(cut) == 1 else 'these groups take'} parts of segments."
        if cut
        else ""
    )
    if table is None:
        return "\n".join([title, "-" * WIDTH, *textwrap.wrap(note, WIDTH), ""])
    shown = [name for name in measured if (table[f"{name}_norm"] > 0).any()]
    nothing = [name for name in measured if name not in shown]
    if nothing:
        note = f"Exactly nothing is added by {listing(nothing)}. {note}".strip()
    has_ratio = "contribution_ratio" in table.columns
    rows = []
    for row in _means_by_layer(table, shown, has_ratio, seed):
        cells = [row["layer"], *(format_number(row[f"{name}_norm"]) for name in shown)]
        if has_ratio:
            bounds = format_interval(row["contribution_ratio_low"], row["contribution_ratio_high"])
            cells += [format_number(row["contribution_ratio"]), bounds]
        rows.append(cells)
    header = ["layer", *(f"|{name}|" for name in shown), *(["ratio", "95% interval"] if has_ratio else [])]
    lines = [title, "-" * WIDTH, text_table(header, rows, left=(0,))]
    return "\n".join([*lines, *(["", *textwrap.wrap(note, WIDTH)] if note else []), ""])


def _means_by_layer(table: pl.DataFrame, shown: Sequence[str], has_ratio: bool, seed: int) -> list[dict]:
    columns = [*(f"{name}_norm" for name in shown), *(["contribution_ratio"] if has_ratio else [])]
    finite = [
        pl.col(name).filter(pl.col(name).is_finite()).mean() if name == "contribution_ratio" else pl.col(name).mean()
        for name in columns
    ]
    # A block that was named by two layer numbers counts once in the average over layers.
    once = table.unique([*_EPISODE, "replan", "block", "denoise_step"], maintain_order=True)
    together = pl.concat(
        [
            table.with_columns(pl.col("layer").cast(pl.String)),
            once.with_columns(pl.lit(LAYERS_AVG).alias("layer")),
        ]
    )
    episodes = together.group_by(*_EPISODE, "layer", maintain_order=True).agg(finite)
    values = dict.fromkeys(columns, POSITIVE)
    return list(means_with_intervals(episodes, ["layer"], values, seed).iter_rows(named=True))
