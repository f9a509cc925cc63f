"""Which kind a sink is: much mass with small values, or with values like those of other keys.

A sink that adds nothing takes attention without effect, and a mass that counts it misleads. One that adds as much per
unit of mass as other keys do is read. Contributions tell, where they were recorded:

    value ratio = (|c_k| / m_k) / (|c_rest| / m_rest)

the length of what the key adds per unit of its mass, over the same of all other valid keys together, from norms and
masses averaged over the task's replans, denoise steps and the blocks in which the key is a sink of a head.
Contributions are stored for segments (a span's keys of one role) and for all heads together, so that only a sink that
is a segment of its own, such as bos, has a value ratio: for one patch of a camera or one word of an instruction it
cannot be told. The other keys' vectors may cancel each other, which makes their length small and the value ratio large:
"small" is said on the safe side.
"""

from __future__ import annotations

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.contributions import has_all_heads, joint_norm, segment_masses, selected_gram
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.schemas.layout import INVALID_ROLES, Role
from vla_attention.schemas.segments import segment_members

#: Roles of keys that hold nothing of scene, instruction or state. A sink of another role may be what a head reads.
WITHOUT_CONTENT = (Role.BOS, Role.TEMPLATE, Role.BLANK, Role.LEARNED)
#: Below this value ratio, a sink's values are called small.
SMALL_VALUES = 0.5


def value_ratios(question: Question, heads: pl.DataFrame) -> pl.DataFrame:
    """One row per sink that is a segment of its own: suite, task_id, key, value_ratio.

    `heads` names the blocks in which a key is a sink: suite, task_id, key, block. Empty without contributions, and
    where not all heads were recorded.
    """
    ratios = []
    recorded = (store.attributes for store in question.stores)
    if all(root.recording.contributions and has_all_heads(root, question.site) for root in recorded):
        sinks = heads.group_by("suite", "task_id", "key", maintain_order=True).agg(pl.col("block").unique())
        for suite, task, key, blocks in sinks.iter_rows():
            found = _value_ratio(question, suite, task, key, blocks)
            if found is not None:
                ratios.append((suite, task, key, found))
    schema = {"suite": pl.String, "task_id": pl.Int64, "key": pl.Int64, "value_ratio": pl.Float64}
    return pl.DataFrame(ratios, schema=schema, orient="row")


def may_be_empty(role: str, value_ratio: float | None) -> bool:
    """Whether a sink may carry no information: its values are small, or not known and its role is without content."""
    if value_ratio is None:
        return role in {each.label for each in WITHOUT_CONTENT}
    return value_ratio < SMALL_VALUES


def _value_ratio(question: Question, suite: str, task: int, key: int, blocks: list[int]) -> float | None:
    """None where the key shares its segment at a replan, or is valid at none."""
    sums = np.zeros(4)
    for item in question.selected:
        if item.task == (suite, task):
            found = _lengths_and_masses(item, question, key, blocks)
            if found is None:
                return None
            sums += found
    length, mass, of_rest, mass_of_rest = sums
    if not (mass > 0 and mass_of_rest > 0 and of_rest > 0):
        return None
    return float((length / mass) / (of_rest / mass_of_rest))


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
    layers = [i for i, block in enumerate(selection.blocks) if block in blocks and selection.is_first_of_block(i)]
    gram = selected_gram(item, site, selection)[at][:, layers]
    mass = segment_masses(item, site, selection)[at][:, layers]
    numbers = []
    for part in (taken, rest):
        numbers += [joint_norm(gram, np.append(part, False)).mean(), mass[..., part].sum(axis=-1).mean()]
    return np.array(numbers)
