"""A stand-in for OpenVLA's class around transformers' own Llama: its modules, order of keys and calls, and no more.

Written after prismatic/extern/hf/modeling_prismatic.py of OpenVLA and of OpenVLA-OFT, whose classes need transformers
4.40 and a fork of it. Patches stand after BOS; `predict_action` generates one token per dimension with a cache;
`predict_chunk` is OFT's: placeholders and a stop token, no causal mask, hidden states from the position before the
first placeholder.
"""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor, nn
from transformers import LlamaConfig, LlamaForCausalLM

PATCH, SIDE, LAYERS, HEADS, WIDTH = 4, 4, 3, 4, 32
PLACEHOLDER, STOP = 1, 2


class PictureEncoder(nn.Module):
    """One attention block over patches, in the place of DINOv2 and SigLIP."""

    def __init__(self) -> None:
        super().__init__()
        self.embed = nn.Conv2d(3, WIDTH, PATCH, PATCH)

    def forward(self, pictures: Tensor) -> Tensor:
        """Return (batch, patch, width) of (batch, 3, height, width)."""
        patches = self.embed(pictures).flatten(2).transpose(1, 2)
        mixed = nn.functional.scaled_dot_product_attention(patches[:, None], patches[:, None], patches[:, None])
        # Only a little: what a patch holds is still told by its own picture.
        return patches + 0.01 * mixed[:, 0]


class OpenVLAForActionPrediction(nn.Module):
    """BOS, patches, prompt, action tokens through a Llama."""

    def __init__(self, attention: str = "sdpa") -> None:
        super().__init__()
        torch.manual_seed(0)
        text = LlamaConfig(
            hidden_size=WIDTH,
            intermediate_size=48,
            num_hidden_layers=LAYERS,
            num_attention_heads=HEADS,
            num_key_value_heads=HEADS,
            vocab_size=60,
            attn_implementation=attention,
        )
        self.config = SimpleNamespace(text_config=text, image_sizes=[SIDE * PATCH, SIDE * PATCH])
        self.vision_backbone = PictureEncoder()
        self.projector = nn.Linear(WIDTH, WIDTH)
        self.language_model = LlamaForCausalLM(text)
        self.proprio_projector = nn.Linear(5, WIDTH)

    def _embeddings(self, ids: Tensor, pictures: Tensor, state: Tensor | None) -> Tensor:
        """ids (batch, token), pictures (batch, camera, 3, height, width) -> (batch, key, width)."""
        text = self.language_model.get_input_embeddings()(ids)
        patches = [self.projector(self.vision_backbone(pictures[:, camera])) for camera in range(pictures.shape[1])]
        states = [] if state is None else [self.proprio_projector(state)[:, None]]
        return torch.cat([text[:, :1], *patches, *states, text[:, 1:]], dim=1)

    @torch.no_grad()
    def predict_action(self, ids: Tensor, pictures: Tensor, dimensions: int) -> Tensor:
        """Return the ids of the action tokens, (batch, dimension)."""
        out = self.language_model(inputs_embeds=self._embeddings(ids, pictures, None), use_cache=True)
        tokens = [out.logits[:, -1:].argmax(-1)]
        for _ in range(dimensions - 1):
            out = self.language_model(input_ids=tokens[-1], past_key_values=out.past_key_values, use_cache=True)
            tokens.append(out.logits[:, -1:].argmax(-1))
        return torch.cat(tokens, dim=1)

    @torch.no_grad()
    def predict_chunk(self, ids: Tensor, pictures: Tensor, state: Tensor | None, count: int) -> Tensor:
        """Return the hidden states that are read as a chunk of `count` numbers, (batch, count, width)."""
        extra = ids.new_tensor([[PLACEHOLDER] * count + [STOP]]).expand(len(ids), -1)
        embedded = self._embeddings(torch.cat([ids, extra], dim=1), pictures, state)
        first = embedded.shape[1] - 1 - count
        embedded[:, first:-1] = 0
        seen = torch.ones(len(ids), 1, embedded.shape[1], embedded.shape[1], dtype=torch.bool)
        hidden = self.language_model.model(inputs_embeds=embedded, attention_mask=seen, use_cache=False)
        return hidden.last_hidden_state[:, first - 1 : first - 1 + count]
