"""What uniform attention gives to every key: the one definition behind every baseline, lift and uniform ratio.

A query that attends uniformly gives 1 / N to each of the N keys that its mask lets it see, and nothing to the others. A
stored row is a mean over action queries, and uniform attention is averaged in the same way:

    u_k = mean over the action queries behind a row of 1 / N_q where query q sees key k, and of 0 where it does not

so that attention that is uniform at each query gives every group with a key that some query sees

    lift = (mass of the group / sum of its u) / (mass of the valid keys / sum of their u) = 1.

A store holds u (`SITE/uniform`) unless the roles of the keys say it: masks may differ between queries, layers, heads
and denoise steps.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.layout import Role

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


def stored_uniform_of_roles(key_role: NDArray[np.uint8]) -> NDArray[np.float32]:
    """`uniform_of_roles` as `SITE/uniform` has it, (replan, 1, 1, 1, 1, key), from the codes (replan, key)."""
    return uniform_of_roles(key_role)[:, None, None, None, None].astype(np.float32)
