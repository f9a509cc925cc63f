"""For how many keys each key counts: the one definition of what uniform attention gives where keys come and go.

Numbers of keys are the baseline of every lift and of every uniform ratio. Three kinds of keys count differently:

    every query sees it     1
    absent at the replan    0
    of a growing span       a part of 1, because only the later queries see it

The part follows from attention that is uniform, at each query, over the valid keys that exist for it. With N_q of them
at query q of Q, a key k has the mean mass

    u_k = 1/Q · sum over the queries q that see k of 1 / N_q

and a key that all queries see has u = 1/Q · sum over q of 1 / N_q. The key counts u_k / u. The mass of a group under
uniform attention then is its number of keys / the number of valid keys, as everywhere else, and the number of valid
keys is the harmonic mean of N_q. Query q sees the first q + `growing_offset` keys of a growing span; each absent key of
the span makes the queries of its replan one fewer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.layout import Role, SiteLayout


def key_counts(
    layout: SiteLayout, key_role: NDArray[np.uint8], valid: NDArray[np.bool_], num_queries: int
) -> NDArray[np.float64] | None:
    """For how many keys each key counts, shape (replan or 1, key); None where every key counts for one.

    Args:
        layout: the site's spans.
        key_role: role codes, (replan or 1, key).
        valid: keys that can hold information, (replan or 1, key).
        num_queries: action queries of a replan that generates all tokens of the growing span.
    """
    absent = key_role == Role.ABSENT
    if layout.growing_span is None:
        return np.where(absent, 0.0, 1.0) if absent.any() else None
    replans = max(len(key_role), len(valid))
    absent, valid = (np.broadcast_to(values, (replans, values.shape[1])) for values in (absent, valid))
    return np.stack([_counts_of_replan(layout, *of, num_queries) for of in zip(absent, valid, strict=True)])


def num_valid_keys(
    valid: NDArray[np.bool_], counts: NDArray[np.float64] | None
) -> NDArray[np.int64] | NDArray[np.float64]:
    """The number of valid keys (replan or 1,) from `valid` (replan or 1, key) and the `key_counts`."""
    if counts is None or not ((counts > 0) & (counts < 1)).any():
        whole: NDArray[np.int64] = valid.sum(axis=1)
        return whole
    numbers: NDArray[np.float64] = (valid * counts).sum(axis=1)
    return numbers


def _counts_of_replan(
    layout: SiteLayout, absent: NDArray[np.bool_], valid: NDArray[np.bool_], num_queries: int
) -> NDArray[np.float64]:
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
