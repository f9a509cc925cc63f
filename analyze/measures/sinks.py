"""Sinks: keys that take far more than their share in most rows, and masses without them.

The rule. In a row whose n valid keys hold the mass S, the uniform share of a key is S / n. A key is a sink of a task
when it takes more than `factor` times that share in at least the share `share` of the task's rows (every selected
replan, layer, denoise step and head; the mean over the task's episodes, which weigh the same). It is the metric of Gu
et al. (2024), "When Attention Sink Emerges in Language Models", section 3: the share of heads in which a key's
attention exceeds a threshold. Their threshold is 0.3; here it is relative to the uniform share, because a row may have
thirty keys or a thousand. Xiao et al. (2023), "Efficient Streaming Language Models with Attention Sinks", found that
such keys get attention that no other key needs, whatever they hold.

Sinks are found per task, because the text depends on the instruction and the scene on the task. The rule cannot tell a
sink from a key that deserves attention in most rows: look at the listed keys before you use a corrected number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.show.progress import progress_bar
from vla_attention.analyze.stores.parallel import map_episodes
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.groupings.resolve import describe_key
from vla_attention.schemas.layout import Role

DEFAULT_FACTOR = 10.0
DEFAULT_SHARE = 0.5
#: A value that exceeds a limit by less than this share of it may exceed it by rounding only.
_ROUNDING = 5e-6


@dataclass(frozen=True)
class SinkRule:
    """When a key is a sink: more than `factor` times its uniform share in at least the share `share` of the rows.

    Raises `BadArgument` for a factor below 1 or a share outside (0, 1].
    """

    factor: float = DEFAULT_FACTOR
    share: float = DEFAULT_SHARE

    def __post_init__(self) -> None:
        """Check factor and share."""
        if not 1.0 <= self.factor < np.inf:
            raise BadArgument(
                f"The sink factor {self.factor:g} must be at least 1: at 1 a key takes its uniform share."
            )
        if not 0.0 < self.share <= 1.0:
            raise BadArgument(f"The sink share {self.share:g} is no share of rows; expected more than 0 and at most 1.")

    def __str__(self) -> str:
        return f"more than {self.factor:g} x the uniform share in at least {self.share:.0%} of the rows"


@dataclass(frozen=True)
class KeyShares:
    """How much each key of an episode takes, and in how many rows it takes more than the factor allows.

    Attributes:
        above: share of the rows in which the key takes more than the factor, shape (key,).
        held: mean over rows of the key's share in the mass of the valid keys, shape (key,).
    """

    above: NDArray[np.float64]
    held: NDArray[np.float64]


def key_sums(
    rows: NDArray[np.float32], valid: NDArray[np.bool_], factor: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Number of rows in which a key takes more than factor / n of the mass of the n valid keys, and its summed share.

    Args:
        rows: probabilities (replan, head, key).
        valid: (replan or 1, key). A row without any mass counts for nothing.
        factor: multiple of the uniform share.

    Returns:
        Two arrays of shape (key,): number of rows, and the sum over rows of p_k / S.
    """
    seen = rows if valid.all() else rows * valid[:, None, :]
    total = seen.sum(axis=2, dtype=np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(total > 0, 1.0 / total, 0.0).astype(np.float32)
        limit = np.where(total > 0, factor * total / valid.sum(axis=1)[:, None], np.inf)
    # Sums in float32 err by some 1e-6: with a factor of 1, keys that share evenly must not exceed their share.
    limit = (limit * (1.0 + _ROUNDING)).astype(np.float32)
    above = (seen > limit[:, :, None]).sum(axis=(0, 1))
    held = inverse.reshape(1, -1) @ seen.reshape(-1, seen.shape[2])
    return above, held[0].astype(np.float64)


def episode_key_shares(item: SelectedEpisode, selection: Selection, site: str, rule: SinkRule) -> KeyShares:
    """Read an episode's rows once. A block that was named by two layer numbers counts once."""
    valid = item.valid
    above, held, count = np.zeros(valid.shape[1], np.int64), np.zeros(valid.shape[1]), 0
    for part in layer_rows(item.episode, selection, site):
        if selection.is_first_of_block(part.layer):
            more, mass = key_sums(part.rows, valid, rule.factor)
            above, held, count = above + more, held + mass, count + part.rows.shape[0] * part.rows.shape[1]
    return KeyShares(above / count, held / count)


def key_shares_table(question: Question, shares: Sequence[KeyShares]) -> pl.DataFrame:
    """One row per (task, key that is valid in one of its episodes), episodes weighing the same.

    Columns: suite, task_id, num_episodes; key, span, role (the commonest over the replans at which the key is valid),
    patch_row, patch_column (null unless the key is a patch), description (in words); share_of_rows, mean_mass (share of
    the valid keys' mass), times_uniform (mean_mass x mean number of valid keys).
    """
    frames = []
    for (suite, task), positions in _tasks(question).items():
        items = [question.selected[i] for i in positions]
        above = np.mean([shares[i].above for i in positions], axis=0)
        held = np.mean([shares[i].held for i in positions], axis=0)
        valid = [item.valid for item in items]
        num_valid = np.mean([part.sum(axis=1).mean() for part in valid])
        keys = np.flatnonzero(np.any([part.any(axis=0) for part in valid], axis=0))
        described = pl.DataFrame([_describe(int(key), items, valid) for key in keys], schema=_DESCRIPTION, orient="row")
        frames.append(
            described.select(
                pl.lit(suite).alias("suite"),
                pl.lit(task, dtype=pl.Int64).alias("task_id"),
                pl.lit(len(items), dtype=pl.Int64).alias("num_episodes"),
                pl.all(),
                pl.Series("share_of_rows", above[keys]),
                pl.Series("mean_mass", held[keys]),
                pl.Series("times_uniform", held[keys] * num_valid),
            )
        )
    return pl.concat(frames)


def sinks_of(key_shares: pl.DataFrame, rule: SinkRule) -> pl.DataFrame:
    """The rows of `key_shares_table` that are sinks, the strongest of each task first."""
    # A share is a mean of quotients: rounding must not put one half below 0.5.
    found = key_shares.filter(pl.col("share_of_rows") >= rule.share - 1e-9)
    return found.sort("suite", "task_id", "mean_mass", "key", descending=[False, False, True, False])


def sinks_table(question: Question, rule: SinkRule | None = None) -> pl.DataFrame:
    """The sinks of every task, in the columns of `key_shares_table`. Reads all selected rows once."""
    rule = rule or SinkRule()

    def measure(item: SelectedEpisode) -> KeyShares:
        return episode_key_shares(item, question.selection, question.site, rule)

    with progress_bar(len(question.selected), "episodes searched for sinks") as advance:
        shares = map_episodes(measure, question.selected, advance)
    return sinks_of(key_shares_table(question, shares), rule)


def without_sinks(question: Question, sinks: pl.DataFrame, rule: SinkRule) -> Question:
    """The same question with every task's sinks taken out of all groups and of the valid keys.

    Masses, fractions, lifts, ratios and uniform baselines then all are those of the remaining keys. The grouping is
    called NAME-without-sinks, so that its results are not taken for those with all keys, and a note says what was taken
    out. Norms of contributions cannot be corrected: their Gram matrices are of whole segments.
    """
    keys: dict[tuple[str, int], tuple[int, ...]] = {}
    for suite, task, key in sinks.select("suite", "task_id", "key").iter_rows():
        keys[suite, task] = (*keys.get((suite, task), ()), key)
    selected = tuple(
        replace(item, without=tuple(sorted({*item.without, *keys.get(_task_of(item), ())})))
        for item in question.selected
    )
    grouping = replace(question.grouping, name=f"{question.grouping.name}-without-sinks")
    notes = (*question.notes, describe_sinks(sinks, len(_tasks(question)), rule))
    return replace(question, selected=selected, grouping=grouping, notes=notes)


def merged_sinks(sinks: pl.DataFrame) -> pl.DataFrame:
    """Sinks over tasks, one row per (key, description): num_tasks, and means over those tasks of the three numbers."""
    numbers = ("share_of_rows", "mean_mass", "times_uniform")
    merged = sinks.group_by("key", "span", "role", "description", maintain_order=True).agg(
        pl.struct("suite", "task_id").n_unique().cast(pl.Int64).alias("num_tasks"),
        *(pl.col(name).mean() for name in numbers),
    )
    return merged.sort("num_tasks", "mean_mass", "key", descending=[True, True, False])


def describe_sinks(sinks: pl.DataFrame, num_tasks: int, rule: SinkRule) -> str:
    """The keys that were taken out, as a sentence for a summary."""
    if sinks.is_empty():
        return f"Without sinks: no key takes {rule}, so nothing was taken out."
    of = f"of {num_tasks} tasks" if num_tasks > 1 else "of the one task"
    named = [
        f"{row['description']} ({row['role']}; in {row['num_tasks']} {of}, {row['mean_mass']:.1%} of the mass)"
        for row in merged_sinks(sinks).iter_rows(named=True)
    ]
    return (
        f"Without sinks, keys that take {rule}: {listing(named, 6)} {'is' if len(named) == 1 else 'are'} out of every "
        "group and of the valid keys (but not of norms of contributions)."
    )


#: Columns that describe a key.
_DESCRIPTION = {
    "key": pl.Int64,
    "span": pl.String,
    "role": pl.String,
    "patch_row": pl.Int64,
    "patch_column": pl.Int64,
    "description": pl.String,
}


def _describe(
    key: int, items: Sequence[SelectedEpisode], valid: Sequence[NDArray[np.bool_]]
) -> tuple[int, str, str, int | None, int | None, str]:
    """The columns `_DESCRIPTION` of a key in a task's episodes; `valid`: each episode's valid keys (replan or 1, key).

    Prompts differ in length: a key may be a state digit at one replan and padding at another. Its role is the commonest
    over the replans at which it is valid.
    """
    roles = [item.tokens.static_roles[part[:, key], key] for item, part in zip(items, valid, strict=True)]
    role = Role(int(np.bincount(np.concatenate(roles)).argmax())).label
    tokens = next(item.tokens for item, own in zip(items, roles, strict=True) if own.size)
    span = next(span for span in tokens.layout.spans if span.start <= key < span.stop)
    if span.grid is None:
        return key, span.name, role, None, None, describe_key(key, tokens)
    row, column = divmod(key - span.start, span.grid.columns)
    return key, span.name, role, row, column, f"{describe_key(key, tokens)}, patch ({row}, {column})"


def _task_of(item: SelectedEpisode) -> tuple[str, int]:
    return item.store.suite, item.episode.attributes.task_id


def _tasks(question: Question) -> dict[tuple[str, int], list[int]]:
    """Positions of each task's episodes."""
    tasks: dict[tuple[str, int], list[int]] = {}
    for i, item in enumerate(question.selected):
        tasks.setdefault(_task_of(item), []).append(i)
    return dict(sorted(tasks.items()))
