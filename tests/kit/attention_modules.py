"""Small random modules that compute attention in every way that policies do, and what their rows are by other means."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from vla_attention.capture.torch_policies.attention_calls import AttentionCall, CallShape, Watcher
from vla_attention.capture.torch_policies.policy_modules import find_policy
from vla_attention.capture.torch_policies.watch import watch_attention


@dataclass
class Seen(Watcher):
    """A watcher that takes everything of every call, and changes calls with `changes`; None changes nothing."""

    changes: Callable[[CallShape], Tensor | None] | None = lambda shape: None
    asked: list[CallShape] = field(default_factory=list)
    shapes: list[CallShape] = field(default_factory=list)
    rows: list[Tensor] = field(default_factory=list)
    allowed: list[Tensor] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    calls: list[AttentionCall] = field(default_factory=list)

    def change(self, shape: CallShape) -> Tensor | None:
        assert self.changes is not None
        self.asked.append(shape)
        return self.changes(shape)

    def saw(self, call: AttentionCall) -> None:
        rows = call.rows()
        self.shapes.append(call.shape)
        self.rows.append(rows)
        self.allowed.append(call.allowed())
        self.errors.append(call.product_error(rows))
        self.calls.append(call)


def first_and_narrow(policy: object, call: Callable[[], Tensor]) -> list[tuple[Seen, Tensor]]:
    """Watch a call four times; returns the first, which is watched throughout, and the last, which is not."""
    found, made = find_policy(policy), []
    for _ in range(4):
        seen = Seen(changes=None)
        with watch_attention(found, seen):
            made.append((seen, call()))
    assert [seen.whole for seen, _ in made] == [True, True, True, False]
    return [made[0], made[-1]]


class Attention(nn.Module):
    """One attention block: projections, `attend`, output projection; hidden states (batch, position, width)."""

    def __init__(self, attend: Callable[..., Tensor], heads: int = 4, kv_heads: int = 4, dim: int = 8) -> None:
        super().__init__()
        self.attend, self.heads, self.kv_heads, self.dim = attend, heads, kv_heads, dim
        width = heads * dim
        self.q_proj, self.o_proj = nn.Linear(width, width), nn.Linear(width, width)
        self.k_proj, self.v_proj = nn.Linear(width, kv_heads * dim), nn.Linear(width, kv_heads * dim)

    def forward(self, hidden: Tensor, memory: Tensor, mask: Tensor | None = None) -> Tensor:
        def heads(tensor: Tensor, count: int) -> Tensor:
            return tensor.view(*tensor.shape[:2], count, self.dim).transpose(1, 2)

        query = heads(self.q_proj(hidden), self.heads)
        key, value = heads(self.k_proj(memory), self.kv_heads), heads(self.v_proj(memory), self.kv_heads)
        mixed = self.attend(query, key, value, mask)
        return self.o_proj(mixed.transpose(1, 2).flatten(2))


class Policy(nn.Module):
    """`layers` blocks one after the other, with a residual stream."""

    def __init__(self, attend: Callable[..., Tensor], layers: int = 2, **sizes: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Attention(attend, **sizes) for _ in range(layers))
        self.head = nn.Linear(self.layers[0].o_proj.out_features, 3)

    def forward(self, hidden: Tensor, memory: Tensor, mask: Tensor | None = None) -> Tensor:
        for layer in self.layers:
            hidden = hidden + layer(hidden, memory, mask)
        return self.head(hidden)


def reference_rows(query: Tensor, key: Tensor, logit_mask: Tensor | None, scale: float | None = None) -> Tensor:
    """Rows (batch, head, query, key) in float64, head by head; a query that sees no key gets zeros."""
    batch, heads, queries, dim = query.shape
    rows = torch.zeros((batch, heads, queries, key.shape[2]), dtype=torch.float64)
    for b in range(batch):
        for h in range(heads):
            keys = key[b, h // (heads // key.shape[1])].double()
            logits = query[b, h].double() @ keys.T * (dim**-0.5 if scale is None else scale)
            if logit_mask is not None:
                logits = logits + logit_mask.double().expand(batch, heads, *logits.shape)[b, h]
            rows[b, h] = torch.nan_to_num(torch.softmax(logits, dim=-1))
    return rows
