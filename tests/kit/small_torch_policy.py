"""The small flow policy of examples/small_policy.py, with the logits and values of its attention on request."""

from __future__ import annotations

from typing import Any

import torch
from msgspec.structs import replace
from torch import Tensor

from examples import small_policy
from examples.small_policy import BLOCKS, HEADS, HORIZON, PROMPT, STEPS, WIDTH, WORDS, Block, WordTokenizer, given
from vla_attention.capture.torch_policies.policy_layout import CameraPicture, PolicyLayout

__all__ = ["BLOCKS", "PROMPT", "WORDS", "Block", "WordTokenizer", "given"]


class Attention(small_policy.Attention):
    def __init__(self) -> None:
        super().__init__()
        #: Where a list stands here, every call adds (logits with the mask, values), computed by hand.
        self.kept: list[tuple[Tensor, Tensor]] | None = None

    def forward(self, tokens: Tensor, cache: list[Tensor], mask: Tensor) -> Tensor:
        if self.kept is not None:
            q, k, v = (
                part.view(len(tokens), -1, HEADS, WIDTH // HEADS).transpose(1, 2)
                for part in self.qkv(tokens).chunk(3, dim=-1)
            )
            if cache:
                k, v = torch.cat([cache[0], k], dim=2), torch.cat([cache[1], v], dim=2)
            logits = q @ k.transpose(2, 3) * (WIDTH // HEADS) ** -0.5
            self.kept.append((logits.masked_fill(~mask, -torch.inf), v))
        return super().forward(tokens, cache, mask)


class SmallPolicy(small_policy.SmallPolicy):
    def __init__(self, seed: int = 0) -> None:
        super().__init__(seed)
        for block in self.blocks:
            weights, block.attention = block.attention.state_dict(), Attention()
            block.attention.load_state_dict(weights)
        self.eval()


def small_layout(**changes: Any) -> PolicyLayout:
    """The layout of `SmallPolicy`, with what a layout may leave out, too."""
    fields: dict[str, Any] = {
        "denoise_times": tuple(1 - step / STEPS for step in range(STEPS)),
        "cameras": (CameraPicture("front"),),
        "action_horizon": HORIZON,
        "action_dim": 2,
    }
    return replace(small_policy.layout(), **{**fields, **changes})
