"""Sinks: keys that take far more than their share in a head, and masses without the widespread ones.

The rule. In a row whose valid keys hold the mass S, the uniform share of a key is what uniform attention gives it of S:
S / n where every query sees the same n of them (`schemas/groupings/key_counts.py`). A key is a sink of one head of one
layer, for one task, when over the rows of that head (every selected replan and denoise step; episodes weigh the
same)

    by multiple   it takes more than `factor` times its uniform share in at least the share `share` of the rows, or
    by mass       its mean share of the row exceeds `mass`, and twice its uniform share.

By mass is the metric of Gu et al. (2024), "When Attention Sink Emerges in Language Models", section 3, with their
threshold 0.3: the share of heads in which a key's mean attention exceeds it. By multiple finds keys that take 5 % of
500. With `factor` or fewer valid keys it cannot fire, because a key would have to take more than the whole row: such
sites are judged by mass alone, and the text says so. Xiao et al. (2023), "Efficient Streaming Language Models with
Attention Sinks", found that such keys get attention that no other key needs, whatever they hold.

Heads differ: a key can take half of one head's rows and nothing of another's, and its mean over heads then shows
nothing. A key that is a sink in one head alone may be what this head looks for, however. `--without-sinks` therefore
takes out keys that are sinks in at least the share `heads` of the selected layers' heads (`widespread`), for all heads.

Keys of the policy's own actions are none: the action queries compute these keys with each other, and the keys are on no
side of a ratio of pictures and words.

Sinks are found per task, because the text depends on the instruction and the scene on the task. The rule cannot tell a
sink from a key that deserves attention in most rows: look at the listed keys before you use a corrected number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.baselines import uniform_keys
from vla_attention.analyze.measures.kept import measured_once
from vla_attention.analyze.measures.not_in_memory import MadeWhenAsked, OnDisk
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode, positions_by_task
from vla_attention.analyze.measures.sink_kinds import value_ratios
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import BadArgument, listing, plural, unknown_name
from vla_attention.schemas.groupings.resolve import describe_key
from vla_attention.schemas.layout import Role
from vla_attention.schemas.progress_bar import progress_bar

DEFAULT_FACTOR = 10.0
DEFAULT_SHARE = 0.5
DEFAULT_MASS = 0.3
DEFAULT_HEADS = 0.25
#: A value that exceeds a limit by less than this share of it may exceed it by rounding only.
_ROUNDING = 5e-6


@dataclass(frozen=True)
class SinkRule:
    """When a key is a sink of a head, and in how large a share of the heads it is a widespread one; see the module.

    Raises `BadArgument` for a factor below 1, or a share outside (0, 1].
    """

    factor: float = DEFAULT_FACTOR
    share: float = DEFAULT_SHARE
    mass: float = DEFAULT_MASS
    heads: float = DEFAULT_HEADS

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not 1.0 <= self.factor < np.inf:
            raise BadArgument(
                f"The sink factor {self.factor:g} must be at least 1: at 1 a key takes its uniform share."
            )
        shares = (("share", self.share, "rows"), ("mass", self.mass, "a row"), ("heads", self.heads, "heads"))
        for name, value, of in shares:
            if not 0.0 < value <= 1.0:
                raise BadArgument(f"The sink {name} {value:g} is no share of {of}; expected more than 0 and at most 1.")

    @classmethod
    def parse(cls, text: str) -> SinkRule:
        """The rule that `factor=10,share=0.5` gives; parts that are not named keep their defaults."""
        given: dict[str, float] = {}
        for part in filter(None, text.split(",")):
            name, _, value = part.partition("=")
            if name.strip() not in cls.__dataclass_fields__:
                raise unknown_name("part of a sink rule", name.strip(), cls.__dataclass_fields__)
            try:
                given[name.strip()] = float(value)
            except ValueError:
                raise BadArgument(f"Cannot read '{part}' of a sink rule; expected NAME=NUMBER, as factor=10.") from None
        return cls(**given)

    def __str__(self) -> str:
        return (
            f"more than {self.factor:g} x the uniform share in at least {self.share:.0%} of a head's rows, or on "
            f"average more than {self.mass:.0%} of a row (then also more than twice its uniform share)"
        )


@dataclass(frozen=True)
class KeyShares:
    """How much each key of an episode takes in each head; `layer` counts blocks once.

    Attributes:
        above: share of the rows in which the key takes more than the factor, shape (layer, head, key) float32.
        held: mean over rows of the key's share in the mass of the valid keys, shape (layer, head, key) float32.
        uniform: mean over rows of what uniform attention gives the key of that mass, shape (layer or 1, head or 1, key)
            float32: 1 / the number of valid keys where every query sees the same.
    """

    above: NDArray[np.float32]
    held: NDArray[np.float32]
    uniform: NDArray[np.float32]

    @classmethod
    def empty(cls, item: SelectedEpisode, selection: Selection, uniform: UniformShares) -> KeyShares:
        """Zeros, to which `add` adds, and what uniform attention gives."""
        shape = (len(layers_once(selection)), len(selection.heads), item.tokens.layout.num_keys)
        return cls(np.zeros(shape, np.float32), np.zeros(shape, np.float32), uniform.means(selection))

    def add(
        self,
        layer: int,
        rows: NDArray[np.float32],
        valid: NDArray[np.bool_],
        limit: NDArray[np.float64],
        selection: Selection,
        keys: NDArray[np.int64] | slice = slice(None),
    ) -> None:
        """Count the rows (replan, head, key) of a layer (position in the selection) at one of its denoise steps.

        A block that was named by two layer numbers counts once. `limit`: see `key_sums`. `keys`: which keys the rows
        are of.
        """
        if selection.is_first_of_block(layer):
            above, held = key_sums(rows, valid, limit)
            count, at = rows.shape[0] * len(selection.denoise), layers_once(selection).index(layer)
            self.above[at][:, keys] += (above / count).astype(np.float32)
            self.held[at][:, keys] += (held / count).astype(np.float32)


@dataclass(frozen=True)
class SinkSearch:
    """Which keys are sinks of which heads; see `search_of`."""

    keys: pl.DataFrame
    heads: pl.DataFrame

    @property
    def sinks(self) -> pl.DataFrame:
        """The rows of `keys` that are a sink of a head, the strongest of each task first."""
        found = self.keys.filter(pl.col("sink_heads") > 0)
        return found.sort("suite", "task_id", "mean_mass", "key", descending=[False, False, True, False])

    @property
    def num_valid(self) -> float:
        """Mean number of valid keys, of the task with most."""
        return float(max(self.keys["num_valid"].to_list()))


def layers_once(selection: Selection) -> list[int]:
    """Positions of the selected layers, without those that name a block again."""
    return [i for i in range(len(selection.layers)) if selection.is_first_of_block(i)]


@dataclass(frozen=True)
class UniformShares:
    """What uniform attention gives every key of an episode, as a share of what it gives all valid keys.

    Attributes:
        shares: (replan or 1, layer or 1, denoise or 1, head or 1, key); 0 for a key that no query sees.
    """

    shares: NDArray[np.float64]

    @classmethod
    def of(cls, item: SelectedEpisode, selection: Selection) -> UniformShares:
        """Those of an episode; heads are kept apart."""
        uniform, valid = uniform_keys(item, replace(selection, per_head=True)), item.valid[:, None, None, None]
        of_valid = (uniform * valid).sum(axis=-1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.where(of_valid > 0, uniform / of_valid, 0.0)
        # A key that is valid at some replans only takes nothing at the others, and its mean counts them.
        return cls(np.where(valid, shares, 1.0 / np.maximum(item.num_valid, 1)[:, None, None, None, None]))

    def at(self, layer: int, denoise: int) -> NDArray[np.float64]:
        """Shares (replan or 1, head or 1, key) at positions of the selection; one for all keys where they are alike."""
        _, layers, steps, _, _ = self.shares.shape
        here = self.shares[:, layer if layers > 1 else 0, denoise if steps > 1 else 0]
        highest = here.max(axis=-1, keepdims=True)
        return highest if ((here == 0) | (here >= highest * (1.0 - _ROUNDING))).all() else here

    def means(self, selection: Selection) -> NDArray[np.float32]:
        """`KeyShares.uniform`."""
        means: NDArray[np.float32] = self.shares.mean(axis=(0, 2)).astype(np.float32)
        return means[layers_once(selection)] if len(means) > 1 else means


def key_sums(
    rows: NDArray[np.float32], valid: NDArray[np.bool_], limit: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Number of rows in which a key takes more than its limit of the mass of the valid keys, and its summed share.

    Args:
        rows: probabilities (replan, head, key).
        valid: (replan or 1, key). A row without any mass counts for nothing.
        limit: share (replan or 1, head or 1, key or 1).

    Returns:
        Two arrays of shape (head, key): number of rows, and the sum over rows of p_k / S.
    """
    seen = rows if valid.all() else rows * valid[:, None, :]
    total = seen.sum(axis=2, dtype=np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(total > 0, 1.0 / total, 0.0).astype(np.float32)
    # Sums in float32 err by some 1e-6: with a factor of 1, keys that share evenly must not exceed their share.
    most = np.where(total > 0, total, np.inf)[:, :, None] * (limit * (1.0 + _ROUNDING))
    above = (seen > most.astype(np.float32)).sum(axis=0)
    held = np.matmul(inverse.T[:, None, :], seen.transpose(1, 0, 2))[:, 0]
    return above, held.astype(np.float64)


def episode_key_shares(item: SelectedEpisode, selection: Selection, site: str, rule: SinkRule) -> KeyShares:
    """Read an episode's rows once."""
    valid, uniform = item.valid, UniformShares.of(item, selection)
    shares = KeyShares.empty(item, selection, uniform)
    for part in layer_rows(item.store.attributes, item.episode, selection, site, per_head=True):
        limit = rule.factor * uniform.at(part.layer, part.denoise)
        shares.add(part.layer, part.rows, valid, limit, selection)
    return shares


def search_of(question: Question, shares: Sequence[KeyShares], rule: SinkRule) -> SinkSearch:
    """Both tables of a search, episodes of a task weighing the same.

    Returns:
        keys: one row per (task, key that is valid in one of its episodes): suite, task_id, num_episodes; key, span,
            role (the commonest over the replans at which the key is valid), patch_row, patch_column (null unless the
            key is a patch), description (in words); num_valid (mean number of valid keys); share_of_rows (in which it
            takes more than the factor), mean_mass (share of the valid keys' mass), times_uniform (mean_mass / what
            uniform attention gives the key; null for one that no query sees), largest_mass (mean mass in the head where
            it is largest), sink_heads (heads of layers in which it is a sink), heads_by_mass (in which it is one by
            mass), num_heads (all heads of the selected layers), widespread (sink_heads / num_heads is at least the
            rule's `heads`), value_ratio (see `sink_kinds`; null where it cannot be told).
        heads: one row per (task, key, layer, head) where the key is a sink: suite, task_id, key, layer, block, head,
            share_of_rows, mean_mass, by_mass.
    """
    selection = question.selection
    once = layers_once(selection)
    frames, heads = [], []
    for (suite, task), positions in sorted(positions_by_task(question.selected).items()):
        items = [question.selected[i] for i in positions]
        above, held, uniform = np.zeros((3, *shares[positions[0]].held.shape))
        for i in positions:
            of_episode = shares[i]
            above += of_episode.above
            held += of_episode.held
            uniform += of_episode.uniform
        above /= len(items)
        held /= len(items)
        uniform /= len(items)
        valid = [item.valid for item in items]
        num_valid = float(np.mean([item.num_valid.mean() for item in items]))
        keys = np.flatnonzero(np.any([part.any(axis=0) for part in valid], axis=0))
        described = pl.DataFrame([_describe(int(key), items, valid) for key in keys], schema=_DESCRIPTION, orient="row")
        counted = np.zeros(held.shape[2], dtype=bool)
        counted[keys] = (described["role"] != Role.ACTION.label).to_numpy()
        # Twice the uniform share: where a row has two or three valid keys, even attention exceeds the limit of mass.
        by_mass = counted & (held > np.maximum(rule.mass, 2.0 * uniform))
        # A share is a mean of quotients: rounding must not put one half below 0.5.
        is_sink = by_mass | (counted & (above >= rule.share - _ROUNDING))
        count = is_sink.sum(axis=(0, 1))
        num_heads = above.shape[0] * above.shape[1]
        labels = [pl.lit(suite).alias("suite"), pl.lit(task, dtype=pl.Int64).alias("task_id")]
        mean_mass = held.mean(axis=(0, 1))
        with np.errstate(divide="ignore", invalid="ignore"):
            times_uniform = mean_mass / uniform.mean(axis=(0, 1))
        frames.append(
            described.select(
                *labels,
                pl.lit(len(items), dtype=pl.Int64).alias("num_episodes"),
                pl.all(),
                pl.lit(num_valid).alias("num_valid"),
                pl.Series("share_of_rows", above.mean(axis=(0, 1))[keys]),
                pl.Series("mean_mass", mean_mass[keys]),
                pl.Series("times_uniform", times_uniform[keys]).fill_nan(None),
                pl.Series("largest_mass", held.max(axis=(0, 1))[keys]),
                pl.Series("sink_heads", count[keys]),
                pl.Series("heads_by_mass", by_mass.sum(axis=(0, 1))[keys]),
                pl.lit(num_heads, dtype=pl.Int64).alias("num_heads"),
                pl.Series("widespread", (count[keys] > 0) & (count[keys] >= rule.heads * num_heads - 1e-9)),
            )
        )
        layer, head, key = np.nonzero(is_sink)
        table = pl.DataFrame(
            {
                "key": key,
                "layer": np.array([selection.layer_labels[i] for i in once])[layer],
                "block": np.array([selection.blocks[i] for i in once])[layer],
                "head": np.array(selection.head_numbers)[head],
                "share_of_rows": above[layer, head, key],
                "mean_mass": held[layer, head, key],
                "by_mass": by_mass[layer, head, key],
            }
        )
        heads.append(table.sort("key", "layer", "head").select(*labels, pl.all()))
    of_heads = pl.concat(heads)
    kinds = value_ratios(question, of_heads)
    on = ["suite", "task_id", "key"]
    return SinkSearch(pl.concat(frames).join(kinds, on=on, how="left", maintain_order="left"), of_heads)


def search_sinks(question: Question, rule: SinkRule | None = None) -> SinkSearch:
    """Look for sinks in every task; reads all selected rows once."""
    rule = rule or SinkRule()
    selected, selection, site = question.selected, question.selection, question.site
    with progress_bar(len(selected), "episodes searched for sinks") as advance:

        def measure(positions: Sequence[int]) -> Iterator[dict[str, NDArray[Any]]]:
            scan = partial(_share_arrays, selection=selection, site=site, rule=rule)
            return each_episode(scan, [selected[i] for i in positions], advance)

        arguments = {"factor": rule.factor}
        arrays = measured_once("shares", selected, selection, site, measure, arguments, progress=advance)
        kept = OnDisk(arrays)
    return search_of(question, MadeWhenAsked(lambda i: KeyShares(**kept[i]), range(len(kept))), rule)


def _share_arrays(item: SelectedEpisode, selection: Selection, site: str, rule: SinkRule) -> dict[str, NDArray[Any]]:
    return vars(episode_key_shares(item, selection, site, rule))


def without_sinks(question: Question, sinks: pl.DataFrame, rule: SinkRule) -> Question:
    """The same question with every task's widespread sinks taken out of all groups and of the valid keys.

    Masses, fractions, lifts, ratios and uniform baselines then all are those of the remaining keys, in every head. The
    grouping is called NAME-without-sinks, so that its results are not taken for those with all keys, and a note says
    what was taken out. Norms of contributions cannot be corrected: their Gram matrices are of whole segments.

    Raises:
        BadArgument: no valid key of a task would be left.
    """
    keys: dict[tuple[str, int], tuple[int, ...]] = {}
    for suite, task, key in sinks.filter("widespread").select("suite", "task_id", "key").iter_rows():
        keys[suite, task] = (*keys.get((suite, task), ()), key)
    selected = tuple(
        replace(item, without=tuple(sorted({*item.without, *keys.get(item.task, ())}))) for item in question.selected
    )
    for item in selected:
        if not item.valid.any():
            raise BadArgument(
                f"Every valid key of task {item.task[1]} is a sink by this rule, so that nothing is left without "
                "sinks; give a rule that takes fewer, as --without-sinks factor=20,heads=0.5."
            )
    grouping = replace(question.grouping, name=f"{question.grouping.name}-without-sinks")
    num_valid = max(float(item.num_valid.mean()) for item in question.selected)
    notes = (*question.notes, describe_sinks(sinks, question.num_tasks, rule, num_valid))
    return replace(question, selected=selected, grouping=grouping, notes=notes)


def merged_sinks(sinks: pl.DataFrame) -> pl.DataFrame:
    """Sinks over tasks, one row per (key, description): num_tasks, and over those tasks means of the numbers.

    `heads_share` and `heads_by_mass_share` are shares of the layers' heads; `widespread` holds when it does in a task.
    """
    numbers = ("share_of_rows", "mean_mass", "times_uniform", "value_ratio")
    merged = sinks.group_by("key", "span", "role", "description", maintain_order=True).agg(
        pl.struct("suite", "task_id").n_unique().cast(pl.Int64).alias("num_tasks"),
        *(pl.col(name).mean() for name in numbers),
        pl.col("largest_mass").max(),
        (pl.col("sink_heads") / pl.col("num_heads")).mean().alias("heads_share"),
        (pl.col("heads_by_mass") / pl.col("num_heads")).mean().alias("heads_by_mass_share"),
        pl.col("widespread").any(),
    )
    return merged.sort("num_tasks", "mean_mass", "key", descending=[True, True, False])


def cannot_fire(num_valid: float, rule: SinkRule) -> str:
    """Why the rule's first part finds nothing among so few valid keys, as a sentence; empty where it can."""
    if num_valid > rule.factor:
        return ""
    return (
        f"With {num_valid:.3g} valid keys none can take more than {rule.factor:g} x its uniform share, which is all of "
        "the row: keys are judged by their mass alone; a smaller factor (--without-sinks factor=2) judges by multiples "
        "too."
    )


def describe_sinks(sinks: pl.DataFrame, num_tasks: int, rule: SinkRule, num_valid: float) -> str:
    """The keys that were taken out, as sentences for a summary; `num_valid`: most valid keys of a task."""
    out = sinks.filter("widespread")
    left = sinks.height - out.height
    also = ""
    if left:
        also = (
            f" Sinks of fewer heads stay in: {plural(left, 'key')}, counted in every task by itself (a rule "
            "with a smaller `heads` takes them out too)."
        )
    of_rule = f"{rule}, in at least {rule.heads:.0%} of the layers' heads"
    also += f" {cannot_fire(num_valid, rule)}".rstrip()
    if out.is_empty():
        return f"Without sinks: no key takes {of_rule}, so nothing was taken out.{also}"
    of = f"of {num_tasks} tasks" if num_tasks > 1 else "of the one task"
    named = [
        f"{row['description']} ({row['role']}; in {row['num_tasks']} {of}, in {row['heads_share']:.0%} of the heads, "
        f"{row['mean_mass']:.1%} of the mass)"
        for row in merged_sinks(out).iter_rows(named=True)
    ]
    return (
        f"Without sinks: {listing(named, 6)} {'is' if len(named) == 1 else 'are'} out of every group and of the valid "
        f"keys (but not of norms of contributions). A sink takes {of_rule}.{also}"
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
