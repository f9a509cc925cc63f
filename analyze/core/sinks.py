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

A sink that adds nothing takes attention without effect, and a mass that counts it misleads. One that adds as much per
unit of mass as other keys do is read. Contributions tell, where they were recorded:

    value ratio = (|c_k| / m_k) / (|c_rest| / m_rest)

the length of what the key adds per unit of its mass, over the same of all other valid keys together, from norms and
masses averaged over the task's replans, denoise steps and the blocks in which the key is a sink of a head.
Contributions are stored for segments (a span's keys of one role) and for all heads together, so that only a sink that
is a segment of its own, such as bos, has a value ratio: for one patch of a camera or one word of an instruction it
cannot be told. The other keys' vectors may cancel each other, which makes their length small and the value ratio large:
"small" is said on the safe side.

Sinks are found per task, because the text depends on the instruction and the scene on the task. The rule cannot tell a
sink from a key that deserves attention in most rows: look at the listed keys before you use a corrected number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.contributions import has_all_heads, joint_norm, segment_masses, selected_gram
from vla_attention.analyze.measures.masses import uniform_keys
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.scan import Look, scan
from vla_attention.analyze.measures.selected import SelectedEpisode, positions_by_task
from vla_attention.analyze.stores.rows import LayerRows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import BadArgument, listing, plural, unknown_name
from vla_attention.schemas.groupings.resolve import describe_key
from vla_attention.schemas.layout import INVALID_ROLES, Role
from vla_attention.schemas.segments import segment_members

Array = NDArray[Any]
#: A value that exceeds a limit by less than this share of it may exceed it by rounding only.
_ROUNDING = 5e-6


@dataclass(frozen=True)
class SinkRule:
    """When a key is a sink of a head, and in how large a share of the heads it is a widespread one; see the module.

    Raises `BadArgument` for a factor below 1, or a share outside (0, 1].
    """

    factor: float = 10.0
    share: float = 0.5
    mass: float = 0.3
    heads: float = 0.25

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not 1.0 <= self.factor < np.inf:
            raise BadArgument(f"The sink factor {self.factor:g} must be at least 1: at 1 a token takes its even share.")
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
            f"more than {self.factor:g} x the even share in at least {self.share:.0%} of a head's rows, or on "
            f"average more than {self.mass:.0%} of a row (then also more than twice its even share)"
        )


@dataclass(frozen=True)
class SinkSearch:
    """Which keys are sinks of which heads.

    Attributes:
        keys: one row per (task, key that is valid in one of its episodes): suite, task_id, num_episodes; key, span,
            role (the commonest over the replans at which the key is valid), patch_row, patch_column (null unless the
            key is a patch), description (in words); num_valid (mean number of valid keys); share_of_rows (in which it
            takes more than the factor), mean_mass (share of the valid keys' mass), times_uniform (mean_mass / what
            uniform attention gives the key; null for one that no query sees), largest_mass (mean mass in the head where
            it is largest), sink_heads (heads of layers in which it is a sink), heads_by_mass (in which it is one by
            mass), num_heads (all heads of the selected layers), widespread (sink_heads / num_heads is at least the
            rule's `heads`), value_ratio (null where it cannot be told).
        heads: one row per (task, key, layer, head) where the key is a sink: suite, task_id, key, layer, block, head,
            share_of_rows, mean_mass, by_mass.
    """

    keys: pl.DataFrame
    heads: pl.DataFrame

    @property
    def sinks(self) -> pl.DataFrame:
        """The rows of `keys` that are a sink of a head, the strongest of each task first."""
        found = self.keys.filter(pl.col("sink_heads") > 0)
        return found.sort("suite", "task_id", "mean_mass", "key", descending=[False, False, True, False])


def search_sinks(question: Question, rule: SinkRule | None = None) -> SinkSearch:
    """Look for sinks in every task, episodes of a task weighing the same; reads all selected rows once."""
    rule = rule or SinkRule()
    selected, selection = question.selected, question.selection
    arguments = {"factor": rule.factor}
    look = Look("shares", partial(_KeyShares, rule=rule), True, lambda _position, arrays: arrays, arguments)
    (shares,) = scan(question, [look])
    found = [
        _of_task([selected[i] for i in positions], [shares[i] for i in positions], selection, rule)
        for _, positions in sorted(positions_by_task(selected).items())
    ]
    keys, heads = (pl.concat(tables) for tables in zip(*found, strict=True))
    on = ["suite", "task_id", "key"]
    return SinkSearch(keys.join(_value_ratios(question, heads), on=on, how="left", maintain_order="left"), heads)


class _KeyShares:
    """How much each key of an episode takes in each head; blocks count once."""

    def __init__(self, item: SelectedEpisode, selection: Selection, _site: str, _given: None, rule: SinkRule) -> None:
        self.item, self.selection, self.rule = item, selection, rule
        uniform, valid = uniform_keys(item, selection), item.valid[:, None, None, None]
        of_valid = (uniform * valid).sum(axis=-1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.where(of_valid > 0, uniform / of_valid, 0.0)
        # A key that is valid at some replans only takes nothing at the others, and its mean counts them.
        self.shares = np.where(valid, shares, 1.0 / np.maximum(item.num_valid, 1)[:, None, None, None, None])
        self.keys: range | None = range(item.tokens.layout.num_keys)
        sums = np.zeros((2, len(selection.once), len(selection.heads), len(self.keys)), np.float32)
        self.above, self.held = sums

    def add(self, part: LayerRows) -> None:
        """Add what the keys take in the rows of a layer."""
        if part.layer not in self.selection.once:
            return
        at, count = self.selection.once.index(part.layer), len(part.rows) * len(self.selection.denoise)
        _, layers, steps, _, _ = self.shares.shape
        here = self.shares[:, part.layer if layers > 1 else 0, part.denoise if steps > 1 else 0]
        highest = here.max(axis=-1, keepdims=True)
        # One for all keys where they are alike.
        here = highest if ((here == 0) | (here >= highest * (1.0 - _ROUNDING))).all() else here
        in_rows, summed = key_sums(part.rows, self.item.valid, self.rule.factor * here)
        self.above[at] += (in_rows / count).astype(np.float32)
        self.held[at] += (summed / count).astype(np.float32)

    def content(self) -> dict[str, Array]:
        """The arrays by name.

        Returns:
            above: share of the rows in which the key takes more than the factor, (layer, head, key) float32.
            held: mean over rows of the key's share in the mass of the valid keys, (layer, head, key) float32.
            uniform: mean over rows of what uniform attention gives the key of that mass, (layer or 1, head or 1, key)
                float32: 1 / the number of valid keys where every query sees the same.
        """
        means = self.shares.mean(axis=(0, 2)).astype(np.float32)
        of_layers = means[list(self.selection.once)] if len(means) > 1 else means
        return {"above": self.above, "held": self.held, "uniform": of_layers}


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


def _of_task(
    items: Sequence[SelectedEpisode], shares: Sequence[Mapping[str, Array]], selection: Selection, rule: SinkRule
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """The rows of both tables of a search of one task, without value_ratio."""
    above, held, uniform = (np.mean([np.asarray(one[name], np.float64) for one in shares], axis=0)
                            for name in ("above", "held", "uniform"))  # fmt: skip
    valid = [item.valid for item in items]
    keys = np.flatnonzero(np.any([part.any(axis=0) for part in valid], axis=0))
    described = pl.DataFrame([_describe(int(key), items, valid) for key in keys], schema=_DESCRIPTION, orient="row")
    counted = np.zeros(held.shape[2], dtype=bool)
    counted[keys] = (described["role"] != Role.ACTION.label).to_numpy()
    # Twice the uniform share: where a row has two or three valid keys, even attention exceeds the limit of mass.
    by_mass = counted & (held > np.maximum(rule.mass, 2.0 * uniform))
    # A share is a mean of quotients: rounding must not put one half below 0.5.
    is_sink = by_mass | (counted & (above >= rule.share - _ROUNDING))
    count, num_heads, mean_mass = is_sink.sum(axis=(0, 1))[keys], above[..., 0].size, held.mean(axis=(0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        times_uniform = mean_mass / uniform.mean(axis=(0, 1))
    suite, task = items[0].task
    labels = {"suite": pl.lit(suite), "task_id": pl.lit(task, dtype=pl.Int64)}
    of_keys = described.select(
        **labels,
        num_episodes=pl.lit(len(items), dtype=pl.Int64),
        **{name: pl.col(name) for name in _DESCRIPTION},
        num_valid=pl.lit(float(np.mean([item.num_valid.mean() for item in items]))),
        share_of_rows=pl.Series(above.mean(axis=(0, 1))[keys]),
        mean_mass=pl.Series(mean_mass[keys]),
        times_uniform=pl.Series(times_uniform[keys]).fill_nan(None),
        largest_mass=pl.Series(held.max(axis=(0, 1))[keys]),
        sink_heads=pl.Series(count),
        heads_by_mass=pl.Series(by_mass.sum(axis=(0, 1))[keys]),
        num_heads=pl.lit(num_heads, dtype=pl.Int64),
        widespread=pl.Series((count > 0) & (count >= rule.heads * num_heads - 1e-9)),
    )
    key, at, head = np.nonzero(is_sink.transpose(2, 0, 1))
    layer = np.array(selection.once)[at]
    of_heads = pl.DataFrame(
        {
            "key": key,
            "layer": np.array(selection.layer_labels)[layer],
            "block": np.array(selection.blocks)[layer],
            "head": np.array(selection.head_numbers)[head],
            "share_of_rows": above[at, head, key],
            "mean_mass": held[at, head, key],
            "by_mass": by_mass[at, head, key],
        }
    )
    return of_keys, of_heads.sort("key", "layer", "head").select(**labels, **{n: pl.col(n) for n in of_heads.columns})


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
                f"Every valid token of task {item.task[1]} is a sink by this rule, so that nothing is left without "
                "sinks; give a rule that takes fewer, as --without-sinks factor=20,heads=0.5."
            )
    grouping = replace(question.grouping, name=f"{question.grouping.name}-without-sinks")
    num_valid = max(float(item.num_valid.mean()) for item in question.selected)
    notes = (*question.notes, describe_sinks(sinks, question.num_tasks, rule, num_valid))
    return replace(question, selected=selected, grouping=grouping, notes=notes)


def describe_sinks(sinks: pl.DataFrame, num_tasks: int, rule: SinkRule, num_valid: float) -> str:
    """The keys that were taken out, as sentences for a summary; `num_valid`: most valid keys of a task."""
    out = sinks.filter("widespread")
    left = sinks.height - out.height
    of_rule, also = f"{rule}, in at least {rule.heads:.0%} of the layers' heads", ""
    if left:
        also = (
            f" Sinks of fewer heads stay in: {plural(left, 'token')}, counted in every task by itself (a rule "
            "with a smaller `heads` takes them out too)."
        )
    if num_valid <= rule.factor:
        also += (
            f" With {num_valid:.3g} valid tokens none can take more than {rule.factor:g} x its even share, which is "
            "all of the row: tokens are judged by their mass alone; a smaller factor (--without-sinks factor=2) judges "
            "by multiples too."
        )
    if out.is_empty():
        return f"Without sinks: no token takes {of_rule}, so nothing was taken out.{also}"
    merged = out.group_by("key", "span", "role", "description", maintain_order=True).agg(
        pl.struct("suite", "task_id").n_unique().alias("num_tasks"),
        pl.col("mean_mass").mean(),
        (pl.col("sink_heads") / pl.col("num_heads")).mean().alias("heads_share"),
    )
    of = f"of {num_tasks} tasks" if num_tasks > 1 else "of the one task"
    named = [
        f"{row['description']} ({row['role']}; in {row['num_tasks']} {of}, in {row['heads_share']:.0%} of the heads, "
        f"{row['mean_mass']:.1%} of the mass)"
        for row in merged.sort("num_tasks", "mean_mass", "key", descending=[True, True, False]).iter_rows(named=True)
    ]
    return (
        f"Without sinks: {listing(named, 6)} {'is' if len(named) == 1 else 'are'} out of every group and of the valid "
        f"tokens (but not of norms of contributions). A sink takes {of_rule}.{also}"
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


def _value_ratios(question: Question, heads: pl.DataFrame) -> pl.DataFrame:
    """One row per sink that is a segment of its own: suite, task_id, key, value_ratio.

    `heads` names the blocks in which a key is a sink: suite, task_id, key, block. Empty without contributions, and
    where not all heads were recorded.
    """
    ratios = []
    recorded = (store.attributes for store in question.stores)
    if all(root.recording.contributions and has_all_heads(root, question.site) for root in recorded):
        sinks = heads.group_by("suite", "task_id", "key", maintain_order=True).agg(pl.col("block").unique())
        for suite, task, key, blocks in sinks.iter_rows():
            items = [item for item in question.selected if item.task == (suite, task)]
            parts = [_lengths_and_masses(item, question, key, blocks) for item in items]
            known = [part for part in parts if part is not None]
            if len(known) < len(parts):
                continue  # the key shares its segment at a replan
            length, mass, of_rest, mass_of_rest = np.sum(known, axis=0)
            if mass > 0 and mass_of_rest > 0 and of_rest > 0:
                ratios.append((suite, task, key, (length / mass) / (of_rest / mass_of_rest)))
    schema = {"suite": pl.String, "task_id": pl.Int64, "key": pl.Int64, "value_ratio": pl.Float64}
    return pl.DataFrame(ratios, schema=schema, orient="row")


def _lengths_and_masses(
    item: SelectedEpisode, question: Question, key: int, blocks: list[int]
) -> NDArray[np.float64] | None:
    """Mean norm and mass of the key's segment, and of all other valid ones, over replans at which the key is valid."""
    selection, site, tokens = question.selection, question.site, item.tokens
    segments = item.episode.attributes.segments[site]
    members = segment_members(tokens.layout, tokens.static_roles, segments)
    valid = ~np.isin(tokens.static_roles, INVALID_ROLES)
    own = members[:, key]  # (replan or 1, segment)
    at = np.broadcast_to(valid[:, key], (tokens.num_replans,))
    taken = (own & valid[:, [key]]).any(axis=0)
    if not at.any():
        return np.zeros(4)
    # One segment, of one key, at every replan at which the key is valid.
    if taken.sum() != 1 or (members.sum(axis=1)[:, taken][valid[:, key]] != 1).any():
        return None
    rest = (members & valid[:, :, None]).any(axis=(0, 1)) & ~taken
    layers = [i for i, block in enumerate(selection.blocks) if block in blocks and i in selection.once]
    gram = selected_gram(item, site, selection)[at][:, layers]
    mass = segment_masses(item, site, selection)[at][:, layers]
    numbers = []
    for part in (taken, rest):
        numbers += [joint_norm(gram, np.append(part, False)).mean(), mass[..., part].sum(axis=-1).mean()]
    return np.array(numbers)
