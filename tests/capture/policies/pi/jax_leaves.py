"""The torch model's tensors back to the leaves of openpi's JAX models, written down independently of the loader."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from torch import Tensor

from vla_attention.capture.policies.pi.config import GemmaConfig, PiConfig

VISION = "paligemma_with_expert.paligemma.model.vision_tower.vision_model."
PROJECTOR = "paligemma_with_expert.paligemma.model.multi_modal_projector.linear."
LANGUAGE = "paligemma_with_expert.paligemma.model.language_model."
EXPERT = "paligemma_with_expert.gemma_expert.model."


def to_jax_leaves(state: Mapping[str, Tensor], config: PiConfig) -> dict[str, np.ndarray]:
    """Return JAX path -> leaf of a state dict."""
    arrays = {name: tensor.float().numpy() for name, tensor in state.items()}
    leaves = {
        "PaliGemma/img/embedding/kernel": arrays[VISION + "embeddings.patch_embedding.weight"].transpose(2, 3, 1, 0),
        "PaliGemma/img/embedding/bias": arrays[VISION + "embeddings.patch_embedding.bias"],
        "PaliGemma/img/pos_embedding": arrays[VISION + "embeddings.position_embedding.weight"][None],
        "PaliGemma/img/Transformer/encoder_norm/scale": arrays[VISION + "post_layernorm.weight"],
        "PaliGemma/img/Transformer/encoder_norm/bias": arrays[VISION + "post_layernorm.bias"],
        "PaliGemma/img/head/kernel": arrays[PROJECTOR + "weight"].T,
        "PaliGemma/img/head/bias": arrays[PROJECTOR + "bias"],
        "PaliGemma/llm/embedder/input_embedding": arrays[LANGUAGE + "embed_tokens.weight"],
    }
    leaves |= _image_blocks(arrays, config)
    leaves |= _gemma(arrays, config.paligemma, LANGUAGE, "")
    leaves |= _gemma(arrays, config.action_expert, EXPERT, "_1")
    for name, array in arrays.items():
        if "." in name and not name.startswith("paligemma_with_expert"):
            layer, kind = name.split(".")
            leaves[f"{layer}/{'kernel' if kind == 'weight' else 'bias'}"] = array.T
    return leaves


def _image_blocks(arrays: Mapping[str, np.ndarray], config: PiConfig) -> dict[str, np.ndarray]:
    siglip = config.siglip
    heads, dim = siglip.num_heads, siglip.width // siglip.num_heads

    def stacked(name: str) -> list[np.ndarray]:
        return [arrays[f"{VISION}encoder.layers.{i}.{name}"] for i in range(siglip.depth)]

    block = {}
    for i in (0, 1):
        block[f"LayerNorm_{i}/scale"] = stacked(f"layer_norm{i + 1}.weight")
        block[f"LayerNorm_{i}/bias"] = stacked(f"layer_norm{i + 1}.bias")
        block[f"MlpBlock_0/Dense_{i}/kernel"] = [w.T for w in stacked(f"mlp.fc{i + 1}.weight")]
        block[f"MlpBlock_0/Dense_{i}/bias"] = stacked(f"mlp.fc{i + 1}.bias")
    attention = "MultiHeadDotProductAttention_0/"
    for name in ("query", "key", "value"):
        weights, biases = (stacked(f"self_attn.{name[0]}_proj.{kind}") for kind in ("weight", "bias"))
        block[f"{attention}{name}/kernel"] = [w.T.reshape(siglip.width, heads, dim) for w in weights]
        block[f"{attention}{name}/bias"] = [b.reshape(heads, dim) for b in biases]
    block[f"{attention}out/kernel"] = [w.T.reshape(heads, dim, -1) for w in stacked("self_attn.out_proj.weight")]
    block[f"{attention}out/bias"] = stacked("self_attn.out_proj.bias")
    return {f"PaliGemma/img/Transformer/encoderblock/{name}": np.stack(layers) for name, layers in block.items()}


def _gemma(arrays: Mapping[str, np.ndarray], sizes: GemmaConfig, model: str, mark: str) -> dict[str, np.ndarray]:
    def stacked(name: str) -> list[np.ndarray]:
        return [arrays[f"{model}layers.{i}.{name}"] for i in range(sizes.depth)]

    def heads(name: str, count: int) -> np.ndarray:
        """(layer, head, in, dim) of weights (head · dim, in)."""
        return np.stack([w.reshape(count, sizes.head_dim, -1).transpose(0, 2, 1) for w in stacked(name)])

    layers = "PaliGemma/llm/layers/"
    q = heads("self_attn.q_proj.weight", sizes.num_heads)
    k, v = (heads(f"self_attn.{x}_proj.weight", sizes.num_kv_heads) for x in "kv")
    out = {}
    if sizes.num_kv_heads == sizes.num_heads:
        out[f"{layers}attn/qkv_einsum{mark}/w"] = np.stack([q, k, v], axis=1)
    else:
        out[f"{layers}attn/q_einsum{mark}/w"] = q
        out[f"{layers}attn/kv_einsum{mark}/w"] = np.stack([k, v], axis=1)
    rows = [w.T.reshape(sizes.num_heads, sizes.head_dim, -1) for w in stacked("self_attn.o_proj.weight")]
    out[f"{layers}attn/attn_vec_einsum{mark}/w"] = np.stack(rows)
    gate, up, down = (np.stack([w.T for w in stacked(f"mlp.{x}_proj.weight")]) for x in ("gate", "up", "down"))
    out[f"{layers}mlp{mark}/gating_einsum"] = np.stack([gate, up], axis=1)
    out[f"{layers}mlp{mark}/linear"] = down
    for jax, torch_name in (("pre_attention_norm", "input_layernorm"), ("pre_ffw_norm", "post_attention_layernorm")):
        if f"{model}layers.0.{torch_name}.weight" in arrays:
            out[f"{layers}{jax}{mark}/scale"] = np.stack(stacked(f"{torch_name}.weight"))
        else:
            out[f"{layers}{jax}{mark}/Dense_0/kernel"] = np.stack([w.T for w in stacked(f"{torch_name}.dense.weight")])
            out[f"{layers}{jax}{mark}/Dense_0/bias"] = np.stack(stacked(f"{torch_name}.dense.bias"))
    final = f"PaliGemma/llm/final_norm{mark}/"
    if f"{model}norm.weight" in arrays:
        out[final + "scale"] = arrays[f"{model}norm.weight"]
    else:
        out[final + "Dense_0/kernel"] = arrays[f"{model}norm.dense.weight"].T
        out[final + "Dense_0/bias"] = arrays[f"{model}norm.dense.bias"]
    return out
