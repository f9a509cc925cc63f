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
from vla_attention.capture.policies.pi.sizes import EXPERT, LANGUAGE, PALIGEMMA, VISION
from vla_attention.capture.policies.weights import Shapes
from vla_attention.schemas.errors import listing

_PROJECTOR = PALIGEMMA + "model.multi_modal_projector.linear."
#: Appended to the error if the arrays of a pi model are missing.
_OTHER_OPENPI_MODEL = (
    " It has no action expert of a pi0 or pi0.5 model: it is of another model family (openpi's pi0-FAST, which writes "
    "actions as text, or PaliGemma alone)."
)

Convert = Callable[[np.ndarray], np.ndarray]


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


#: Leaf -> its conversion, and the torch tensors that it becomes: several where its first axis counts them.
_Table = dict[str, tuple[Convert, tuple[str, ...]]]
_IMAGE: _Table = {
    "embedding/kernel": (lambda w: w.transpose(3, 2, 0, 1), (VISION + "embeddings.patch_embedding.weight",)),
    "embedding/bias": (_same, (VISION + "embeddings.patch_embedding.bias",)),
    "pos_embedding": (lambda w: w[0], (VISION + "embeddings.position_embedding.weight",)),
    "Transformer/encoder_norm/scale": (_same, (VISION + "post_layernorm.weight",)),
    "Transformer/encoder_norm/bias": (_same, (VISION + "post_layernorm.bias",)),
    "head/kernel": (_transposed, (_PROJECTOR + "weight",)),
    "head/bias": (_same, (_PROJECTOR + "bias",)),
}
_ATTENTION = "MultiHeadDotProductAttention_0/"
#: Below the blocks of the image encoder.
_IMAGE_BLOCK: _Table = {
    _ATTENTION + "out/kernel": (_out_of_heads, ("self_attn.out_proj.weight",)),
    _ATTENTION + "out/bias": (_same, ("self_attn.out_proj.bias",)),
}
for _name in ("query", "key", "value"):
    _IMAGE_BLOCK[f"{_ATTENTION}{_name}/kernel"] = (_into_heads, (f"self_attn.{_name[0]}_proj.weight",))
    _IMAGE_BLOCK[f"{_ATTENTION}{_name}/bias"] = (_flat, (f"self_attn.{_name[0]}_proj.bias",))
for _i in (0, 1):
    _IMAGE_BLOCK[f"LayerNorm_{_i}/scale"] = (_same, (f"layer_norm{_i + 1}.weight",))
    _IMAGE_BLOCK[f"LayerNorm_{_i}/bias"] = (_same, (f"layer_norm{_i + 1}.bias",))
    _IMAGE_BLOCK[f"MlpBlock_0/Dense_{_i}/kernel"] = (_transposed, (f"mlp.fc{_i + 1}.weight",))
    _IMAGE_BLOCK[f"MlpBlock_0/Dense_{_i}/bias"] = (_same, (f"mlp.fc{_i + 1}.bias",))
_Q, _K, _V = (f"self_attn.{name}_proj.weight" for name in "qkv")
#: Below the blocks of the two Gemma transformers.
_GEMMA_BLOCK: _Table = {
    "attn/q_einsum/w": (_per_head, (_Q,)),
    "attn/kv_einsum/w": (_per_head, (_K, _V)),
    "attn/qkv_einsum/w": (_per_head, (_Q, _K, _V)),  # as many key heads as query heads
    "attn/attn_vec_einsum/w": (_out_of_heads, ("self_attn.o_proj.weight",)),
    "mlp/gating_einsum": (_transposed, ("mlp.gate_proj.weight", "mlp.up_proj.weight")),
    "mlp/linear": (_transposed, ("mlp.down_proj.weight",)),
}
_GEMMA: _Table = {"embedder/input_embedding": (_same, ("embed_tokens.weight",))}
for _table, _jax, _torch in (
    (_GEMMA_BLOCK, "pre_attention_norm", "input_layernorm"),
    (_GEMMA_BLOCK, "pre_ffw_norm", "post_attention_layernorm"),
    (_GEMMA, "final_norm", "norm"),
):
    _table[f"{_jax}/scale"] = (_same, (f"{_torch}.weight",))
    _table[f"{_jax}/Dense_0/kernel"] = (_transposed, (f"{_torch}.dense.weight",))
    _table[f"{_jax}/Dense_0/bias"] = (_same, (f"{_torch}.dense.bias",))

_LORA = re.compile(r"(.*[/_])lora_([ab])\Z")
#: "_1" at the end of a path component of the language model marks the action expert
_EXPERT_MARK = re.compile(r"_1(?=/|$)")
_PROJECTION = re.compile(r"((?:action|state|time)\w*)/(kernel|bias)")


@dataclass(frozen=True)
class LeafPlan:
    """Conversion of one JAX leaf. names: of the torch tensors, after `before`.

    is_stacked: the first axis of the leaf is the layer, whose number follows `before` in the names.
    """

    convert: Convert
    names: tuple[str, ...]
    before: str
    is_stacked: bool

    def layer(self, index: int | None, array: np.ndarray) -> dict[str, np.ndarray]:
        """Convert one layer of a stacked leaf, or (None) a leaf that is not stacked."""
        before = self.before if index is None else f"{self.before}{index}."
        parts = array if len(self.names) > 1 else [array]
        return {before + name: self.convert(part) for name, part in zip(self.names, parts, strict=True)}

    def whole(self, leaf: np.ndarray) -> dict[str, np.ndarray]:
        """Convert a whole leaf."""
        if not self.is_stacked:
            return self.layer(None, leaf)
        return {name: array for i, one in enumerate(leaf) for name, array in self.layer(i, one).items()}

    def shapes(self, leaf_shape: tuple[int, ...]) -> Shapes:
        """Return names and shapes of the tensors that a leaf of this shape gives, without allocating any."""
        empty = np.broadcast_to(np.float32(0), leaf_shape)
        return {name: tuple(array.shape) for name, array in self.whole(empty).items()}


def _plan_leaf(path: str) -> LeafPlan | None:
    """Return the conversion of a JAX leaf by its path, or None for a leaf that no pi model has."""
    below, marks = _EXPERT_MARK.subn("", path) if path.startswith("PaliGemma/llm/") else (path, 0)
    model = EXPERT if marks else LANGUAGE
    for place, table, before, is_stacked in (
        ("PaliGemma/img/Transformer/encoderblock/", _IMAGE_BLOCK, VISION + "encoder.layers.", True),
        ("PaliGemma/img/", _IMAGE, "", False),
        ("PaliGemma/llm/layers/", _GEMMA_BLOCK, model + "layers.", True),
        ("PaliGemma/llm/", _GEMMA, model, False),
    ):
        if below.startswith(place):
            found = table.get(below.removeprefix(place))
            return None if found is None else LeafPlan(*found, before, is_stacked)
    projection = _PROJECTION.fullmatch(path)
    if projection is None:
        return None
    convert, name = (_transposed, "weight") if projection[2] == "kernel" else (_same, "bias")
    return LeafPlan(convert, (name,), projection[1] + ".", False)


def plan_leaves(paths: Iterable[str]) -> tuple[dict[str, LeafPlan], dict[str, tuple[str, str]]]:
    """Return the conversion of every leaf of a checkpoint, and leaf -> the two LoRA leaves that are merged into it.

    `CheckpointMismatch` lists the leaves that no pi model has; these include LoRA leaves without a pair.
    """
    known = dict.fromkeys(paths)
    pairs = {}
    for path in known:
        match = _LORA.fullmatch(path)
        if match is not None and match[2] == "a" and f"{match[1]}lora_b" in known:
            # Attention: .../q_einsum/{w, lora_a, lora_b}. Feed-forward: .../{gating_einsum, gating_einsum_lora_a, ...}.
            adapted = match[1] + "w" if match[1].endswith("/") else match[1][:-1]
            if adapted in known:
                pairs[adapted] = (path, f"{match[1]}lora_b")
    merged = {path for pair in pairs.values() for path in pair}
    found = {path: _plan_leaf(path) for path in known if path not in merged}
    plans = {path: plan for path, plan in found.items() if plan is not None}
    unknown, is_pi = sorted(found.keys() - plans.keys()), "action_in_proj/kernel" in plans
    if unknown or not is_pi:
        what = "no action_in_proj"
        if unknown:
            what = f"{len(unknown)} arrays that a pi model does not have: {listing(unknown, 40)}"
        raise CheckpointMismatch(f"The checkpoint has {what}.{'' if is_pi else _OTHER_OPENPI_MODEL}")
    return plans, pairs


def merge_lora(path: str, w: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return one layer of the leaf `path` with its LoRA factors merged, in float32.

    w: (..., in, out); a: (..., in, rank); b: (..., rank, out), with the same leading axes (heads, or gate and up).
    """
    if w.shape[:-1] != a.shape[:-1] or (*w.shape[:-2], a.shape[-1], w.shape[-1]) != b.shape:
        raise CheckpointMismatch(
            f"The LoRA arrays of {path} have shapes {a.shape} and {b.shape}, which do not fit its {w.shape} (one layer "
            "each)."
        )
    a, b = np.asarray(a, dtype=np.float32), np.asarray(b, dtype=np.float32)
    update = np.einsum("nhl,ld->nhd", a, b.sum(axis=0)) if "/attn_vec_einsum" in path else a @ b
    return np.asarray(w + update, dtype=np.float32)
