"""LoRA arrays of openpi's JAX checkpoints: finding their pairs, and merging them into the weights that they adapt.

openpi scales the update by alpha / rank, which is 1 in all its LoRA variants (gemma_2b_lora, gemma_300m_lora), so that
the merged weight is w + a · b. The output projection of the attention differs: its equation sums over the heads in
both factors, so that the rows of every head are multiplied by the sum of all heads' b.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from vla_attention.capture.policies.checkpoints import CheckpointMismatch

_LORA = re.compile(r"(.*[/_])lora_([ab])\Z")


@dataclass(frozen=True)
class LoraPair:
    """The paths of the two factors that adapt one leaf."""

    a: str
    b: str


def find_lora_pairs(paths: Iterable[str]) -> dict[str, LoraPair]:
    """Return adapted leaf -> its pair. A single factor, or one without a leaf to adapt, is in no pair."""
    known = set(paths)
    pairs = {}
    for path in known:
        match = _LORA.fullmatch(path)
        if match is None or match[2] != "a":
            continue
        # Attention: .../q_einsum/{w, lora_a, lora_b}. Feed-forward: .../{gating_einsum, gating_einsum_lora_a, ...}.
        base = match[1] + "w" if match[1].endswith("/") else match[1][:-1]
        other = f"{match[1]}lora_b"
        if base in known and other in known:
            pairs[base] = LoraPair(path, other)
    return pairs


def merge_lora(path: str, w: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return one layer of the leaf `path` with its LoRA factors merged, in float32.

    w: (..., in, out); a: (..., in, rank); b: (..., rank, out), with the same leading axes (heads, or gate and up).
    """
    fits = w.shape[:-1] == a.shape[:-1] and (*w.shape[:-2], a.shape[-1], w.shape[-1]) == b.shape
    if not fits:
        raise CheckpointMismatch(
            f"The LoRA arrays of {path} have shapes {a.shape} and {b.shape}, which do not fit its {w.shape} (one layer "
            "each)."
        )
    a, b = np.asarray(a, dtype=np.float32), np.asarray(b, dtype=np.float32)
    update = np.einsum("nhl,ld->nhd", a, b.sum(axis=0)) if "/attn_vec_einsum" in path else a @ b
    return np.asarray(w + update, dtype=np.float32)
