"""A policy that no layout knows, and how its attention is recorded into runs/small.zarr.

Usage: python examples/small_policy.py

Its weights are random, so its numbers mean nothing; docs/my-policy.md explains the recording piece by piece. The policy
reads a picture of 8 x 8 pixels in 4 patches, a sentence of up to 6 tokens and a state of 2 numbers, and gives 3 actions
after 4 denoise steps. Needs torch; no simulator, no GPU.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

import vla_attention as va

WIDTH, HEADS, BLOCKS, STEPS, HORIZON, PROMPT = 16, 2, 3, 4, 3, 6
WORDS = ["<pad>", "<bos>", " pick", " up", " the", " red", " bowl", " plate", "\n"]


class WordTokenizer:
    """One token a word; words that it does not know are all one."""

    all_special_ids = (0, 1)
    bos_token_id = 1

    def encode(self, text: str) -> list[int]:
        """The token ids of a sentence."""
        return [1, *(WORDS.index(f" {word}") if f" {word}" in WORDS else 2 for word in text.split()), 8]

    def decode(self, ids: list[int]) -> str:
        """The text of token ids."""
        return "".join(WORDS[number] for number in ids)


class Attention(nn.Module):
    """Queries of these tokens over the keys of the cache and their own."""

    def __init__(self) -> None:
        super().__init__()
        self.qkv = nn.Linear(WIDTH, 3 * WIDTH)
        self.out = nn.Linear(WIDTH, WIDTH)

    def forward(self, tokens: Tensor, cache: list[Tensor], mask: Tensor) -> Tensor:
        """Tokens (batch, token, width); an empty cache is filled. mask: (batch, 1, query, key), True = read."""
        q, k, v = (
            part.view(len(tokens), -1, HEADS, WIDTH // HEADS).transpose(1, 2)
            for part in self.qkv(tokens).chunk(3, dim=-1)
        )
        if cache:
            k, v = torch.cat([cache[0], k], dim=2), torch.cat([cache[1], v], dim=2)
        else:
            cache.extend([k, v])
        mixed = nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return self.out(mixed.transpose(1, 2).flatten(2))


class Block(nn.Module):
    """A residual block of attention alone."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(WIDTH)
        self.attention = Attention()

    def forward(self, tokens: Tensor, cache: list[Tensor], mask: Tensor) -> Tensor:
        """What attention adds, added."""
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
        """The prefix once, then the actions at every denoise step."""
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
    """What `act` is given: made-up pictures, states and noise."""
    stream = torch.Generator().manual_seed(seed)
    return {
        "pictures": torch.rand(batch, 3, 8, 8, generator=stream),
        "texts": [text] * batch,
        "states": torch.randn(batch, 2, generator=stream),
        "noise": torch.randn(batch, HORIZON, 2, generator=stream),
    }


def layout() -> va.PolicyLayout:
    """Which attention calls have action queries, and what their 14 keys are."""
    keys = va.SiteLayout(
        "joint",
        (
            va.Span("image_front", "image", 0, 4, camera="front", grid=va.PatchGrid(2, 2, 8, 8)),
            va.Span("prompt", "text", 4, 10),
            va.Span("state", "state", 10, 11),
            va.Span("actions", "action", 11, 14),
        ),
    )
    roles = {"image_front": "image", "prompt": "instruction", "state": "state", "actions": "action"}
    return va.PolicyLayout(
        name="small",
        family="small",
        num_layers=BLOCKS,
        num_heads=HEADS,
        num_denoise_steps=STEPS,
        sites=(va.RecordedSite(keys, (0, HORIZON), roles),),
        rules=(
            va.CallRule(r"blocks\.(?P<block>\d+)\.attention", "joint", queries=HORIZON),
            va.CallRule(r"blocks\.\d+\.attention", None, queries=11),  # the prefix has no action queries
        ),
        text=va.PromptText(("prompt",), embedding="words"),
    )


def main() -> None:
    """Record two tasks of two episodes; in their place stands your evaluation."""
    policy = SmallPolicy()
    with va.record("runs/small.zarr", policy, layout=layout(), tokenizer=policy.tokenizer, overwrite=True) as run:
        for task_id, sentence in enumerate(("pick the bowl", "pick the plate")):
            for episode_index in range(2):
                with run.episode(task_id=task_id, episode_index=episode_index, instruction=sentence) as episode:
                    for step in range(0, 30, 10):
                        batch = given(seed=step + episode_index, text=sentence)
                        with episode.replan(env_step=step, frames={"front": batch["pictures"]}) as replan:
                            replan.actions = policy.act(**batch)
                    episode.success = True
    print("Store: runs/small.zarr. Next: vla-attention words runs/small.zarr")


if __name__ == "__main__":
    main()
