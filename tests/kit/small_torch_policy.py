"""A small flow policy that no adapter knows: picture, prompt, state and actions in one sequence, four denoise steps."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from vla_attention.capture.torch_policies.policy_layout import (
    CallRule,
    CameraPicture,
    PolicyLayout,
    PromptText,
    RecordedSite,
)
from vla_attention.schemas.layout import PatchGrid, SiteLayout, Span

WIDTH, HEADS, BLOCKS, STEPS, HORIZON, PROMPT = 16, 2, 3, 4, 3, 6
WORDS = ["<pad>", "<bos>", " pick", " up", " the", " red", " bowl", " plate", "\n"]


class WordTokenizer:
    """One token a word; words that it does not know are all one."""

    all_special_ids = (0, 1)
    bos_token_id = 1

    def encode(self, text: str) -> list[int]:
        return [1, *(WORDS.index(f" {word}") if f" {word}" in WORDS else 2 for word in text.split()), 8]

    def decode(self, ids: list[int]) -> str:
        return "".join(WORDS[number] for number in ids)


class Attention(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.qkv = nn.Linear(WIDTH, 3 * WIDTH)
        self.out = nn.Linear(WIDTH, WIDTH)
        #: Where a list stands here, every call adds (logits with the mask, values), computed by hand.
        self.kept: list[tuple[Tensor, Tensor]] | None = None

    def forward(self, tokens: Tensor, cache: list[Tensor], mask: Tensor) -> Tensor:
        q, k, v = (
            part.view(len(tokens), -1, HEADS, WIDTH // HEADS).transpose(1, 2)
            for part in self.qkv(tokens).chunk(3, dim=-1)
        )
        if cache:
            k, v = torch.cat([cache[0], k], dim=2), torch.cat([cache[1], v], dim=2)
        else:
            cache.extend([k, v])
        if self.kept is not None:
            logits = q @ k.transpose(2, 3) * (WIDTH // HEADS) ** -0.5
            self.kept.append((logits.masked_fill(~mask, -torch.inf), v))
        mixed = nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return self.out(mixed.transpose(1, 2).flatten(2))


class Block(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(WIDTH)
        self.attention = Attention()

    def forward(self, tokens: Tensor, cache: list[Tensor], mask: Tensor) -> Tensor:
        return tokens + self.attention(self.norm(tokens), cache, mask)


class SmallPolicy(nn.Module):
    """`act(pictures, texts, states, noise)` -> actions (batch, horizon, 2)."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        torch.manual_seed(seed)
        self.patches = nn.Linear(3 * 4 * 4, WIDTH)
        self.words = nn.Embedding(len(WORDS), WIDTH)
        self.state = nn.Linear(2, WIDTH)
        self.action_in = nn.Linear(2, WIDTH)
        self.blocks = nn.ModuleList(Block() for _ in range(BLOCKS))
        self.action_out = nn.Linear(WIDTH, 2)
        self.tokenizer = WordTokenizer()
        self.eval()

    @torch.no_grad()
    def act(self, pictures: Tensor, texts: list[str], states: Tensor, noise: Tensor) -> Tensor:
        ids = [self.tokenizer.encode(text) for text in texts]
        ids_tensor = torch.tensor([row + [0] * (PROMPT - len(row)) for row in ids])
        squares = pictures.unfold(2, 4, 4).unfold(3, 4, 4).permute(0, 2, 3, 1, 4, 5).flatten(3).flatten(1, 2)
        prefix = torch.cat([self.patches(squares), self.words(ids_tensor), self.state(states)[:, None]], dim=1)
        valid = torch.cat([torch.ones(len(ids), 4).bool(), ids_tensor != 0, torch.ones(len(ids), 1).bool()], dim=1)
        caches: list[list[Tensor]] = [[] for _ in self.blocks]
        hidden = prefix
        for block, cache in zip(self.blocks, caches, strict=True):
            hidden = block(hidden, cache, valid[:, None, None].expand(-1, -1, prefix.shape[1], -1))
        seen = torch.cat([valid, torch.ones(len(ids), HORIZON).bool()], dim=1)[:, None, None]
        actions = noise
        for _ in range(STEPS):
            hidden = self.action_in(actions)
            for block, cache in zip(self.blocks, caches, strict=True):
                hidden = block(hidden, cache, seen.expand(-1, -1, HORIZON, -1))
            actions = actions + self.action_out(hidden) / STEPS
        return actions


def given(batch: int = 1, seed: int = 0, text: str = "pick the bowl") -> dict[str, Any]:
    """What `act` is given."""
    stream = torch.Generator().manual_seed(seed)
    return {
        "pictures": torch.rand(batch, 3, 8, 8, generator=stream),
        "texts": [text] * batch,
        "states": torch.randn(batch, 2, generator=stream),
        "noise": torch.randn(batch, HORIZON, 2, generator=stream),
    }


def small_layout(**changes: Any) -> PolicyLayout:
    """The layout of `SmallPolicy`."""
    keys = SiteLayout(
        "joint",
        (
            Span("image_front", "image", 0, 4, "front", PatchGrid(2, 2, 8, 8)),
            Span("prompt", "text", 4, 4 + PROMPT),
            Span("state", "state", 4 + PROMPT, 5 + PROMPT),
            Span("actions", "action", 5 + PROMPT, 5 + PROMPT + HORIZON),
        ),
    )
    roles = {"image_front": "image", "prompt": "instruction", "state": "state", "actions": "action"}
    fields: dict[str, Any] = {
        "name": "small",
        "family": "small",
        "sites": (RecordedSite(keys, (0, HORIZON), roles),),
        "rules": (
            CallRule(r"blocks\.(?P<block>\d+)\.attention", "joint", queries=HORIZON),
            CallRule(r"blocks\.\d+\.attention", None, queries=5 + PROMPT),
        ),
        "num_layers": BLOCKS,
        "num_heads": HEADS,
        "num_denoise_steps": STEPS,
        "denoise_times": tuple(1 - step / STEPS for step in range(STEPS)),
        "cameras": (CameraPicture("front"),),
        "text": PromptText(("prompt",), "words"),
        "action_horizon": HORIZON,
        "action_dim": 2,
    }
    return PolicyLayout(**{**fields, **changes})
