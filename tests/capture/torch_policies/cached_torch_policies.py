"""`TokenPolicy` with other caches than one that grows, and a policy whose blocks run several times."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tests.kit.small_torch_policy import HEADS, WIDTH
from tests.kit.small_torch_variants import BLOCKS, LONGEST, PATCHES, TOKENS, CausalAttention, TokenPolicy, split_heads
from vla_attention.capture.torch_policies.policy_layout import CallRule, PolicyLayout, RecordedSite
from vla_attention.schemas.layout import PatchGrid, SiteLayout, Span

SLOTS, WINDOW = PATCHES + LONGEST + TOKENS, 7


class StaticAttention(CausalAttention):
    """A cache of `SLOTS` keys, written in place; the first call leaves the empty ones out."""

    def forward(self, tokens: Tensor) -> Tensor:
        q, k, v = (split_heads(part) for part in self.qkv(tokens).chunk(3, dim=-1))
        first = not self.cache
        if first:
            self.cache, self.length = [torch.zeros(1, HEADS, SLOTS, WIDTH // HEADS) for _ in range(2)], 0
        start, self.length = self.length, self.length + q.shape[2]
        for slots, new in zip(self.cache, (k, v), strict=True):
            slots[:, :, start : self.length] = new
        mask = torch.arange(SLOTS) <= torch.arange(start, self.length)[:, None]
        keys = slice(0, self.length if first else SLOTS)
        mixed = nn.functional.scaled_dot_product_attention(
            q, self.cache[0][:, :, keys], self.cache[1][:, :, keys], attn_mask=mask[:, keys]
        )
        return self.o_proj(mixed.transpose(1, 2).flatten(2))


class SlidingAttention(CausalAttention):
    """A cache of the last `WINDOW` keys."""

    def forward(self, tokens: Tensor) -> Tensor:
        mixed = super().forward(tokens)
        # The next call adds a key.
        self.cache = [kept[:, :, -(WINDOW - 1) :] for kept in self.cache]
        return mixed


def cached_policy(attention: type[CausalAttention]) -> TokenPolicy:
    """A `TokenPolicy` with another attention and the same weights."""
    policy = TokenPolicy()
    for number, layer in enumerate(policy.layers):
        other = attention()
        other.load_state_dict(layer.state_dict())
        policy.layers[number] = other
    return policy


def fixed_layout() -> PolicyLayout:
    """A layout that fits every call of `WINDOW` keys: 4 patches and the first 3 words, none of generated tokens."""
    spans = (
        Span("image_front", "image", 0, PATCHES, "front", PatchGrid(2, 2, 8, 8)),
        Span("prompt", "text", PATCHES, WINDOW),
    )
    return PolicyLayout(
        name="fixed",
        family="fixed",
        sites=(
            RecordedSite(SiteLayout("joint", spans), (-1, None), {"image_front": "image", "prompt": "instruction"}),
        ),
        rules=(CallRule(r"layers\.(?P<block>\d+)", "joint"),),
        num_layers=BLOCKS,
        num_heads=HEADS,
        autoregressive=True,
        num_action_tokens=TOKENS,
    )


class LoopedPolicy(nn.Module):
    """Two blocks that run twice in each of two denoise steps, over 5 prefix tokens and 3 action tokens."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.blocks = nn.ModuleList(Looped() for _ in range(2))

    @torch.no_grad()
    def act(self, prefix: Tensor, noise: Tensor) -> Tensor:
        """Return actions (1, 3, width)."""
        actions = noise
        for _ in range(2):
            hidden = actions
            for block in (*self.blocks, *self.blocks):
                hidden = hidden + block(hidden, prefix)
            actions = actions - 0.5 * hidden
        return actions


class Looped(nn.Module):
    """Attention over prefix and actions; keeps its rows by hand in `kept`."""

    def __init__(self) -> None:
        super().__init__()
        self.out = nn.Linear(WIDTH, WIDTH)
        self.kept: list[Tensor] = []

    def forward(self, hidden: Tensor, prefix: Tensor) -> Tensor:
        q, k = split_heads(hidden), split_heads(torch.cat([prefix, hidden], dim=1))
        self.kept.append((q @ k.transpose(2, 3) * (WIDTH // HEADS) ** -0.5).softmax(-1)[0])
        mixed = nn.functional.scaled_dot_product_attention(q, k, k)
        return self.out(mixed.transpose(1, 2).flatten(2))


def looped_layout(*, sequence: bool = True) -> PolicyLayout:
    """The layout of `LoopedPolicy`: the second run of its blocks as blocks 2 and 3, or without a sequence."""
    keys = SiteLayout("joint", (Span("prefix", "text", 0, 5), Span("actions", "action", 5, 8)))
    calls = tuple(("joint", block) for block in range(4))
    of_blocks = CallRule(r"blocks\.\d+", None, sequence=calls)
    return PolicyLayout(
        name="looped",
        family="looped",
        sites=(RecordedSite(keys, (0, 3), {"prefix": "text", "actions": "action"}),),
        rules=(of_blocks if sequence else CallRule(r"blocks\.(?P<block>\d+)", "joint"),),
        num_layers=4 if sequence else 2,
        num_heads=HEADS,
        num_denoise_steps=2,
    )
