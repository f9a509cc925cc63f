"""The table of attention calls."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.nn.functional import scaled_dot_product_attention as sdpa

import vla_attention as va
from tests.kit.attention_modules import Policy
from vla_attention.capture.torch_policies.inspect_calls import NoAttention


class Decoder(nn.Module):
    """A picture encoder by hand, and a decoder that writes token after token."""

    def __init__(self) -> None:
        super().__init__()
        self.vision = Policy(lambda q, k, v, mask: (q @ k.mT).softmax(-1) @ v, layers=3)
        self.text = Policy(lambda q, k, v, mask: sdpa(q, k, v, enable_gqa=True), layers=12, kv_heads=2)

    def act(self, pixels):
        self.vision(pixels, pixels)
        for written in range(5):
            self.text(pixels[:, :1], pixels[:, : 4 + written])


def test_the_table():
    torch.manual_seed(0)
    policy, pixels = Decoder().eval(), torch.randn(2, 9, 32)
    table = va.inspect(policy, lambda: policy.act(pixels))
    assert len(table.calls) == 3 + 5 * 12 == len(table.errors)
    first, second = table.rows
    assert (first.pattern, first.keys, first.times) == ("vision.layers.{0..2}", (9, 9), (1, 1))
    assert (second.pattern, second.keys, second.times) == ("text.layers.{0..11}", (4, 8), (5, 5))
    assert (first.shape.kind, first.shape.queries, first.shape.heads) == ("softmax", 9, 4)
    one = second.shape
    assert (one.kind, one.queries, one.heads, one.kv_heads, one.batch) == ("sdpa", 1, 4, 2, 2)
    assert max(table.errors) < 3e-6


def test_a_policy_without_attention():
    policy = nn.Sequential(nn.Linear(3, 3), nn.ReLU())
    with pytest.raises(NoAttention, match="Sequential"):
        va.inspect(policy, lambda: policy(torch.randn(2, 3)))


class Recurrent(nn.Module):
    """Linear attention in place of a block's own."""

    def __init__(self, *sizes: int) -> None:
        super().__init__()
        self.mix = nn.Linear(32, 32)

    def forward(self, hidden, memory, mask=None):
        return self.mix(hidden.exp() @ (memory.exp().mT @ memory))


def test_repeated_blocks_that_make_no_call_are_named():
    policy = Policy(lambda q, k, v, mask: sdpa(q, k, v), layers=5).eval()
    for number in (1, 2):
        policy.layers[number] = Recurrent()
    policy.spare = nn.ModuleList(nn.Linear(32, 32) for _ in range(3))
    table = va.inspect(policy, lambda: policy(torch.randn(1, 5, 32), torch.randn(1, 7, 32)))
    assert table.silent == ("layers.1", "layers.2")
    whole = Decoder().eval()
    assert not va.inspect(whole, lambda: whole.act(torch.randn(2, 9, 32))).silent
