"""Spread of attention in a row: entropy, effective number of keys, mass of the largest keys. Pure arithmetic."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.measures.masses import weighted_sums

_SMALLEST = np.finfo(np.float32).tiny


def entropies(rows: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Entropy of attention inside each group, in nats, renormalised inside the group.

    For a group with weights w the row is cut down to q_k = w_k p_k / S with S = sum of w_k p_k, and

        H = - sum over k of w_k (p_k / S) ln(p_k / S) = ln S - (sum over k of w_k p_k ln p_k) / S

    With weights of 0 and 1 that is Shannon's entropy of the renormalised row, between 0 and ln(number of keys). A key
    that belongs to a group by a fraction (an object on a part of a patch) counts as that fraction of a key:
    H = -KL(q || w), at most ln(sum of w), which is reached when attention is proportional to w. exp(H) then is a number
    of whole keys, comparable with the group's number of keys (and below 1 where all attention lies on less than one
    key). Keys with p = 0 add nothing.

    Source: Shannon (1948); for attention rows Clark et al. (2019), "What Does BERT Look At?", section 3.3.

    Args:
        rows: probabilities (replan, ..., key).
        weights: (replan or 1, key, group), 0..1; for the entropy of whole rows a group that is 1 on every valid key.

    Returns:
        (replan, ..., group) float32; NaN where a group has no mass.
    """
    surprise = np.maximum(rows, _SMALLEST)
    np.log(surprise, out=surprise)
    surprise *= rows
    total, inner = weighted_sums(rows, weights), weighted_sums(surprise, weights)
    with np.errstate(divide="ignore", invalid="ignore"):
        entropy = np.where(total > 0, np.log(total) - inner / total, np.nan)
    # In float32 the entropy of a single key may be some -1e-7. With fractions of keys it may truly be below zero.
    whole = ((weights == 0) | (weights == 1)).all(axis=(0, 1))
    return np.where(whole, np.maximum(entropy, 0.0), entropy).astype(np.float32)


def effective_keys(entropy: NDArray[np.floating]) -> NDArray[np.floating]:
    """exp(H): the number of keys that, sharing evenly, would have the same entropy (the perplexity). Any shape."""
    keys: NDArray[np.floating] = np.exp(entropy)
    return keys


def top_mass(rows: NDArray[np.float32], valid: NDArray[np.bool_], counts: Sequence[int]) -> NDArray[np.float32]:
    """Share of the valid keys' mass that the k largest of them hold, for each k of `counts`.

    Args:
        rows: probabilities (replan, ..., key).
        valid: (replan or 1, key); other keys are in neither sum.
        counts: the numbers k, at least 1; where a row has fewer valid keys than k, the share is 1.

    Returns:
        (replan, ..., k) float32; NaN where the valid keys have no mass.
    """
    middle = (1,) * (rows.ndim - 2)
    seen = rows if valid.all() else rows * valid.reshape(len(valid), *middle, -1)
    keys, most = seen.shape[-1], min(max(counts), seen.shape[-1])
    largest = np.partition(seen, keys - most, axis=-1)[..., keys - most :] if most < keys else seen
    sums = np.cumsum(np.sort(largest, axis=-1)[..., ::-1], axis=-1, dtype=np.float64)
    total = seen.sum(axis=-1, dtype=np.float64)[..., None]
    held = sums[..., [min(count, most) - 1 for count in counts]]
    with np.errstate(invalid="ignore"):
        share = np.where(total > 0, held / total, np.nan)
    return np.minimum(share, 1.0).astype(np.float32)
