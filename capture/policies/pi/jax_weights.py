"""openpi's JAX parameter leaves to the names and shapes of the torch model. Pure: arrays in, arrays out.

A leaf is named by its path in the parameter tree joined by "/", without the leading "params" and the trailing "value".
Leaves of the transformers carry all layers on their first axis (they are scanned over).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping

import numpy as np
import torch
from torch import Tensor

from capture.policies.pi.config import PiConfig
from capture.policies.pi.strict import CheckpointMismatch, check_shapes, expected_shapes

VISION = "paligemma_with_expert.paligemma.model.vision_tower.vision_model."
PROJECTOR = "paligemma_with_expert.paligemma.model.multi_modal_projector.linear."
LANGUAGE = "paligemma_with_expert.paligemma.model.language_model."
EXPERT = "paligemma_with_expert.gemma_expert.model."

Convert = Callable[[np.ndarray], np.ndarray]
#: one JAX leaf -> every torch tensor made from it, by name
LeafConverter = Callable[[np.ndarray], dict[str, np.ndarray]]


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


def leaf_converter(path: str) -> LeafConverter | None:
    """Return what turns a JAX leaf of this path into torch tensors by name, or None for a leaf that no pi model has.

    For checkpoints too large to hold twice: look all paths up first, then read, convert and assign leaf by leaf.
    """
    image_block, image, language = "PaliGemma/img/Transformer/encoderblock/", "PaliGemma/img/", "PaliGemma/llm/"
    if path.startswith(image_block):
        found = _IMAGE_BLOCK.get(path.removeprefix(image_block))
        return None if found is None else _stacked(VISION + "encoder.layers.", [found])
    if path.startswith(image):
        return _single("", _IMAGE.get(path.removeprefix(image)))
    if path.startswith(language):
        below, marks = _EXPERT_MARK.subn("", path.removeprefix(language))
        model = EXPERT if marks else LANGUAGE
        several = _GEMMA_BLOCK.get(below.removeprefix("layers/"))
        return _single(model, _GEMMA.get(below)) if several is None else _stacked(model + "layers.", several)
    projection = _PROJECTION.fullmatch(path)
    if projection is None:
        return None
    kernel = projection[2] == "kernel"
    return _single(projection[1], (".weight", _transposed) if kernel else (".bias", _same))


def _single(before: str, found: tuple[str, Convert] | None) -> LeafConverter | None:
    if found is None:
        return None
    name, convert = found
    return lambda leaf: {before + name: convert(leaf)}


def _stacked(layers: str, targets: list[tuple[str, Convert]]) -> LeafConverter:
    def unstack(leaf: np.ndarray) -> dict[str, np.ndarray]:
        return {f"{layers}{i}.{name}": convert(one) for i, one in enumerate(leaf) for name, convert in targets}

    return unstack


def find_converters(paths: Iterable[str]) -> dict[str, LeafConverter]:
    """Return path -> converter for all leaves of a checkpoint; `CheckpointMismatch` lists those no pi model has."""
    found = {path: leaf_converter(path) for path in paths}
    unknown = sorted(path for path, converter in found.items() if converter is None)
    if unknown:
        raise CheckpointMismatch(
            f"The checkpoint has {len(unknown)} arrays that a pi model does not have (LoRA arrays must be merged "
            f"first): {', '.join(unknown)}."
        )
    return {path: converter for path, converter in found.items() if converter is not None}


def from_jax_flat(leaves: Mapping[str, np.ndarray], config: PiConfig) -> dict[str, Tensor]:
    """Return the state dict (float32) of a `PiModel(config)` from all leaves of a JAX checkpoint.

    Raises `CheckpointMismatch` that lists every leaf that is unknown (such as unmerged LoRA leaves), and every tensor
    that is missing or of another shape than the configuration says.
    """
    converters = find_converters(leaves)
    state = {
        name: torch.from_numpy(np.array(array, dtype=np.float32, order="C"))
        for path, leaf in leaves.items()
        for name, array in converters[path](leaf).items()
    }
    check_shapes({name: tuple(tensor.shape) for name, tensor in state.items()}, expected_shapes(config))
    return state
