"""Small policies of other kinds: one that generates tokens, and one whose blocks all compute in one module."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tests.kit.small_torch_policy import HEADS, WIDTH, WORDS, WordTokenizer
from vla_attention.capture.torch_policies.policy_layout import CallRule, PolicyLayout, PromptText, RecordedSite
from vla_attention.schemas.layout import PatchGrid, SiteLayout, Span

BLOCKS, PATCHES, LONGEST, TOKENS = 2, 4, 7, 4


def split_heads(tensor: Tensor) -> Tensor:
    """(batch, token, width) to (batch, head, token, dim)."""
    return tensor.view(len(tensor), -1, HEADS, WIDTH // HEADS).transpose(1, 2)


class CausalAttention(nn.Module):
    """Causal attention with a cache; keeps its rows by hand where a list stands in `kept`."""

    def __init__(self) -> None:
        super().__init__()
        self.qkv = nn.Linear(WIDTH, 3 * WIDTH)
        self.o_proj = nn.Linear(WIDTH, WIDTH, bias=False)
        self.cache: list[Tensor] = []
        self.kept: list[Tensor] | None = None

    def forward(self, tokens: Tensor) -> Tensor:
        q, k, v = (split_heads(part) for part in self.qkv(tokens).chunk(3, dim=-1))
        if self.cache:
            k, v = torch.cat([self.cache[0], k], dim=2), torch.cat([self.cache[1], v], dim=2)
        self.cache = [k, v]
        mask = torch.ones(q.shape[2], k.shape[2], dtype=torch.bool).tril(k.shape[2] - q.shape[2])
        if self.kept is not None:
            logits = q @ k.transpose(2, 3) * (WIDTH // HEADS) ** -0.5
            self.kept.append(logits.masked_fill(~mask, -torch.inf).softmax(-1)[0, :, -1])
        mixed = nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return self.o_proj(mixed.transpose(1, 2).flatten(2))


class TokenPolicy(nn.Module):
    """Patches, then a prompt without padding, then `tokens` generated tokens, one call each."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.patches = nn.Linear(3 * 4 * 4, WIDTH)
        self.embed_tokens = nn.Embedding(len(WORDS), WIDTH)
        self.layers = nn.ModuleList(CausalAttention() for _ in range(BLOCKS))
        self.head = nn.Linear(WIDTH, len(WORDS))
        self.tokenizer = WordTokenizer()

    @torch.no_grad()
    def act(self, picture: Tensor, text: str, tokens: int = TOKENS) -> list[int]:
        for layer in self.layers:
            layer.cache = []
        squares = picture[None].unfold(2, 4, 4).unfold(3, 4, 4).permute(0, 2, 3, 1, 4, 5).flatten(3).flatten(1, 2)
        words = self.embed_tokens(torch.tensor([self.tokenizer.encode(text)]))
        hidden = torch.cat([self.patches(squares), words], dim=1)
        generated: list[int] = []
        for _ in range(tokens):
            for layer in self.layers:
                hidden = hidden + layer(hidden)
            generated.append(int(self.head(hidden[:, -1]).argmax()))
            hidden = self.embed_tokens(torch.tensor([generated[-1:]]))
        return generated


def token_layout(*, stops_early: bool = False) -> PolicyLayout:
    """The layout of `TokenPolicy`."""
    keys = SiteLayout(
        "joint",
        (
            Span("image_front", "image", 0, PATCHES, "front", PatchGrid(2, 2, 8, 8)),
            Span("prompt", "text", PATCHES, PATCHES + LONGEST),
            Span("generated", "action", PATCHES + LONGEST, PATCHES + LONGEST + TOKENS - 1, growing=True),
        ),
    )
    roles = {"image_front": "image", "prompt": "instruction", "generated": "action"}
    return PolicyLayout(
        name="tokens",
        family="tokens",
        sites=(RecordedSite(keys, (-1, None), roles, "prompt"),),
        rules=(CallRule(r"layers\.(?P<block>\d+)", "joint"),),
        num_layers=BLOCKS,
        num_heads=HEADS,
        text=PromptText(("prompt",), "embed_tokens"),
        autoregressive=True,
        num_action_tokens=TOKENS,
        stops_early=stops_early,
    )


class OneModulePolicy(nn.Module):
    """Four blocks in one module: even ones attend to prefix and actions, odd ones to the prefix only; two steps."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.expert = Expert()

    @torch.no_grad()
    def act(self, prefix: Tensor, noise: Tensor) -> Tensor:
        actions = noise
        for _ in range(2):
            actions = actions - 0.5 * self.expert(prefix, actions)
        return actions


class Expert(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.projections = nn.ModuleList(nn.Linear(WIDTH, WIDTH) for _ in range(4))

    def forward(self, prefix: Tensor, actions: Tensor) -> Tensor:
        hidden = actions
        for number, projection in enumerate(self.projections):
            keys = torch.cat([prefix, hidden], dim=1) if number % 2 == 0 else prefix
            q, k = split_heads(hidden), split_heads(keys)
            mixed = nn.functional.scaled_dot_product_attention(q, k, k)
            hidden = hidden + projection(mixed.transpose(1, 2).flatten(2))
        return hidden


def one_module_layout() -> PolicyLayout:
    """The layout of `OneModulePolicy` with 5 prefix and 3 action tokens."""
    prefix = Span("prefix", "text", 0, 5)
    own = SiteLayout("self", (prefix, Span("actions", "action", 5, 8)), layers=(0, 2))
    cross = SiteLayout("cross", (prefix,), layers=(1, 3))
    return PolicyLayout(
        name="one module",
        family="one",
        sites=(
            RecordedSite(own, (0, 3), {"prefix": "text", "actions": "action"}),
            RecordedSite(cross, (0, 3), {"prefix": "text"}),
        ),
        rules=(CallRule("expert", None, sequence=(("self", 0), ("cross", 1), ("self", 2), ("cross", 3))),),
        num_layers=4,
        num_heads=HEADS,
        num_denoise_steps=2,
        action_horizon=3,
    )


class TurnsPolicy(nn.Module):
    """Two blocks over the same tokens, of pictures and of text: the first reads the text only, the second the pictures.

    As in GR00T N1.7: 4 patches, then 5 words.
    """

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.embed = nn.Embedding(len(WORDS), WIDTH)
        self.blocks = nn.ModuleList(Cross() for _ in range(2))
        self.tokenizer = WordTokenizer()

    @torch.no_grad()
    def act(self, patches: Tensor, text: str, noise: Tensor) -> Tensor:
        words = self.embed(torch.tensor([self.tokenizer.encode(text)]))
        tokens = torch.cat([patches, words], dim=1)
        is_text = torch.arange(tokens.shape[1]) >= PATCHES
        for block, mask in zip(self.blocks, (is_text, ~is_text), strict=True):
            noise = noise + block(noise, tokens, mask[None, None, None].expand(1, 1, noise.shape[1], -1))
        return noise


class Cross(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.out = nn.Linear(WIDTH, WIDTH)

    def forward(self, queries: Tensor, tokens: Tensor, mask: Tensor) -> Tensor:
        q, k = split_heads(queries), split_heads(tokens)
        mixed = nn.functional.scaled_dot_product_attention(q, k, k, attn_mask=mask)
        return self.out(mixed.transpose(1, 2).flatten(2))


def turns_layout() -> PolicyLayout:
    """The layout of `TurnsPolicy` with three words, a start and an end."""
    spans = (
        Span("image_front", "image", 0, PATCHES, "front", PatchGrid(2, 2, 8, 8)),
        Span("prompt", "text", PATCHES, PATCHES + 5),
    )
    roles = {"image_front": "image", "prompt": "instruction"}
    names = ("cross_text", "cross_image")
    return PolicyLayout(
        name="turns",
        family="turns",
        sites=tuple(
            RecordedSite(SiteLayout(name, spans, layers=(block,)), (0, 3), roles) for block, name in enumerate(names)
        ),
        rules=tuple(CallRule(rf"blocks\.(?P<block>{block})", name) for block, name in enumerate(names)),
        num_layers=2,
        num_heads=HEADS,
        text=PromptText(("prompt",), "embed"),
    )
