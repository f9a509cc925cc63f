"""A small policy whose blocks add what their attention gives to the residual stream in many ways.

A way is a pair of functions: `add`, the policy's own code, and `part`, by hand: what some keys' share of the mixed
values adds with the factors of that call.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_attention.capture.torch_policies.policy_layout import CallRule, PolicyLayout, RecordedSite
from vla_attention.schemas.layout import PatchGrid, SiteLayout, Span

WIDTH, HEADS, DIM, PREFIX, TEXT, ACTIONS, BLOCKS, STEPS = 12, 3, 5, 6, 2, 4, 2, 2
KEYS = PREFIX + ACTIONS
PARTS = {"image": slice(0, PREFIX - TEXT), "text": slice(PREFIX - TEXT, PREFIX), "actions": slice(PREFIX, KEYS)}


@dataclass
class Call:
    """What a block computed in one call.

    stream, normed: (batch, query, width). mixed: (batch, query, head · dim). rows: (batch, head, query, key). value:
    (batch, head, key, dim). condition: (batch, width). branch: of a feed-forward layer before the attention.
    """

    stream: Tensor
    normed: Tensor
    mixed: Tensor
    rows: Tensor
    value: Tensor
    condition: Tensor
    branch: Tensor
    older: Tensor

    def share(self, keys: slice) -> Tensor:
        """The mixed values (batch, query, head · dim) of some keys."""
        shares = self.rows[..., keys] @ self.value[:, :, keys].float()
        return shares.transpose(1, 2).flatten(2).to(self.mixed.dtype)


class GemmaNorm(nn.Module):
    """As in transformers: the norm by hand, in float32, with an offset from 1 as its weight."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(width) / 3)

    def forward(self, x: Tensor) -> Tensor:
        output = x.float() * torch.rsqrt(x.float().pow(2).mean(-1, keepdim=True) + 1e-6)
        return (output * (1.0 + self.weight.float())).type_as(x)


class LayerScale(nn.Module):
    """As in timm; `inplace` writes over what it is given."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma, self.inplace = nn.Parameter(torch.randn(width)), False

    def forward(self, x: Tensor) -> Tensor:
        return x.mul_(self.gamma) if self.inplace else x * self.gamma


Add = Callable[["Block", Call], Tensor]
Part = Callable[["Block", Call, Tensor], Tensor]


class Block(nn.Module):
    """Norm, attention, what `add` does with it, and a feed-forward layer."""

    def __init__(self, add: Add) -> None:
        super().__init__()
        self.add = add
        inner = HEADS * DIM
        self.norm = nn.LayerNorm(WIDTH)
        self.query, self.key, self.value = (nn.Linear(WIDTH, inner) for _ in range(3))
        self.gate_proj = nn.Linear(WIDTH, inner)
        self.out = nn.Linear(inner, WIDTH)
        self.modulation = nn.Sequential(nn.SiLU(), nn.Linear(WIDTH, 3 * WIDTH))
        self.post_norm, self.rms_norm, self.layer_norm = GemmaNorm(WIDTH), nn.RMSNorm(WIDTH), nn.LayerNorm(WIDTH)
        for norm in (self.rms_norm, self.layer_norm):
            nn.init.normal_(norm.weight)
        nn.init.normal_(self.layer_norm.bias)
        self.scale, self.dropout = LayerScale(WIDTH), nn.Dropout(0.3)
        self.alpha = nn.Parameter(torch.tensor(0.4))
        self.second = nn.Linear(WIDTH, WIDTH)
        self.mlp = nn.Sequential(nn.Linear(WIDTH, 2 * WIDTH), nn.GELU(), nn.Linear(2 * WIDTH, WIDTH))
        self.beside = nn.Sequential(nn.Linear(inner, 2, bias=False), nn.Linear(2, WIDTH, bias=False))
        self.kept: list[Call] | None = None

    def forward(self, tokens: Tensor, prefix: Tensor, condition: Tensor) -> Tensor:
        normed = self.norm(tokens)
        branch, older = self.mlp(normed), self.gate_proj(normed)
        both = torch.cat([prefix, normed], dim=1)
        q, k, v = (
            linear(given).view(len(given), -1, HEADS, DIM).transpose(1, 2)
            for linear, given in ((self.query, normed), (self.key, both), (self.value, both))
        )
        mixed = functional.scaled_dot_product_attention(q, k, v)
        folded = mixed.transpose(1, 2).contiguous().view(len(mixed), -1, HEADS * DIM)
        rows = None
        if self.kept is not None:
            rows = ((q.float() @ k.float().transpose(2, 3)) / DIM**0.5).softmax(-1)
            # Some ways write over what they are given.
            self.kept.append(Call(tokens.clone(), normed, folded.clone(), rows, v, condition, branch, older))
        tokens = self.add(self, Call(tokens, normed, folded, q, v, condition, branch, older))
        return tokens + self.mlp(tokens)


class ResidualPolicy(nn.Module):
    """`act(batch)`: STEPS denoise steps, each with another condition."""

    def __init__(self, add: Add, seed: int = 0) -> None:
        super().__init__()
        torch.manual_seed(seed)
        self.blocks = nn.ModuleList(Block(add) for _ in range(BLOCKS))
        self.eval()

    @torch.no_grad()
    def act(self, batch: int = 1) -> Tensor:
        numbers = torch.Generator().manual_seed(1)
        dtype = self.blocks[0].norm.weight.dtype
        prefix, tokens, condition = (
            torch.randn(batch, *size, generator=numbers).to(dtype)
            for size in ((PREFIX, WIDTH), (ACTIONS, WIDTH), (WIDTH,))
        )
        for step in range(STEPS):
            hidden = tokens
            for block in self.blocks:
                hidden = block(hidden, prefix, condition + step)
            tokens = tokens - hidden / STEPS
        return tokens

    def calls(self, batch: int = 1) -> list[list[Call]]:
        """What each block computes at each denoise step."""
        for block in self.blocks:
            block.kept = []
        self.act(batch)
        found = [block.kept for block in self.blocks]
        for block in self.blocks:
            block.kept = None
        return found


def residual_layout(**changes: Any) -> PolicyLayout:
    """The layout of `ResidualPolicy`."""
    spans = (
        Span("image_front", "image", 0, PREFIX - TEXT, "front", PatchGrid(2, 2, 8, 8)),
        Span("prompt", "text", PREFIX - TEXT, PREFIX),
        Span("actions", "action", PREFIX, KEYS),
    )
    roles = {"image_front": "image", "prompt": "instruction", "actions": "action"}
    site = RecordedSite(SiteLayout("joint", spans), (0, ACTIONS), roles)
    fields: dict[str, Any] = {
        "name": "residual",
        "family": "residual",
        "sites": (site,),
        "rules": (CallRule(r"blocks\.(?P<block>\d+)", "joint"),),
        "num_layers": BLOCKS,
        "num_heads": HEADS,
        "num_denoise_steps": STEPS,
    }
    return PolicyLayout(**{**fields, **changes})


def projected(block: Block, share: Tensor) -> Tensor:
    """Return the share of the mixed values behind the output projection, without its bias."""
    return share @ block.out.weight.T


@dataclass(frozen=True)
class Way:
    """A way from the attention to the residual stream, in the policy's own code and by hand."""

    add: Add
    part: Part


def chunk(block: Block, call: Call, number: int) -> Tensor:
    """A third of the modulation (batch, 1, width)."""
    return block.modulation(call.condition)[:, None].chunk(3, dim=-1)[number]


def rms(x: Tensor, eps: float = 1e-6) -> Tensor:
    return (x.square().mean(-1, keepdim=True) + eps).rsqrt()


def gated_residual(x: Tensor, y: Tensor, gate: Tensor | None) -> Tensor:
    """As in openpi's transformers."""
    return x + y if gate is None else x + y * gate


def with_gemma_norm(block: Block, call: Call) -> Tensor:
    update = block.out(call.mixed)
    return call.stream + block.post_norm(update)


def in_place(block: Block, call: Call) -> Tensor:
    block.scale.inplace = True
    update = block.scale(block.out(call.mixed))
    update += call.stream
    return update


def gemma_part(block: Block, call: Call, share: Tensor) -> Tensor:
    return projected(block, share) * rms(block.out(call.mixed)) * (1 + block.post_norm.weight)


def before(block: Block, call: Call) -> Tensor:
    return torch.sigmoid(block.gate_proj(call.normed))


#: Ways that are seen.
WAYS: dict[str, Way] = {
    "plain": Way(lambda b, c: c.stream + b.out(c.mixed), lambda b, c, s: projected(b, s)),
    "dropout": Way(lambda b, c: b.dropout(b.out(c.mixed)) + c.stream, lambda b, c, s: projected(b, s)),
    "adaLN": Way(
        lambda b, c: c.stream + chunk(b, c, 2) * b.out(c.mixed), lambda b, c, s: projected(b, s) * chunk(b, c, 2)
    ),
    "gate before the projection": Way(
        lambda b, c: c.stream + b.out(c.mixed * before(b, c)), lambda b, c, s: projected(b, s * before(b, c))
    ),
    "gate before in place": Way(
        lambda b, c: c.stream + b.out(c.mixed.mul_(before(b, c))), lambda b, c, s: projected(b, s * before(b, c))
    ),
    "both gates": Way(
        lambda b, c: c.stream + chunk(b, c, 1) * b.out(c.mixed * before(b, c)),
        lambda b, c, s: projected(b, s * before(b, c)) * chunk(b, c, 1),
    ),
    "norm before the projection": Way(
        lambda b, c: c.stream + b.out(functional.rms_norm(c.mixed, c.mixed.shape[-1:], eps=1e-6)),
        lambda b, c, s: projected(b, s * rms(c.mixed)),
    ),
    "Gemma": Way(with_gemma_norm, gemma_part),
    "RMSNorm": Way(
        lambda b, c: c.stream + b.rms_norm(b.out(c.mixed)),
        lambda b, c, s: projected(b, s) * rms(b.out(c.mixed), 1.2e-7) * b.rms_norm.weight,
    ),
    "LayerScale": Way(lambda b, c: c.stream + b.scale(b.out(c.mixed)), lambda b, c, s: projected(b, s) * b.scale.gamma),
    "LayerScale in place": Way(in_place, lambda b, c, s: projected(b, s) * b.scale.gamma),
    "gated residual": Way(
        lambda b, c: gated_residual(c.stream, b.out(c.mixed), chunk(b, c, 2)),
        lambda b, c, s: projected(b, s) * chunk(b, c, 2),
    ),
    "alpha": Way(lambda b, c: torch.add(c.stream, b.out(c.mixed), alpha=0.3), lambda b, c, s: 0.3 * projected(b, s)),
    "ReZero": Way(lambda b, c: c.stream + b.alpha * b.out(c.mixed), lambda b, c, s: b.alpha * projected(b, s)),
    "float32 stream": Way(
        lambda b, c: (c.stream.float() + b.out(c.mixed) * chunk(b, c, 1)).type_as(c.stream),
        lambda b, c, s: projected(b, s) * chunk(b, c, 1),
    ),
    "projected in bfloat16": Way(
        lambda b, c: c.stream + nn.functional.linear(c.mixed.bfloat16(), b.out.weight.bfloat16()).float(),
        lambda b, c, s: projected(b, s),
    ),
    "norm behind the sum": Way(lambda b, c: b.layer_norm(c.stream + b.out(c.mixed)), lambda b, c, s: projected(b, s)),
    "norm behind the sum, weighted": Way(
        lambda b, c: functional.layer_norm(c.stream + b.out(c.mixed), (WIDTH,)) * (1 + chunk(b, c, 1)),
        lambda b, c, s: projected(b, s),
    ),
    "norm by a square": Way(
        lambda b, c: c.stream + (lambda u: u * torch.rsqrt((u * u).mean(-1, keepdim=True) + 1e-6))(b.out(c.mixed)),
        lambda b, c, s: projected(b, s) * rms(b.out(c.mixed)),
    ),
    "written into a copy": Way(
        lambda b, c: c.stream.clone().index_copy_(1, torch.arange(ACTIONS), c.stream + b.out(c.mixed)),
        lambda b, c, s: projected(b, s),
    ),
    "scaled stream": Way(lambda b, c: 1.5 * c.stream + b.out(c.mixed), lambda b, c, s: projected(b, s)),
    "parallel feed-forward": Way(
        lambda b, c: b.out(c.mixed) + b.mlp(c.normed) + c.stream, lambda b, c, s: projected(b, s)
    ),
    "feed-forward before": Way(lambda b, c: c.branch + b.out(c.mixed) + c.stream, lambda b, c, s: projected(b, s)),
    "feed-forward in between": Way(
        lambda b, c: (c.stream + b.mlp(c.normed)) + chunk(b, c, 1) * b.out(c.mixed),
        lambda b, c, s: projected(b, s) * chunk(b, c, 1),
    ),
    "sum with zeros as large": Way(
        lambda b, c: (lambda update: (c.stream.expand_as(update) + torch.zeros_like(update)) + update)(b.out(c.mixed)),
        lambda b, c, s: projected(b, s),
    ),
    "turned around": Way(
        lambda b, c: c.stream + (b.out(c.mixed).transpose(0, 1) * chunk(b, c, 2).transpose(0, 1)).transpose(0, 1),
        lambda b, c, s: projected(b, s) * chunk(b, c, 2),
    ),
    "flat": Way(
        lambda b, c: c.stream + b.out(c.mixed.reshape(-1, HEADS * DIM)).view(c.stream.shape),
        lambda b, c, s: projected(b, s),
    ),
}


def added_in_place(block: Block, call: Call) -> Tensor:
    tokens = call.stream + block.out(call.mixed)
    tokens += block.beside(call.mixed)
    return tokens


def added_to_some_numbers(block: Block, call: Call) -> Tensor:
    tokens = call.stream + block.out(call.mixed)
    tokens[..., :5].add_(block.beside(call.mixed)[..., :5])
    return tokens


def added_behind_the_feed_forward(block: Block, call: Call) -> Tensor:
    tokens = call.stream + block.out(call.mixed)
    tokens = tokens + block.mlp(tokens)
    return tokens + block.beside(call.mixed)


def added_to_some_queries_and_to_others(block: Block, call: Call) -> Tensor:
    tokens, update = call.stream.clone(), block.out(call.mixed)
    tokens[:, :1] += update[:, :1]
    tokens[:, 1:] += update[:, 1:]
    return tokens


def linear_part(add: Add) -> Part:
    """Of a way that is linear: what it adds with a share of the mixed values, less what it adds with none."""

    def part(block: Block, call: Call, share: Tensor) -> Tensor:
        with_share, without = (
            add(block, replace(call, mixed=mixed.clone(), stream=call.stream.clone()))
            for mixed in (share, torch.zeros_like(share))
        )
        return with_share - without

    return part


ORDER, FIRST = torch.tensor([2, 0, 1, 3]), (torch.arange(ACTIONS) == 0)[None, :, None]

#: Further ways, all linear: other layers on the way, sums that are not the residual stream, and several ways.
_LINEAR: dict[str, Add] = {
    "adaLN in one function": lambda b, c: torch.addcmul(c.stream, b.out(c.mixed), chunk(b, c, 2)),
    "second linear layer": lambda b, c: c.stream + b.second(b.out(c.mixed)),
    "other tokens": lambda b, c: c.stream + b.out(c.mixed).flip(1),
    "mixed heads": lambda b, c: c.stream + b.out(c.mixed.unflatten(-1, (HEADS, DIM)).mT.flatten(-2)),
    "value residual": lambda b, c: c.stream + b.out(c.mixed + b.gate_proj(c.normed)),
    "older value residual": lambda b, c: c.stream + b.out(c.older + c.mixed),
    "adapter beside the projection": lambda b, c: c.stream + (b.out(c.mixed) + b.beside(c.mixed)),
    "scaled adapter of a copy": (lambda b, c: c.stream + (b.out(c.mixed) + 0.5 * b.beside(c.mixed.double().float()))),
    "adapter behind the projection": (
        lambda b, c: c.stream + (lambda update: update + b.second(update))(b.out(c.mixed))
    ),
    "adapter in a gated branch": lambda b, c: c.stream + chunk(b, c, 2) * (b.out(c.mixed) + b.beside(c.mixed)),
    "adapter of some heads": lambda b, c: c.stream + (b.out(c.mixed) + b.second(c.mixed[..., :WIDTH])),
    "another way before": lambda b, c: (c.stream + b.beside(c.mixed)) + b.out(c.mixed),
    "another way behind": lambda b, c: (c.stream + b.out(c.mixed)) + b.beside(c.mixed),
    "another way behind, fused": (lambda b, c: torch.addcmul(c.stream + b.out(c.mixed), b.beside(c.mixed), b.alpha)),
    "another way in place": added_in_place,
    "added twice": lambda b, c: (lambda update: c.stream + update + 0.5 * update)(b.out(c.mixed)),
    "added constant": lambda b, c: c.stream + chunk(b, c, 2) * (b.out(c.mixed) + b.second.bias),
    "LayerNorm by hand without its scale": (
        lambda b, c: c.stream + (lambda update: update - update.mean(-1, keepdim=True))(b.out(c.mixed))
    ),
    "gate of zero": lambda b, c: c.stream + 0 * b.out(c.mixed),
    "clamped far away": lambda b, c: c.stream + b.out(c.mixed).clamp(-100, 100),
    "sum that is clamped": lambda b, c: (c.stream + b.out(c.mixed)).clamp(-100, 100),
    "without NaN": lambda b, c: c.stream + torch.nan_to_num(b.out(c.mixed)),
    "where": lambda b, c: c.stream + torch.where(FIRST, b.out(c.mixed), c.normed),
    "masked fill": lambda b, c: c.stream + b.out(c.mixed).masked_fill(FIRST, 0.5),
    "masked fill in place": lambda b, c: c.stream + b.out(c.mixed).masked_fill_(FIRST, 0.5),
    "index_add": lambda b, c: c.stream.index_add(1, ORDER, b.out(c.mixed), alpha=0.5),
    "index_add onto one": lambda b, c: c.stream.index_add(1, 0 * ORDER, b.out(c.mixed)),
    "index_add in place": lambda b, c: c.stream.clone().index_add_(1, ORDER, b.out(c.mixed)),
    "index_copy": lambda b, c: c.stream + torch.zeros_like(c.stream).index_copy(1, ORDER, b.out(c.mixed)),
    "addmm": lambda b, c: torch.addmm(c.stream[0], c.mixed[0], b.out.weight.T, beta=0.9, alpha=1.1)[None],
    "baddbmm": lambda b, c: torch.baddbmm(c.stream, c.mixed, b.out.weight.T[None]),
    "where of the sum": lambda b, c: torch.where(c.normed > 0, c.stream + b.out(c.mixed), c.stream),
    "masked fill of the sum": lambda b, c: (c.stream + b.out(c.mixed)).masked_fill(FIRST, 0.5),
    "scatter_add": lambda b, c: c.stream.scatter_add(1, ORDER[None, :, None].expand_as(c.stream), b.out(c.mixed)),
    "channels side by side": lambda b, c: c.stream + torch.cat([b.out(c.mixed), c.normed], -1).sum(-1, keepdim=True),
    "one for all tokens": lambda b, c: c.stream + b.out(c.mixed).mean(1, keepdim=True),
    "lerp": lambda b, c: torch.lerp(c.stream, b.out(c.mixed), 0.4),
    "stack and sum": lambda b, c: torch.stack([c.stream, b.out(c.mixed)]).sum(0),
    "stack and mean": lambda b, c: torch.stack([b.out(c.mixed), c.normed, c.stream], dim=2).mean(dim=2),
}
WAYS |= {name: Way(add, linear_part(add)) for name, add in _LINEAR.items()}

#: Ways of which it cannot be said what each part adds, and a word of the sentence that says why.
UNKNOWN: dict[str, tuple[Add, str]] = {
    "tanh": (lambda b, c: c.stream + torch.tanh(b.out(c.mixed)), "tanh"),
    "LayerNorm": (lambda b, c: c.stream + b.layer_norm(b.out(c.mixed)), "layer_norm"),
    "LayerNorm before the projection": (
        lambda b, c: c.stream + b.out(functional.layer_norm(c.mixed, c.mixed.shape[-1:])),
        "layer_norm",
    ),
    "LayerNorm of a value residual": (
        lambda b, c: c.stream + b.out(functional.layer_norm(c.older + c.mixed, c.mixed.shape[-1:])),
        "of a sum with",
    ),
    "gate of a sum": (
        lambda b, c: c.stream + chunk(b, c, 2) * (b.out(c.mixed) + b.mlp(c.normed)),
        "adds a multiple of a sum with",
    ),
    "gate of a sum with an older branch": (
        lambda b, c: c.stream + chunk(b, c, 2) * (c.branch + b.out(c.mixed)),
        "adds a multiple of a sum with",
    ),
    "clamped": (lambda b, c: c.stream + b.out(c.mixed).clamp(-0.1, 0.1), "clamp"),
    "where it is positive": (lambda b, c: (lambda u: c.stream + torch.where(u > 0, u, 0 * u))(b.out(c.mixed)), ""),
    "lerp by a gate of it": (lambda b, c: (lambda u: torch.lerp(c.stream, u, u.sigmoid()))(b.out(c.mixed)), ""),
    "stack weighted by itself": (
        lambda b, c: (lambda both: (both * both.mean(-1, keepdim=True).softmax(0)).sum(0))(
            torch.stack([c.stream, b.out(c.mixed)])
        ),
        "",
    ),
    "stack and largest": (lambda b, c: torch.stack([c.stream, b.out(c.mixed)]).amax(0), ""),
    "projected inside of vmap": (lambda b, c: c.stream + torch.vmap(b.out)(c.mixed), "added to no tensor"),
    "squared": (lambda b, c: c.stream + b.out(c.mixed) ** 2, "pow"),
    "no residual stream": (lambda b, c: b.out(c.mixed), "gelu"),
    "gate of itself": (lambda b, c: c.stream + (lambda u: u * torch.sigmoid(u))(b.out(c.mixed)), "sigmoid"),
    "feed-forward of the output": (
        lambda b, c: c.stream + (b.out(c.mixed) + b.mlp(c.normed + b.beside(c.mixed))),
        "gelu",
    ),
    "projected twice": (lambda b, c: c.stream + (b.out(c.mixed) + b.out(c.mixed.square())), "square"),
    "another way in place of some numbers": (added_to_some_numbers, "writes over a part"),
    "feed-forward of what was added": (
        lambda b, c: (lambda update: c.stream + update + b.mlp(update))(b.out(c.mixed)),
        "gelu",
    ),
    "some queries after others": (added_to_some_queries_and_to_others, "setitem"),
    "multiple of the stream without a projection": (
        lambda b, c: 0.8 * (c.stream + c.mixed[..., :WIDTH]) + 0.2 * c.normed,
        "adds a multiple of a sum with",
    ),
    "another way behind the feed-forward": (added_behind_the_feed_forward, "adds something else"),
}


def joined(block: Block, call: Call) -> tuple[Tensor, Tensor, Tensor]:
    """The stream, the projected output, and a sum of layers of both: what a gate is computed of."""
    update = block.out(call.mixed)
    return call.stream, update, block.second(update) + block.second(call.stream)


def gated(function: Callable[[Tensor, Tensor, Tensor], Tensor]) -> tuple[Add, str]:
    return lambda b, c: function(*joined(b, c)), ""


#: Gates that are computed of the output, by a sum that is not the stream.
GATES = {
    "highway": gated(lambda x, y, s: (1 - s.sigmoid()) * x + s.sigmoid() * y),
    "highway, normed": gated(lambda x, y, s: functional.layer_norm((1 - s.sigmoid()) * x + s.sigmoid() * y, (WIDTH,))),
    "gated recurrent": gated(lambda x, y, s: (1 - s.sigmoid()) * x + s.sigmoid() * y.tanh()),
    "norm in the gate": gated(
        lambda x, y, s: (lambda z: (1 - z) * x + z * y)(functional.layer_norm(s, (WIDTH,)).sigmoid())
    ),
    "attention on attention": gated(lambda x, y, s: x + s * (y.roll(1, -1) - x.roll(1, -1)).sigmoid()),
    "gated linear unit": gated(lambda x, y, s: x + functional.glu(torch.cat([s, y - x], dim=-1))),
    "gated sum": gated(lambda x, y, s: (x + y) * s.sigmoid()),
    "sum beside": gated(lambda x, y, s: x + y + s.tanh()),
    "normed beside": gated(lambda x, y, s: functional.layer_norm(s, (WIDTH,)) + y.tanh()),
    "modulated": gated(lambda x, y, s: x * (1 + s.tanh()) + (y - x.roll(1, -1))),
    "before the projection": (
        lambda b, c: c.stream + c.mixed[..., :WIDTH] * (c.mixed[..., :WIDTH] + c.normed).sigmoid(),
        "",
    ),
    "one gate for all channels": (
        lambda b, c: (lambda u: c.stream + u * u.mean(-1, keepdim=True).sigmoid())(b.out(c.mixed)),
        "sigmoid",
    ),
    "feed-forward without a stream": (lambda b, c: b.mlp(c.stream + b.out(c.mixed)), ""),
}
UNKNOWN |= GATES
