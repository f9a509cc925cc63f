"""The difference of a call in the user's own setting and as it is recorded."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from tests.kit.small_torch_policy import SmallPolicy, given
from vla_attention.capture.torch_policies.own_setting import difference_to_own_setting


def test_a_plain_policy_gives_the_same_bits_and_random_numbers_go_on():
    policy = SmallPolicy()
    torch.manual_seed(3)
    before = torch.random.get_rng_state()
    found = difference_to_own_setting(policy, lambda: policy.act(**{**given(), "noise": torch.randn(1, 3, 2)}))
    assert str(found) == "none (bit-equal)"
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

    found = difference_to_own_setting(policy, call)
    assert found.largest_difference == pytest.approx(1e-3, rel=0.01)
    assert "at most 0.001, where the largest number is" in str(found)
    assert torch.backends.mha.get_fastpath_enabled()
