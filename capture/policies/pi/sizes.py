"""Infer a model's sizes from the shapes of its tensors."""

from __future__ import annotations

from typing import Any

from vla_attention.capture.policies.checkpoints import CheckpointMismatch
from vla_attention.capture.policies.pi.config import GEMMA_VARIANTS, GemmaConfig, PiConfig, SiglipConfig
from vla_attention.capture.policies.strict_loading import Shapes

PALIGEMMA = "paligemma_with_expert.paligemma."
VISION = PALIGEMMA + "model.vision_tower.vision_model."
TABLE = PALIGEMMA + "model.language_model.embed_tokens.weight"
EXPERT = "paligemma_with_expert.gemma_expert.model."

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


def infer_config(
    shapes: Shapes,
    config_json: dict[str, Any],
    *,
    action_horizon: str = "action_horizon",
    action_dim: str = "action_dim",
) -> PiConfig:
    """Infer a configuration from tensor shapes and the checkpoint's config.json.

    `action_horizon` and `action_dim` are the names under which config.json states these. One key/value head is assumed
    (true for all released models), and the image encoder's heads are known for So400m's width only. A named Gemma
    variant whose sizes are not those of the tensors raises `CheckpointMismatch`.
    """
    pi05 = is_pi05(shapes)
    for name in (action_dim, action_horizon):
        if not isinstance(config_json.get(name), int):
            raise CheckpointMismatch(
                f"The checkpoint's config.json should state '{name}' as a whole number, but has "
                f"{config_json.get(name)!r}."
            )
    vlm = _gemma_sizes(shapes, PALIGEMMA + "model.language_model.")
    expert = _gemma_sizes(shapes, EXPERT)
    siglip = _siglip_sizes(shapes)
    for key, inferred in (("paligemma_variant", vlm), ("action_expert_variant", expert)):
        named = GEMMA_VARIANTS.get(str(config_json.get(key)))
        if named is not None and named != inferred:
            raise CheckpointMismatch(
                f"The checkpoint's config.json says {key} '{config_json[key]}' ({named}), but the tensors are those "
                f"of {inferred}."
            )
    return PiConfig(
        paligemma=vlm,
        action_expert=expert,
        siglip=siglip,
        action_horizon=config_json[action_horizon],
        action_dim=config_json[action_dim],
        max_token_len=MAX_TOKEN_LEN[pi05],
        vocab_size=_size(shapes, TABLE, 0),
        pi05=pi05,
    )


def _size(shapes: Shapes, name: str, axis: int) -> int:
    if name not in shapes or len(shapes[name]) <= axis:
        raise CheckpointMismatch(f"The checkpoint lacks {name}, from which a size of the model would be read.")
    return shapes[name][axis]


def _depth(shapes: Shapes, layers: str) -> int:
    return len({name.removeprefix(layers).split(".")[0] for name in shapes if name.startswith(layers)})


def _gemma_sizes(shapes: Shapes, model: str) -> GemmaConfig:
    first = model + "layers.0."
    head_dim = _size(shapes, first + "self_attn.k_proj.weight", 0)
    return GemmaConfig(
        width=_size(shapes, first + "self_attn.q_proj.weight", 1),
        depth=_depth(shapes, model + "layers."),
        mlp_dim=_size(shapes, first + "mlp.gate_proj.weight", 0),
        num_heads=_size(shapes, first + "self_attn.q_proj.weight", 0) // head_dim,
        num_kv_heads=1,
        head_dim=head_dim,
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
