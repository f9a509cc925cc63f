"""A model's sizes: those that a checkpoint's config.json names, and what its tensors tell."""

from __future__ import annotations

import re
from collections.abc import Container, Mapping
from typing import Any

from vla_attention.capture.policies.checkpoints import MAX_STEPS, CheckpointMismatch, check_size
from vla_attention.capture.policies.pi.config import GEMMA_VARIANTS, PiConfig, SiglipConfig
from vla_attention.capture.policies.weights import Shapes
from vla_attention.schemas.errors import listing

PALIGEMMA = "paligemma_with_expert.paligemma."
VISION = PALIGEMMA + "model.vision_tower.vision_model."
TABLE = PALIGEMMA + "model.language_model.embed_tokens.weight"
LANGUAGE = PALIGEMMA + "model.language_model."
EXPERT = "paligemma_with_expert.gemma_expert.model."
#: Fields of config.json that name the sizes of the two transformers.
_VARIANT_KEYS = ("paligemma_variant", "action_expert_variant")

#: How a user states what a checkpoint does not.
OTHER_SIZES = (
    "State the sizes with --model-config PATH (a file like case.json, with num_heads, num_kv_heads and head_dim) or a "
    "case.json beside the checkpoint's folder; for one of openpi's models, give --config-name NAME"
)
#: Default text slots by `pi05` (openpi's model defaults).
MAX_TOKEN_LEN = {True: 200, False: 48}


def is_pi05(names: Container[str]) -> bool:
    """Return whether the tensors are pi0.5's; `CheckpointMismatch` if they are neither pi0.5's nor pi0's."""
    if "time_mlp_in.weight" in names:
        return True
    if "state_proj.weight" in names:
        return False
    raise CheckpointMismatch(
        "The checkpoint has neither time_mlp_in.weight (pi0.5) nor state_proj.weight (pi0), so it is no pi model."
    )


def stated_config(stated: Mapping[str, Any], *, pi05: bool, image_size: int = SiglipConfig().image_size) -> PiConfig:
    """Return the configuration that a checkpoint's config.json names, with which its tensors then have to agree.

    Tensors of projections do not tell heads from their width (256 rows are one key head of 256 or two of 128): the
    heads are those of the Gemma variants that are named.

    Raises `CheckpointMismatch` when no known variants are named, or no numbers of actions.
    """
    for name in ("action_dim", "action_horizon"):
        check_size(f"'{name}' of the checkpoint's config.json", stated.get(name), MAX_STEPS)
    # openpi's LoRA variants have the sizes of the plain ones.
    vlm, expert = (GEMMA_VARIANTS.get(str(stated.get(key)).removesuffix("_lora")) for key in _VARIANT_KEYS)
    if vlm is None or expert is None:
        raise CheckpointMismatch(
            "The checkpoint does not state its attention heads: its config.json has "
            f"{listing(f'{key} {stated.get(key)!r}' for key in _VARIANT_KEYS)}; the Gemma variants known here are "
            f"{listing(GEMMA_VARIANTS)}, and the rows of its projections fit several numbers of heads. {OTHER_SIZES}."
        )
    return PiConfig(
        paligemma=vlm,
        action_expert=expert,
        siglip=SiglipConfig(image_size=image_size),
        action_horizon=stated["action_horizon"],
        action_dim=stated["action_dim"],
        max_token_len=MAX_TOKEN_LEN[pi05],
        pi05=pi05,
    )


_HEAD_LEAF = re.compile(r"PaliGemma/llm/layers/attn/(\w+?)(_1)?/w\Z")


def check_jax_heads(shapes: Shapes, config: PiConfig) -> None:
    """Compare the heads that JAX leaves state with a configuration; shapes: of the leaves by their paths, layers first.

    The model's own tensors join heads and their width, so that their shapes agree for other heads, too.
    """
    for path, shape in shapes.items():
        if match := _HEAD_LEAF.match(path):
            part = config.action_expert if match[2] else config.paligemma
            expected = {
                "q_einsum": (part.num_heads, part.width, part.head_dim),
                "kv_einsum": (2, part.num_kv_heads, part.width, part.head_dim),
                "qkv_einsum": (3, part.num_kv_heads, part.width, part.head_dim),
                "attn_vec_einsum": (part.num_heads, part.head_dim, part.width),
            }[match[1]]
            if shape[1:] != expected:
                raise CheckpointMismatch(
                    f"The checkpoint's {path} has the heads of {shape[1:]}, and the configuration those of {expected}; "
                    "choose the checkpoint's own with --config-name NAME, or state its sizes with --model-config PATH."
                )
