"""What uniform attention gives to every key: the one definition behind every baseline, lift and uniform ratio.

A query that attends uniformly gives 1 / N to each of the N keys that its mask lets it see, and nothing to the others. A
stored row is a mean over action queries, and uniform attention is averaged in the same way:

    u_k = mean over the action queries behind a row of 1 / N_q where query q sees key k, and of 0 where it does not

so that attention that is uniform at each query gives every group with a key that some query sees

    lift = (mass of the group / sum of its u) / (mass of the valid keys / sum of their u) = 1.

From version 2 on a store holds u (`SITE/uniform`), because masks may differ between queries, layers, heads and denoise
steps. Version 1 has roles alone: there u follows from the keys that some query of some layer sees
(`uniform_of_version_1`), which is the same where all see the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.layout import Role, SiteLayout

#: Roles of keys that no action query sees. A null sink is seen, though it holds nothing.
UNSEEN_ROLES = (Role.MASKED_IMAGE, Role.PADDING, Role.ABSENT)


def uniform_rows(seen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Rows (..., query, key) of uniform attention from the keys that each query sees; 0 for a query without any."""
    number = seen.sum(axis=-1, keepdims=True)
    rows: NDArray[np.float64] = seen / np.maximum(number, 1)
    return rows


def uniform_of_roles(key_role: NDArray[np.uint8]) -> NDArray[np.float64]:
    """u (..., key) of a policy whose action queries all see every key but the `UNSEEN_ROLES`, from role codes."""
    return uniform_rows(~np.isin(key_role, [int(role) for role in UNSEEN_ROLES]))


def uniform_of_version_1(
    layout: SiteLayout, key_role: NDArray[np.uint8], valid: NDArray[np.bool_], num_queries: int
) -> NDArray[np.float64]:
    """u (replan or 1, key) of a store of version 1: 1 / N over the valid keys, and as much for every key that exists.

    Keys of a growing span get a part of that. Query q sees the first q + `growing_offset` of them, and each absent one
    makes the queries of its replan one fewer.

    Args:
        layout: the site's spans.
        key_role: role codes, (replan or 1, key).
        valid: keys that can hold information, (replan or 1, key).
        num_queries: action queries of a replan that generates all tokens of the growing span.
    """
    counts = np.where(key_role == Role.ABSENT, 0.0, 1.0)
    if layout.growing_span is not None:
        replans = max(len(key_role), len(valid))
        absent, valid = (np.broadcast_to(values, (replans, valid.shape[1])) for values in (counts == 0, valid))
        counts = np.stack([_counts_of_replan(layout, *of, num_queries) for of in zip(absent, valid, strict=True)])
    number = (valid * counts).sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(number > 0, counts / number, 0.0)


def _counts_of_replan(
    layout: SiteLayout, absent: NDArray[np.bool_], valid: NDArray[np.bool_], num_queries: int
) -> NDArray[np.float64]:
    """For how much of a key that all queries see each key (key,) counts at one replan."""
    growing = layout.growing_span
    assert growing is not None
    inside = slice(growing.start, growing.stop)
    queries = max(1, num_queries - int(absent[inside].sum()))
    # (query, key of the span): the keys that exist for each query.
    seen = np.arange(growing.num_keys) < np.arange(queries)[:, None] + growing.growing_offset
    seen &= ~absent[inside]
    outside = valid.sum() - valid[inside].sum()
    num_keys = outside + (seen & valid[inside]).sum(axis=1)  # (query,)
    share = np.where(num_keys > 0, 1.0 / np.maximum(num_keys, 1), 0.0)
    counts = np.where(absent, 0.0, 1.0)
    if share.any():
        counts[inside] = (share[:, None] * seen).sum(axis=0) / share.sum()
    return counts
