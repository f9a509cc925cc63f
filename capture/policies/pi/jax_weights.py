"""Conversion of openpi's JAX parameter leaves to the names and shapes of the torch model. No I/O.

A leaf is named by its path in the parameter tree joined by "/", without the leading "params" and the trailing "value".
Leaves of the transformers carry all layers on their first axis (openpi scans over them).

LoRA arrays are merged into the weights that they adapt. openpi scales the update by alpha / rank, which is 1 in all its
LoRA variants (gemma_2b_lora, gemma_300m_lora), so that the merged weight is w + a · b. The output projection of the
attention differs: its equation sums over the heads in both factors, so that the rows of every head are multiplied by
the sum of all heads' b.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from vla_attention.capture.policies.checkpoints import CheckpointMismatch
from vla_attention.capture.policies.weights import Shapes
from vla_attention.schemas.errors import listing

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


VISION = "paligemma_with_expert.paligemma.model.vision_tower.vision_model."
PROJECTOR = "paligemma_with_expert.paligemma.model.multi_modal_projector.linear."
LANGUAGE = "paligemma_with_expert.paligemma.model.language_model."
EXPERT = "paligemma_with_expert.gemma_expert.model."

Convert = Callable[[np.ndarray], np.ndarray]

#: Appended to the error if the arrays of a pi model are missing.
OTHER_OPENPI_MODEL = (
    " It has no action expert of a pi0 or pi0.5 model: it is of another model family (openpi's pi0-FAST, which writes "
    "actions as text, or PaliGemma alone)."
)


def _same(w: np.ndarray) -> np.ndarray:
    return w


def _transposed(w: np.ndarray) -> np.ndarray:
    return w.T


def _flat(w: np.ndarray) -> np.ndarray:
    return w.reshape(-1)


def _into_heads(w: np.ndarray) -> np.ndarray:
    """(in, head, dim) -> (head · dim, in)."""
    return w.reshape(w.shape[0], -1).T


def _out_of_heads(w: np.ndarray) -> np.ndarray:
    """(head, dim, out) -> (out, head · dim)."""
    return w.reshape(-1, w.shape[-1]).T


def _per_head(w: np.ndarray) -> np.ndarray:
    """(head, in, dim) -> (head · dim, in)."""
    return w.transpose(0, 2, 1).reshape(-1, w.shape[1])


def _first(convert: Convert) -> Convert:
    return lambda w: convert(w[0])


def _second(convert: Convert) -> Convert:
    return lambda w: convert(w[1])


def _third(convert: Convert) -> Convert:
    return lambda w: convert(w[2])


#: leaf -> (torch name, conversion); one entry per leaf that is not stacked
_IMAGE: dict[str, tuple[str, Convert]] = {
    "embedding/kernel": (VISION + "embeddings.patch_embedding.weight", lambda w: w.transpose(3, 2, 0, 1)),
    "embedding/bias": (VISION + "embeddings.patch_embedding.bias", _same),
    "pos_embedding": (VISION + "embeddings.position_embedding.weight", lambda w: w[0]),
    "Transformer/encoder_norm/scale": (VISION + "post_layernorm.weight", _same),
    "Transformer/encoder_norm/bias": (VISION + "post_layernorm.bias", _same),
    "head/kernel": (PROJECTOR + "weight", _transposed),
    "head/bias": (PROJECTOR + "bias", _same),
}
_ATTENTION = "MultiHeadDotProductAttention_0/"
#: leaf below the image encoder's blocks -> (name below a torch layer, conversion of one layer)
_IMAGE_BLOCK: dict[str, tuple[str, Convert]] = {
    "LayerNorm_0/scale": ("layer_norm1.weight", _same),
    "LayerNorm_0/bias": ("layer_norm1.bias", _same),
    "LayerNorm_1/scale": ("layer_norm2.weight", _same),
    "LayerNorm_1/bias": ("layer_norm2.bias", _same),
    _ATTENTION + "query/kernel": ("self_attn.q_proj.weight", _into_heads),
    _ATTENTION + "query/bias": ("self_attn.q_proj.bias", _flat),
    _ATTENTION + "key/kernel": ("self_attn.k_proj.weight", _into_heads),
    _ATTENTION + "key/bias": ("self_attn.k_proj.bias", _flat),
    _ATTENTION + "value/kernel": ("self_attn.v_proj.weight", _into_heads),
    _ATTENTION + "value/bias": ("self_attn.v_proj.bias", _flat),
    _ATTENTION + "out/kernel": ("self_attn.out_proj.weight", _out_of_heads),
    _ATTENTION + "out/bias": ("self_attn.out_proj.bias", _same),
    "MlpBlock_0/Dense_0/kernel": ("mlp.fc1.weight", _transposed),
    "MlpBlock_0/Dense_0/bias": ("mlp.fc1.bias", _same),
    "MlpBlock_0/Dense_1/kernel": ("mlp.fc2.weight", _transposed),
    "MlpBlock_0/Dense_1/bias": ("mlp.fc2.bias", _same),
}
#: leaf below the Gemma blocks -> every (name below a torch layer, conversion of one layer) made from it
_GEMMA_BLOCK: dict[str, list[tuple[str, Convert]]] = {
    "attn/q_einsum/w": [("self_attn.q_proj.weight", _per_head)],
    "attn/kv_einsum/w": [
        ("self_attn.k_proj.weight", _first(_per_head)),
        ("self_attn.v_proj.weight", _second(_per_head)),
    ],
    # as many key heads as query heads: one array for all three
    "attn/qkv_einsum/w": [
        ("self_attn.q_proj.weight", _first(_per_head)),
        ("self_attn.k_proj.weight", _second(_per_head)),
        ("self_attn.v_proj.weight", _third(_per_head)),
    ],
    "attn/attn_vec_einsum/w": [("self_attn.o_proj.weight", _out_of_heads)],
    "mlp/gating_einsum": [
        ("mlp.gate_proj.weight", _first(_transposed)),
        ("mlp.up_proj.weight", _second(_transposed)),
    ],
    "mlp/linear": [("mlp.down_proj.weight", _transposed)],
    "pre_attention_norm/scale": [("input_layernorm.weight", _same)],
    "pre_attention_norm/Dense_0/kernel": [("input_layernorm.dense.weight", _transposed)],
    "pre_attention_norm/Dense_0/bias": [("input_layernorm.dense.bias", _same)],
    "pre_ffw_norm/scale": [("post_attention_layernorm.weight", _same)],
    "pre_ffw_norm/Dense_0/kernel": [("post_attention_layernorm.dense.weight", _transposed)],
    "pre_ffw_norm/Dense_0/bias": [("post_attention_layernorm.dense.bias", _same)],
}
_GEMMA: dict[str, tuple[str, Convert]] = {
    "embedder/input_embedding": ("embed_tokens.weight", _same),
    "final_norm/scale": ("norm.weight", _same),
    "final_norm/Dense_0/kernel": ("norm.dense.weight", _transposed),
    "final_norm/Dense_0/bias": ("norm.dense.bias", _same),
}
#: "_1" at the end of a path component of the language model marks the action expert
_EXPERT_MARK = re.compile(r"_1(?=/|$)")
_PROJECTION = re.compile(r"((?:action|state|time)\w*)/(kernel|bias)")


@dataclass(frozen=True)
class LeafPlan:
    """Conversion of one JAX leaf: every torch tensor that is made from it, as (name, conversion).

    layers: the torch prefix of the layers if the leaf is stacked (its first axis is the layer), else None.
    """

    targets: tuple[tuple[str, Convert], ...]
    layers: str | None = None

    def layer(self, index: int, array: np.ndarray) -> dict[str, np.ndarray]:
        """Convert one layer of a stacked leaf."""
        return {f"{self.layers}{index}.{name}": convert(array) for name, convert in self.targets}

    def whole(self, leaf: np.ndarray) -> dict[str, np.ndarray]:
        """Convert a whole leaf."""
        if self.layers is None:
            return {name: convert(leaf) for name, convert in self.targets}
        return {name: array for i, one in enumerate(leaf) for name, array in self.layer(i, one).items()}

    def shapes(self, leaf_shape: tuple[int, ...]) -> Shapes:
        """Return names and shapes of the tensors that a leaf of this shape gives, without allocating any."""
        empty = np.broadcast_to(np.float32(0), leaf_shape)
        return {name: tuple(array.shape) for name, array in self.whole(empty).items()}


def plan_leaf(path: str) -> LeafPlan | None:
    """Return the conversion of a JAX leaf by its path, or None for a leaf that no pi model has."""
    image_block, image, language = "PaliGemma/img/Transformer/encoderblock/", "PaliGemma/img/", "PaliGemma/llm/"
    if path.startswith(image_block):
        place = _IMAGE_BLOCK.get(path.removeprefix(image_block))
        return None if place is None else LeafPlan((place,), VISION + "encoder.layers.")
    if path.startswith(image):
        return _single("", _IMAGE.get(path.removeprefix(image)))
    if path.startswith(language):
        below, marks = _EXPERT_MARK.subn("", path.removeprefix(language))
        model = EXPERT if marks else LANGUAGE
        several = _GEMMA_BLOCK.get(below.removeprefix("layers/"))
        return _single(model, _GEMMA.get(below)) if several is None else LeafPlan(tuple(several), model + "layers.")
    projection = _PROJECTION.fullmatch(path)
    if projection is None:
        return None
    kernel = projection[2] == "kernel"
    return _single(projection[1], (".weight", _transposed) if kernel else (".bias", _same))


def _single(before: str, found: tuple[str, Convert] | None) -> LeafPlan | None:
    return None if found is None else LeafPlan(((before + found[0], found[1]),))


def plan_leaves(paths: Iterable[str]) -> tuple[dict[str, LeafPlan], dict[str, LoraPair]]:
    """Return the conversion of every leaf of a checkpoint, and the LoRA pairs that are merged into leaves.

    `CheckpointMismatch` lists the leaves that no pi model has; these include LoRA leaves without a pair.
    """
    paths = list(paths)
    pairs = find_lora_pairs(paths)
    merged = {path for pair in pairs.values() for path in (pair.a, pair.b)}
    plans = {path: plan_leaf(path) for path in paths if path not in merged}
    unknown = sorted(path for path, plan in plans.items() if plan is None)
    if unknown:
        family = "" if any(path.startswith("action_in_proj/") for path in paths) else OTHER_OPENPI_MODEL
        raise CheckpointMismatch(
            f"The checkpoint has {len(unknown)} arrays that a pi model does not have: {listing(unknown, 40)}.{family}"
        )
    if "action_in_proj/kernel" not in plans:
        raise CheckpointMismatch(f"The checkpoint has no action_in_proj.{OTHER_OPENPI_MODEL}")
    return {path: plan for path, plan in plans.items() if plan is not None}, pairs
