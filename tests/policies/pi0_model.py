"""A small random pi0 of transformers 5, and inputs for it."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import torch
from transformers import PI0Config, PI0ForConditionalGeneration

from tests.policies.word_tokenizer import INSTRUCTION, WordTokenizer

CAMERAS = ("base", "wrist")
PATCHES, LONGEST, CHUNK, STEPS, LAYERS = 16, 9, 6, 4, 3
PLACEHOLDER = 299
#: Sizes that the builder is not given are those of the tests.
NONE: Mapping[str, int] = MappingProxyType({})


def small_pi0(
    attention: str = "sdpa",
    *,
    sizes: Mapping[str, int] = NONE,
    text_sizes: Mapping[str, int] = NONE,
    expert_sizes: Mapping[str, int] = NONE,
    picture: int = 56,
    chunk: int = CHUNK,
    steps: int = STEPS,
) -> Any:
    """A PI0ForConditionalGeneration of three blocks.

    `sizes` are of both transformers, `text_sizes` and `expert_sizes` of one; `picture` is a side in pixels.
    """
    sizes = {
        **{"num_hidden_layers": LAYERS, "num_attention_heads": 4, "num_key_value_heads": 1, "head_dim": 16},
        **sizes,
    }
    vision = {
        **{"model_type": "siglip_vision_model", "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2},
        **{"num_attention_heads": 2, "image_size": picture, "patch_size": 14, "vision_use_head": False},
    }
    text = {
        **{"model_type": "gemma", "hidden_size": 64, "intermediate_size": 96, "vocab_size": 300},
        **{**sizes, **text_sizes},
    }
    vision["projection_dim"] = text["hidden_size"]
    config = PI0Config(
        vlm_config={
            **{"model_type": "paligemma", "text_config": text, "vision_config": vision},
            **{"projection_dim": text["hidden_size"], "image_token_id": PLACEHOLDER},
        },
        dit_config={"model_type": "gemma", "hidden_size": 32, "intermediate_size": 64, **sizes, **expert_sizes},
        chunk_size=chunk,
        max_state_dim=5,
        max_action_dim=4,
        num_inference_steps=steps,
        attn_implementation=attention,
    )
    torch.manual_seed(0)
    return PI0ForConditionalGeneration(config).eval()


def inputs(
    padding: int = 2,
    batch: int = 1,
    seed: int = 1,
    instruction: str = INSTRUCTION,
    picture: int = 56,
    chunk: int = CHUNK,
) -> dict[str, torch.Tensor]:
    """Return what `sample_actions` takes, with the noise; the prompt's words and then padding."""
    generator = torch.Generator().manual_seed(seed)
    words = [2, *WordTokenizer().encode(instruction)]
    ids = torch.tensor([[PLACEHOLDER] * ((picture // 14) ** 2 * len(CAMERAS)) + words + [0] * padding] * batch)
    seen = torch.ones_like(ids)
    seen[:, ids.shape[1] - padding :] = 0
    return {
        "input_ids": ids,
        "attention_mask": seen,
        "pixel_values": torch.rand(batch, len(CAMERAS), 3, picture, picture, generator=generator) * 2 - 1,
        "pixel_attention_mask": torch.ones(batch, len(CAMERAS), dtype=torch.bool),
        "state": torch.randn(batch, 5, generator=generator),
        "noise": torch.randn(batch, chunk, 4, generator=generator),
    }
