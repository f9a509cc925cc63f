"""The difference of a call in the user's own setting and as it is recorded."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from torch import nn

import vla_attention as va
from tests.capture.torch_policies.test_odd_policies import HEADS, OddPolicy, layout, logits
from tests.kit.small_torch_policy import SmallPolicy, given
from vla_attention.capture.torch_policies.own_setting import BatchRowsMixed, difference_to_own_setting
from vla_attention.capture.torch_policies.record import record
from vla_attention.schemas.stores.reader import open_store


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


FACTS = [{"task_id": 0, "episode_index": row, "instruction": ""} for row in range(2)]
FOLDED = {
    "outside, by hand": (True, lambda q, k, v: torch.bmm(torch.softmax(logits(q, k), dim=-1), v)),
    "inside, sdpa": (False, nn.functional.scaled_dot_product_attention),
}


def folded_policy(outside, multiply):
    def attend(block, q, k, v):
        if outside:
            mixed = multiply(*(tensor.transpose(0, 1).flatten(0, 1) for tensor in (q, k, v)))
            return mixed.unflatten(0, (HEADS, -1)).transpose(0, 1)
        return multiply(*(tensor.flatten(0, 1) for tensor in (q, k, v))).unflatten(0, (-1, HEADS))

    return OddPolicy(attend)


def record_both(path, policy, **settings):
    settings = {"bits": 23, "queries": "all", "durable": False, "layout": layout()} | settings
    with (
        record(path, policy, **settings) as run,
        run.episodes(FACTS) as episodes,
        episodes.replan(env_step=0),
    ):
        policy.act(2)
    store = open_store(path)
    rows = np.stack([episode.read("joint/rows")[0, :, 0] for episode in store.episodes], axis=1)
    expected = torch.stack([block.kept for block in policy.blocks]).softmax(-1).numpy()
    return store, float(np.abs(rows - expected).max())


@pytest.mark.parametrize(("outside", "multiply"), FOLDED.values(), ids=FOLDED)
def test_a_repeatable_call_with_a_batch_tells_where_the_heads_are(tmp_path, outside, multiply):
    policy = folded_policy(outside, multiply)
    if outside:
        # Without a call that can be repeated nothing tells, and the guide warns.
        assert record_both(tmp_path / "a.zarr", policy)[1] > 0.1
        sentence = r"rows of a batch of 2 are not apart: .* row 0 changed the actions of other rows by 0\.\d+ .*one env"
        with pytest.raises(BatchRowsMixed, match=sentence):
            record_both(tmp_path / "b.zarr", policy, own_setting=lambda: policy.act(2))
        assert not (tmp_path / "b.zarr").exists()
        return
    store, off = record_both(tmp_path / "a.zarr", policy, own_setting=lambda: policy.act(2))
    assert off < 2e-6
    assert store.attributes.provenance["rows of the batch of own setting"] == "apart (2 rows)"


@pytest.mark.parametrize(("outside", "multiply"), FOLDED.values(), ids=FOLDED)
def test_inspect_holds_the_first_row_against_a_call_of_one_row(outside, multiply):
    policy = folded_policy(outside, multiply)
    # The first row of two is the only row of one: both are drawn from the same numbers.
    inputs = [torch.randn(2, count, 8, generator=torch.Generator().manual_seed(count)) for count in (3, 6)]

    def act(rows):
        tokens, prefix = (tensor[:rows] for tensor in inputs)
        with torch.no_grad():
            for block in policy.blocks:
                tokens = block(tokens, prefix)

    table = va.inspect(policy, lambda: act(2), first_row=lambda: act(1))
    reason = r"blocks\.\{0,1\}, 3 x 9: the first row of its batch differs by 0\.\d+ .* heads are folded outside"
    assert (re.search(f"Recording refuses {reason}", str(table)) is not None) == outside
    assert ("refused" in str(table)) == outside
