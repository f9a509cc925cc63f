"""The difference of a call in the user's own setting and as it is recorded."""

from __future__ import annotations

import torch
from torch import nn

from tests.kit.small_torch_policy import SmallPolicy, given, small_layout
from vla_attention.capture.torch_policies.own_setting import facts_of_own_setting


def test_a_plain_policy_gives_the_same_bits_and_random_numbers_go_on():
    policy = SmallPolicy()
    torch.manual_seed(3)
    before = torch.random.get_rng_state()
    found = facts_of_own_setting(
        policy, small_layout(), lambda: policy.act(**{**given(), "noise": torch.randn(1, 3, 2)})
    )
    assert list(found.values()) == ["none (bit-equal)", "one"]
    assert torch.equal(torch.random.get_rng_state(), before)


def test_the_fast_path_differs_and_that_is_measured():
    torch.manual_seed(0)
    layer = nn.TransformerEncoderLayer(16, 2, 32, batch_first=True).eval()
    policy = nn.TransformerEncoder(layer, 2).eval()
    tokens = torch.randn(1, 7, 16)

    def call():
        with torch.no_grad():
            # A difference that only the fast path's switch makes.
            return {"actions": policy(tokens) + (1e-3 if torch.backends.mha.get_fastpath_enabled() else 0)}

    found = facts_of_own_setting(policy, small_layout(), call)
    assert "0.001" in found["difference to own setting"]
    assert torch.backends.mha.get_fastpath_enabled()
