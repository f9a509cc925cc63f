"""Infer a model's sizes from the shapes of its tensors and what a checkpoint states of its attention heads."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from vla_attention.capture.policies.checkpoints import (
    MAX_BLOCKS,
    MAX_SIZE,
    MAX_STEPS,
    CheckpointMismatch,
    check_size,
)
from vla_attention.capture.policies.pi.config import GEMMA_VARIANTS, GemmaConfig, PiConfig, SiglipConfig
from vla_attention.capture.policies.weights import Shapes
from vla_attention.schemas.errors import listing

PALIGEMMA = "paligemma_with_expert.paligemma."
VISION = PALIGEMMA + "model.vision_tower.vision_model."
TABLE = PALIGEMMA + "model.language_model.embed_tokens.weight"
LANGUAGE = PALIGEMMA + "model.language_model."
EXPERT = "paligemma_with_expert.gemma_expert.model."
#: Fields of config.json that name the sizes of the two transformers.
_VARIANT_KEYS = ("paligemma_variant", "action_expert_variant")

#: Default text slots by `pi05` (openpi's model defaults).
MAX_TOKEN_LEN = {True: 200, False: 48}


def is_pi05(shapes: Shapes) -> bool:
    """Return whether the tensors are pi0.5's; `CheckpointMismatch` if they are neither pi0.5's nor pi0's."""
    if "time_mlp_in.weight" in shapes:
        return True
    if "state_proj.weight" in shapes:
        return False
    raise CheckpointMismatch(
        "The checkpoint has neither time_mlp_in.weight (pi0.5) nor state_proj.weight (pi0), so it is no pi model."
    )


def infer_config(shapes: Shapes, config_json: Mapping[str, Any]) -> PiConfig:
    """Infer a configuration from tensor shapes and the checkpoint's config.json.

    Tensors of projections do not
    tell heads from their width (256 rows are one key head of 256 or two of 128): the heads are those of the Gemma
    variant that config.json names, which both transformers share. The image encoder's heads are known for So400m's
    width only.

    Raises `CheckpointMismatch` when no known variant is named, or when a named one has other sizes than the tensors.
    """
    pi05 = is_pi05(shapes)
    for name in ("action_dim", "action_horizon"):
        if not isinstance(config_json.get(name), int):
            raise CheckpointMismatch(
                f"The checkpoint's config.json should state '{name}' as a whole number, but has "
                f"{config_json.get(name)!r}."
            )
        check_size(f"'{name}' of the checkpoint's config.json", config_json[name], MAX_STEPS)
    siglip = _siglip_sizes(shapes)
    # openpi's LoRA variants have the sizes of the plain ones.
    variants = {key: GEMMA_VARIANTS.get(str(config_json.get(key)).removesuffix("_lora")) for key in _VARIANT_KEYS}
    heads_of = next((variant for variant in variants.values() if variant is not None), None)
    if heads_of is None:
        raise CheckpointMismatch(_unknown_heads(shapes, config_json))
    vlm = _gemma_sizes(shapes, LANGUAGE, heads_of)
    expert = _gemma_sizes(shapes, EXPERT, heads_of)
    for (key, named), inferred in zip(variants.items(), (vlm, expert), strict=True):
        if named is not None and named != inferred:
            raise CheckpointMismatch(
                f"The checkpoint's config.json says {key} '{config_json[key]}' ({named}), but the tensors are those "
                f"of {inferred}."
            )
    return PiConfig(
        paligemma=vlm,
        action_expert=expert,
        siglip=siglip,
        action_horizon=config_json["action_horizon"],
        action_dim=config_json["action_dim"],
        max_token_len=MAX_TOKEN_LEN[pi05],
        vocab_size=_size(shapes, TABLE, 0),
        pi05=pi05,
    )


def _size(shapes: Shapes, name: str, axis: int) -> int:
    if name not in shapes or len(shapes[name]) <= axis:
        raise CheckpointMismatch(f"The checkpoint lacks {name}, from which a size of the model would be read.")
    return check_size(f"Axis {axis} of the checkpoint's {name}", shapes[name][axis], MAX_SIZE)


def _depth(shapes: Shapes, layers: str) -> int:
    numbers = {name.removeprefix(layers).split(".")[0] for name in shapes if name.startswith(layers)}
    return check_size(f"The number of blocks of the checkpoint's {layers.rstrip('.')}", len(numbers), MAX_BLOCKS)


def _unknown_heads(shapes: Shapes, config_json: Mapping[str, Any]) -> str:
    first = LANGUAGE + "layers.0.self_attn."
    rows = {name: _size(shapes, f"{first}{name}_proj.weight", 0) for name in "qk"}
    given = listing(f"{key} {config_json.get(key)!r}" for key in _VARIANT_KEYS)
    return (
        f"The checkpoint does not state its attention heads: its config.json has {given}, which name no Gemma variant "
        f"known here ({listing(GEMMA_VARIANTS)}), and the {rows['q']} and {rows['k']} rows of the query and key "
        "projections fit several numbers of heads. State the sizes with --model-config PATH (a file like case.json, "
        "with num_heads, num_kv_heads and head_dim) or, for one of openpi's models, --config-name NAME."
    )


def _gemma_sizes(shapes: Shapes, model: str, heads_of: GemmaConfig) -> GemmaConfig:
    """Sizes of a transformer whose heads are as wide as those of a variant."""
    first, head_dim = model + "layers.0.", heads_of.head_dim
    rows = {name: _size(shapes, f"{first}self_attn.{name}_proj.weight", 0) for name in "qk"}
    for name, count in rows.items():
        if count % head_dim:
            raise CheckpointMismatch(
                f"{first}self_attn.{name}_proj.weight has {count} rows, which are no whole number of heads of "
                f"{head_dim}, as config.json names them."
            )
    return GemmaConfig(
        width=_size(shapes, first + "self_attn.q_proj.weight", 1),
        depth=_depth(shapes, model + "layers."),
        mlp_dim=_size(shapes, first + "mlp.gate_proj.weight", 0),
        num_heads=rows["q"] // head_dim,
        num_kv_heads=rows["k"] // head_dim,
        head_dim=head_dim,
    )


#: JAX leaves whose shapes state the heads: the axis of the heads and the axis of their dimension.
_HEAD_AXES = {
    "q_einsum": (("num_heads", 1), ("head_dim", 3)),
    "kv_einsum": (("num_kv_heads", 2), ("head_dim", 4)),
    "qkv_einsum": (("num_heads", 2), ("num_kv_heads", 2), ("head_dim", 4)),
    "attn_vec_einsum": (("num_heads", 1), ("head_dim", 2)),
}
_HEAD_LEAF = re.compile(r"PaliGemma/llm/layers/attn/(\w+?)(_1)?/w\Z")


def check_jax_heads(shapes: Mapping[str, tuple[int, ...]], config: PiConfig) -> None:
    """Compare the heads that JAX leaves state with a configuration.

    The model's own tensors join heads and their width, so that their shapes agree for other heads, too.

    Args:
        shapes: shapes of the leaves by their paths, layers first.
        config: the configuration that the model is built with.
    """
    for path, shape in shapes.items():
        match = _HEAD_LEAF.match(path)
        if match is None or match[1] not in _HEAD_AXES or len(shape) <= max(a for _, a in _HEAD_AXES[match[1]]):
            continue  # an array with another number of axes is reported with the shapes
        part = config.action_expert if match[2] else config.paligemma
        for name, axis in _HEAD_AXES[match[1]]:
            if shape[axis] != getattr(part, name):
                raise CheckpointMismatch(
                    f"The checkpoint's {path} has {name} {shape[axis]}, and the configuration {getattr(part, name)}; "
                    "choose the checkpoint's own with --config-name NAME, or state its sizes with --model-config PATH."
                )


def _siglip_sizes(shapes: Shapes) -> SiglipConfig:
    patch = VISION + "embeddings.patch_embedding.weight"
    width, so400m = _size(shapes, patch, 0), SiglipConfig()
    if width != so400m.width:
        raise CheckpointMismatch(
            f"The image encoder is {width} wide; its number of heads is known for width {so400m.width} (So400m) only, "
            "so this checkpoint needs an explicit configuration: a case.json beside its folder, or --model-config PATH."
        )
    patch_size = _size(shapes, patch, 2)
    tokens = _size(shapes, VISION + "embeddings.position_embedding.weight", 0)
    return SiglipConfig(
        width=width,
        depth=_depth(shapes, VISION + "encoder.layers."),
        mlp_dim=_size(shapes, VISION + "encoder.layers.0.mlp.fc1.weight", 0),
        num_heads=so400m.num_heads,
        patch_size=patch_size,
        image_size=round(tokens**0.5) * patch_size,
    )
