"""Calls by hand: softmax and product in every spelling, against a loop in float64."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional

from tests.kit.attention_modules import Policy, Seen, first_and_narrow, reference_rows
from tests.kit.examples import examples
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused
from vla_attention.capture.torch_policies.watch import watch_attention


def logits_of(query, key, mask):
    key = key.repeat_interleave(query.shape[1] // key.shape[1], 1)
    logits = query @ key.transpose(-1, -2) / math.sqrt(query.shape[-1])
    return logits if mask is None else logits + mask.to(logits.dtype)


def repeated(value, query):
    return value.repeat_interleave(query.shape[1] // value.shape[1], 1)


def plain(query, key, value, mask):
    return torch.softmax(logits_of(query, key, mask), dim=-1) @ repeated(value, query)


def method_and_matmul(query, key, value, mask):
    return torch.matmul(logits_of(query, key, mask).softmax(dim=3), repeated(value, query))


def llama(query, key, value, mask):
    rows = functional.softmax(logits_of(query, key, mask), dim=-1, dtype=torch.float32).to(query.dtype)
    return torch.matmul(functional.dropout(rows, p=0.1, training=False), repeated(value, query)).contiguous()


def smolvla(query, key, value, mask):
    logits = logits_of(query.float(), key.float(), mask)
    rows = functional.softmax(logits, dim=-1).to(dtype=value.dtype)
    return torch.matmul(rows, repeated(value, query).permute(0, 2, 1, 3).transpose(1, 2))


def bmm(query, key, value, mask):
    logits, value = logits_of(query, key, mask).flatten(0, 1), repeated(value, query).flatten(0, 1)
    return torch.bmm(functional.softmax(logits, dim=-1), value).view(query.shape)


def folded_afterwards(query, key, value, mask):
    rows = logits_of(query, key, mask).softmax(-1)
    folded = rows.reshape(-1, *rows.shape[2:])
    return torch.bmm(folded, repeated(value, query).reshape(-1, *value.shape[2:])).view(query.shape)


def einsum(query, key, value, mask):
    rows = logits_of(query, key, mask).softmax(-1)
    return torch.einsum("bhqk,bhkd->bqhd", rows, repeated(value, query)).transpose(1, 2)


def einsum_dots(query, key, value, mask):
    return torch.einsum("...qk, ...kd -> ...qd", logits_of(query, key, mask).softmax(-1), repeated(value, query))


def einsum_implicit(query, key, value, mask):
    return torch.einsum("...qk,...kz", logits_of(query, key, mask).softmax(-1), repeated(value, query))


def grouped(query, key, value, mask):
    """(batch, kv_head, group, query, key), as in code that comes from JAX."""
    batch, _, queries, _ = query.shape
    logits = logits_of(query, key, mask).view(batch, key.shape[1], -1, queries, key.shape[2])
    return torch.einsum("BKGTS,BSKH->BKGTH", logits.softmax(-1), value.transpose(1, 2)).reshape(query.shape)


def grouped_folded(query, key, value, mask):
    """The heads of a group as further queries of their value head."""
    rows = torch.softmax(logits_of(query, key, mask), -1)
    batch, _, _, keys = rows.shape
    return torch.matmul(rows.view(batch, key.shape[1], -1, keys), value).view(query.shape)


def transposed(query, key, value, mask):
    rows = nn.Softmax(dim=-1)(logits_of(query, key, mask))
    return torch.matmul(repeated(value, query).transpose(-1, -2), rows.mT).transpose(2, 3)


def queries_before_heads(query, key, value, mask):
    """Logits (batch, query, head, key)."""
    rows = logits_of(query, key, mask).transpose(1, 2).softmax(-1)
    return torch.einsum("bqhk,bhkd->bhqd", rows, repeated(value, query))


def masked_afterwards(query, key, value, mask):
    rows = logits_of(query, key, mask).softmax(-1)
    return torch.nan_to_num(rows) @ repeated(value, query)


def altered_in_place(query, key, value, mask):
    """Renormalised in place: what was multiplied is what counts."""
    rows = logits_of(query, key, mask).softmax(-1)
    rows *= 3.0
    rows.div_(rows.sum(-1, keepdim=True))
    return rows @ repeated(value, query)


def in_place(query, key, value, mask):
    logits = logits_of(query, key, mask)
    torch.softmax(logits, -1, out=logits)
    return logits @ repeated(value, query)


SPELLINGS = [
    plain, method_and_matmul, llama, smolvla, bmm, folded_afterwards, einsum, einsum_dots, einsum_implicit, grouped,
    grouped_folded, transposed, queries_before_heads, masked_afterwards,
    altered_in_place, in_place,
]  # fmt: skip


@pytest.mark.parametrize("attend", SPELLINGS, ids=lambda function: function.__name__)
@given(data=st.data())
@settings(max_examples=examples(10))
def test_rows_and_results(attend, data):
    queries, keys = data.draw(st.integers(1, 5)), data.draw(st.integers(1, 7))
    batch, kv_heads, group = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 3)), data.draw(st.integers(1, 3))
    dtype = data.draw(st.sampled_from([torch.float32, torch.bfloat16]))
    torch.manual_seed(data.draw(st.integers(0, 999)))
    heads, taken = kv_heads * group, []

    def spied(query, key, value, mask):
        taken.append((query.detach(), key.detach()))
        return attend(query, key, value, mask)

    policy = Policy(spied, heads=heads, kv_heads=kv_heads).to(dtype).eval().requires_grad_(False)
    hidden, memory = (torch.randn(batch, n, policy.head.in_features, dtype=dtype) for n in (queries, keys))
    keep = torch.rand(batch, 1, queries, keys) < 0.7
    keep[..., 0] = True
    low = data.draw(st.sampled_from([float("-inf"), -1e9, torch.finfo(dtype).min]))
    mask = torch.zeros(keep.shape, dtype=torch.float32).masked_fill(~keep, low)
    expected = policy(hidden, memory, mask)
    for seen, result in first_and_narrow(policy, lambda: policy(hidden, memory, mask)):
        assert torch.equal(result, expected)
        assert [shape.module for shape in seen.shapes] == ["layers.0", "layers.1"]
        assert max(seen.errors) < (5e-6 if dtype is torch.float32 else 2e-2)
        for (query, key), rows, allowed, shape in zip(taken[-2:], seen.rows, seen.allowed, seen.shapes, strict=True):
            assert (shape.kind, shape.batch, shape.heads) == ("softmax", batch, heads)
            assert (shape.queries, shape.keys) == (queries, keys)
            assert rows.shape == (batch, heads, queries, keys)
            assert rows.dtype is torch.float32
            wide = dtype is torch.float32
            torch.testing.assert_close(
                rows.double(), reference_rows(query, key, mask), rtol=1e-4 if wide else 0.1, atol=2e-6 if wide else 2e-2
            )
            if wide or attend not in (masked_afterwards, altered_in_place, in_place):
                torch.testing.assert_close(rows.sum(-1), torch.ones(rows.shape[:-1]), rtol=0, atol=2e-6)
            assert torch.equal(allowed, keep.expand(allowed.shape))
            assert (rows[~keep.expand(rows.shape)] == 0).all()


def test_values_are_shared_where_they_are():
    torch.manual_seed(0)
    for attend, kv_heads in ((grouped, 2), (grouped_folded, 2), (plain, 4)):
        seen, policy = Seen(), Policy(attend, heads=4, kv_heads=2).eval()
        with watch_attention(policy, seen):
            policy(torch.randn(2, 5, 32), torch.randn(2, 7, 32))
        assert [shape.kv_heads for shape in seen.shapes] == [kv_heads] * 2
        assert seen.calls[0].value.shape == (2, kv_heads, 7, 8)
        assert seen.calls[0].output.shape == (2, 4, 5, 8)


@pytest.mark.parametrize("attend", [plain, grouped, transposed])
def test_a_change_takes_keys_away(attend):
    torch.manual_seed(1)
    policy = Policy(attend, heads=4, kv_heads=2).eval().requires_grad_(False)
    hidden, memory = torch.randn(2, 5, 32), torch.randn(2, 7, 32)
    knocked = torch.zeros(4, 1, 7)
    knocked[1, :, 3] = float("-inf")
    first, second = Seen(), Seen(changes=lambda shape: knocked if shape.module == "layers.1" else None)
    for seen in (first, second):
        with watch_attention(policy, seen):
            policy(hidden, memory)
    left = first.rows[1].clone()
    left[:, 1, :, 3] = 0
    torch.testing.assert_close(second.rows[1], left / left.sum(-1, keepdim=True), rtol=1e-5, atol=1e-6)
    assert max(second.errors) < 5e-6
    assert torch.equal(first.allowed[1], second.allowed[1])


@pytest.mark.parametrize("attend", SPELLINGS, ids=lambda function: function.__name__)
@given(data=st.data())
@settings(max_examples=examples(8))
def test_a_change_hits_its_cells_or_is_refused(attend, data):
    """Whatever the order of the axes: cut cells are 0, the others the unchanged softmax without them."""
    batch, heads, queries = data.draw(st.tuples(st.integers(1, 2), st.sampled_from([2, 4]), st.sampled_from([2, 3, 4])))
    torch.manual_seed(data.draw(st.integers(0, 999)))
    sizes = data.draw(st.sampled_from([(heads, queries, 6), (heads, 1, 6), (1, queries, 6), (6,)]))
    change = torch.zeros(sizes).masked_fill(torch.rand(sizes) < 0.3, -math.inf)
    change[..., 0] = data.draw(st.sampled_from([0.0, math.log(0.3)]))
    policy = Policy(attend, heads=heads, kv_heads=heads // 2).eval().requires_grad_(False)
    hidden, memory = (torch.randn(batch, count, policy.head.in_features) for count in (queries, 6))
    plain_call, seen = Seen(), Seen(changes=lambda shape: change if shape.module == "layers.0" else None)
    with watch_attention(policy, plain_call):
        policy(hidden, memory)
    try:
        with watch_attention(policy, seen):
            policy(hidden, memory)
    except ChangeRefused:
        assert attend in (queries_before_heads, altered_in_place)
        return
    wanted = plain_call.rows[0] * change.exp()
    torch.testing.assert_close(seen.rows[0], wanted / wanted.sum(-1, keepdim=True), rtol=1e-4, atol=2e-6)


@pytest.mark.parametrize("attend", [plain, grouped, transposed, queries_before_heads])
@pytest.mark.parametrize("low", [-1e9, torch.finfo(torch.float32).min])
def test_a_mask_of_each_head_may_leave_a_query_nothing(attend, low):
    """What a query sees is told by its own highest logit: here another query has higher and far lower ones."""
    torch.manual_seed(2)
    policy = Policy(attend, heads=4, kv_heads=2).eval().requires_grad_(False)
    keep = torch.rand(2, 4, 5, 7) < 0.6
    keep[0, 1, 2] = keep[1, 3, 0] = False
    mask = torch.zeros(keep.shape).masked_fill(~keep, low)
    mask[:, :, 1], mask[:, :, 3] = mask[:, :, 1] - 3000, mask[:, :, 3] + 3000
    seen = Seen()
    with watch_attention(policy, seen):
        policy(torch.randn(2, 5, 32), torch.randn(2, 7, 32), mask)
    for rows, allowed in zip(seen.rows, seen.allowed, strict=True):
        assert torch.equal(allowed.expand(keep.shape), keep)
        some = keep.any(-1, keepdim=True)
        assert (rows[~keep & some] == 0).all()
        torch.testing.assert_close(rows.sum(-1), torch.ones(2, 4, 5), rtol=0, atol=2e-6)
    assert max(seen.errors) < 5e-6


def test_a_query_without_a_key_has_an_empty_row():
    torch.manual_seed(3)
    policy = Policy(masked_afterwards).eval().requires_grad_(False)
    keep = torch.ones(1, 1, 5, 7, dtype=torch.bool)
    keep[..., 2, :] = False
    seen = Seen()
    with watch_attention(policy, seen):
        policy(torch.randn(1, 5, 32), torch.randn(1, 7, 32), torch.zeros(keep.shape).masked_fill(~keep, -math.inf))
    for rows, allowed in zip(seen.rows, seen.allowed, strict=True):
        assert torch.equal(allowed.expand(1, 4, 5, 7), keep.expand(1, 4, 5, 7))
        torch.testing.assert_close(rows.sum(-1), keep.any(-1).expand(1, 4, 5).float(), rtol=0, atol=2e-6)


def test_probabilities_that_are_changed_before_the_product():
    """Rows are what is multiplied, whatever function changed it in place."""

    def attend(query, key, value, mask):
        rows = (query @ key.mT).softmax(-1)
        rows.pow_(2)
        return rows @ value

    torch.manual_seed(0)
    seen, policy = Seen(), Policy(attend).eval().requires_grad_(False)
    with watch_attention(policy, seen):
        policy(torch.randn(2, 5, 32), torch.randn(2, 7, 32))
    assert max(seen.errors) < 5e-6
    assert (seen.rows[0].sum(-1) < 1).all()


class NoAttention(nn.Module):
    """Softmaxes that meet no values, or values that are the same for every batch row and query."""

    def __init__(self) -> None:
        super().__init__()
        self.classes = nn.Parameter(torch.randn(6, 8))
        self.experts = nn.ModuleList(nn.Linear(8, 8) for _ in range(6))

    def forward(self, hidden):
        gate = torch.softmax(hidden @ self.classes.T, dim=-1)
        outputs = torch.stack([expert(hidden) for expert in self.experts], dim=2)
        mixture = torch.einsum("bte,bted->btd", gate, outputs) + (gate.unsqueeze(-1) * outputs).sum(2)
        expected = gate @ self.classes
        heads = torch.softmax(hidden.view(2, 5, 2, 4), dim=-1)
        return mixture + expected + heads.flatten(2), gate.argmax(-1), gate @ torch.arange(6.0)


def test_softmaxes_without_values_are_no_attention_calls():
    torch.manual_seed(0)
    seen, policy, hidden = Seen(), NoAttention().eval(), torch.randn(2, 5, 8)
    expected = policy(hidden)
    with watch_attention(policy, seen):
        result = policy(hidden)
    assert not seen.shapes
    assert all(torch.equal(a, b) for a, b in zip(result, expected, strict=True))
