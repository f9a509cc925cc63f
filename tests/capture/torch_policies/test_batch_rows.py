"""Rows of a batch are those of its environments, or they are refused: heads can be folded outside of the batch."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
import torch
from torch import nn

import vla_attention as va
from tests.capture.torch_policies.test_odd_policies import ACTIONS, HEADS, PREFIX, WIDTH, OddPolicy, layout, logits
from vla_attention.capture.torch_policies.own_setting import BatchRowsMixed
from vla_attention.capture.torch_policies.record import record
from vla_attention.capture.torch_policies.session import ContributionsUnknown
from vla_attention.schemas.errors import Note
from vla_attention.schemas.stores.reader import open_store


def by_einsum(q, k, v):
    return torch.einsum("fqk,fkd->fqd", torch.softmax(torch.einsum("fqd,fkd->fqk", q, k) / q.shape[-1] ** 0.5, -1), v)


def by_baddbmm(q, k, v):
    zeros = torch.zeros(len(q), q.shape[1], k.shape[1])
    return torch.softmax(torch.baddbmm(zeros, q, k.transpose(1, 2), alpha=q.shape[-1] ** -0.5), -1) @ v


#: The attention of (batch and head, query, dim).
FOLDED = {
    "by hand": lambda q, k, v: torch.bmm(torch.softmax(logits(q, k), dim=-1), v),
    "baddbmm": by_baddbmm,
    "einsum": by_einsum,
    "sdpa": nn.functional.scaled_dot_product_attention,
}


class Core(nn.Module):
    """Attention of (batch, head, query, dim) that folds two axes into one, heads outside or not."""

    def __init__(self, multiply, outside):
        super().__init__()
        self.multiply, self.outside, self.num_heads = multiply, outside, HEADS

    def forward(self, *parts):
        if self.outside:
            mixed = self.multiply(*(tensor.transpose(0, 1).flatten(0, 1) for tensor in parts))
            return mixed.unflatten(0, (HEADS, -1)).transpose(0, 1)
        return self.multiply(*(tensor.flatten(0, 1) for tensor in parts)).unflatten(0, (-1, HEADS))


def folded_policy(outside, multiply):
    core = Core(multiply, outside)
    return OddPolicy(lambda block, *parts: core.forward(*parts))


def recorded(path, policy, batch=2, **settings):
    """Record one call of a batch; how far the rows are from those by hand."""
    settings = {"bits": 23, "queries": "all", "durable": False, "layout": layout()} | settings
    facts = [{"task_id": 0, "episode_index": row, "instruction": ""} for row in range(batch)]
    with record(path, policy, **settings) as run, run.episodes(facts) as episodes, episodes.replan(env_step=0):
        actions = policy.act(batch)
    rows = np.stack([episode.read("joint/rows")[0, :, 0] for episode in open_store(path).episodes], axis=1)
    expected = torch.stack([block.kept for block in policy.blocks]).softmax(-1).numpy()
    return float(np.abs(rows - expected).max()), actions


@pytest.mark.parametrize("batch", [2, 3, 5])  # as many rows as heads, as tokens, and neither
@pytest.mark.parametrize("contributions", [True, False])
@pytest.mark.parametrize("multiply", FOLDED.values(), ids=FOLDED)
def test_heads_outside_of_the_batch_are_refused_and_inside_they_are_right(tmp_path, multiply, batch, contributions):
    with pytest.raises(BatchRowsMixed):
        recorded(tmp_path / "a.zarr", folded_policy(True, multiply), batch, contributions=contributions)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        off, actions = recorded(tmp_path / "b.zarr", folded_policy(False, multiply), batch, contributions=contributions)
    assert off < 2e-6
    assert torch.equal(actions, folded_policy(False, multiply).act(batch))


class TokensFirst(nn.Module):
    """Attention of (token, batch, width)."""

    def __init__(self, outside):
        super().__init__()
        self.outside, self.num_heads, self.qkv = outside, HEADS, nn.Linear(WIDTH, 3 * WIDTH)

    def forward(self, tokens, prefix):
        given = torch.cat([prefix, tokens])
        q, k, v = (part.unflatten(-1, (HEADS, -1)) for part in self.qkv(given).chunk(3, dim=-1))
        q = q[len(prefix) :]
        self.kept = torch.einsum("qbhd,kbhd->bhqk", q, k).detach() / q.shape[-1] ** 0.5
        order = (2, 1, 0, 3) if self.outside else (1, 2, 0, 3)
        mixed = FOLDED["sdpa"](*(part.permute(order).flatten(0, 1) for part in (q, k, v)))
        mixed = mixed.unflatten(0, (HEADS, -1)).transpose(0, 1) if self.outside else mixed.unflatten(0, (-1, HEADS))
        return tokens + mixed.permute(2, 0, 1, 3).flatten(2)


class TokensFirstPolicy(OddPolicy):
    def __init__(self, outside):
        super().__init__(None)
        self.blocks = nn.ModuleList(TokensFirst(outside) for _ in self.blocks)

    @torch.no_grad()
    def act(self, batch=1):
        numbers = torch.Generator().manual_seed(1)
        prefix, tokens = (torch.randn(count, batch, WIDTH, generator=numbers) for count in (PREFIX, ACTIONS))
        for block in self.blocks:
            tokens = block(tokens, prefix)
        return tokens.transpose(0, 1)


class Masked(nn.Module):
    """Attention of (batch, token, width) with a mask as a number for each logit, and positions (token, width)."""

    def __init__(self):
        super().__init__()
        self.num_heads, self.qkv = HEADS, nn.Linear(WIDTH, 3 * WIDTH)

    def forward(self, tokens, prefix, mask, positions):
        given = torch.cat([prefix, tokens + positions], dim=1)
        q, k, v = (part.unflatten(-1, (HEADS, -1)).transpose(1, 2) for part in self.qkv(given).chunk(3, dim=-1))
        q = q[:, :, -tokens.shape[1] :]
        self.kept = (q @ k.mT).detach() / q.shape[-1] ** 0.5 + mask[:, None]
        mixed = nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=mask[:, None])
        return tokens + mixed.transpose(1, 2).flatten(2)


@pytest.mark.parametrize("hidden", [-torch.inf, torch.finfo(torch.float32).min, -1e4])
@pytest.mark.parametrize("batch", [2, ACTIONS])
def test_masks_and_positions_are_no_rows(tmp_path, hidden, batch):
    class MaskedPolicy(OddPolicy):
        @torch.no_grad()
        def act(self, batch=1):
            counts = (PREFIX, ACTIONS)
            prefix, tokens = (torch.linspace(0, 9, batch * n * WIDTH).sin().view(batch, n, -1) for n in counts)
            mask = torch.zeros(batch, ACTIONS, PREFIX + ACTIONS)
            mask[:, :, 4] = hidden
            for block in self.blocks:
                tokens = block(tokens, prefix, mask, torch.ones(ACTIONS, WIDTH))
            return tokens

    policy = MaskedPolicy(None)
    policy.blocks = nn.ModuleList(Masked() for _ in policy.blocks)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert recorded(tmp_path / "a.zarr", policy, batch)[0] < 2e-6


@pytest.mark.parametrize("batch", [2, ACTIONS, PREFIX])
def test_tokens_before_the_batch_as_many_as_rows_or_not(tmp_path, batch):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert recorded(tmp_path / "a.zarr", TokensFirstPolicy(False), batch)[0] < 2e-6
    with pytest.raises(BatchRowsMixed):
        recorded(tmp_path / "b.zarr", TokensFirstPolicy(True), batch)


def test_where_nothing_tells_a_note_says_that_rows_may_be_mixed(tmp_path):
    policy = folded_policy(False, FOLDED["sdpa"])
    for block in policy.blocks:
        block.out.register_forward_hook(lambda module, given, result: torch.tanh(result))
    with pytest.warns(Note, match="batch of 2"):
        recorded(tmp_path / "a.zarr", policy, contributions=False)
    with pytest.raises(ContributionsUnknown, match=r"tanh .*batch of 2"):
        recorded(tmp_path / "b.zarr", policy)


@pytest.mark.parametrize("outside", [True, False])
def test_a_repeatable_call_with_a_batch_tells_where_the_heads_are(tmp_path, outside):
    policy = folded_policy(outside, FOLDED["by hand"])
    if outside:
        with pytest.raises(BatchRowsMixed, match=r"batch of 2 .* row 0 .* 0\.\d+ "):
            record(tmp_path / "b.zarr", policy, layout=layout(), own_setting=lambda: policy.act(2))
    else:
        run = record(tmp_path / "b.zarr", policy, layout=layout(), own_setting=lambda: policy.act(2))
        assert run.attributes.provenance["rows of the batch of own setting"] == "apart (2 rows)"


def test_inspect_leaves_out_a_tower_that_is_called_once_for_each_picture():
    policy = folded_policy(True, FOLDED["sdpa"])
    policy.tower = nn.MultiheadAttention(8, 2, batch_first=True)
    tokens, prefix = (torch.randn(3, count, 8, generator=torch.Generator().manual_seed(count)) for count in (3, 6))

    def act(rows):
        with torch.no_grad():
            for picture in prefix[:rows]:
                policy.tower(picture[None], picture[None], picture[None])
            hidden = tokens[:rows]
            for block in policy.blocks:
                hidden = block(hidden, prefix[:rows])

    table = str(va.inspect(policy, lambda: act(3), first_row=lambda: act(1)))
    assert "tower" in table
    assert re.search(r"refuses blocks\.\{0,1\}, 3 x 9: ", table)


@pytest.mark.parametrize("outside", [True, False])
def test_inspect_holds_the_first_row_against_a_call_of_one_row(outside):
    policy = folded_policy(outside, FOLDED["sdpa"])
    # The first row of two is the only row of one: both are drawn from the same numbers.
    inputs = [torch.randn(2, count, 8, generator=torch.Generator().manual_seed(count)) for count in (3, 6)]

    def act(rows):
        tokens, prefix = (tensor[:rows] for tensor in inputs)
        with torch.no_grad():
            for block in policy.blocks:
                tokens = block(tokens, prefix)

    table = va.inspect(policy, lambda: act(2), first_row=lambda: act(1))
    reason = r"blocks\.\{0,1\}, 3 x 9: .* 0\.\d+ "
    assert (re.search(f"refuses {reason}", str(table)) is not None) == outside
    assert ("refused" in str(table)) == outside
