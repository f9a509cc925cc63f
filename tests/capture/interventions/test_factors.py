"""The arithmetic of interventions on attention against a direct computation, one query at a time in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_attention.capture.interventions.factors import (
    QueryWithoutKeys,
    SiteEdit,
    SiteEditor,
    make_uniform,
)
from vla_attention.capture.recording.attention import MASKED_LOGIT, CallKeys, attend

KEYS, QUERIES, HEADS = 9, 5, 4


def inputs(seed: int = 0, dtype=torch.float32):
    """Query, key, value, and a mask that leaves out keys 2 and 7."""
    generator = torch.Generator().manual_seed(seed)
    query = torch.randn(1, HEADS, QUERIES, 6, generator=generator).to(dtype)
    key = torch.randn(1, 2, KEYS, 6, generator=generator).to(dtype)
    value = torch.randn(1, 2, KEYS, 6, generator=generator).to(dtype)
    mask = torch.ones(1, 1, KEYS, dtype=torch.bool)
    mask[..., [2, 7]] = False
    return query, key, value, mask


def rows_of(change, seed: int = 0, dtype=torch.float32) -> tuple[np.ndarray, torch.Tensor]:
    """Rows (head, query, key) and output of a call with a change."""
    query, key, value, mask = inputs(seed, dtype)
    seen = []
    out = attend(query, key, value, mask, 0.8, change=change, rows_to=seen.append)
    return seen[0][0].numpy(), out


def weights_before_normalising(seed: int = 0) -> np.ndarray:
    """exp(logit) of every key, 0 where masked, (head, query, key) float64."""
    query, key, _, mask = inputs(seed)
    logits = 0.8 * np.einsum("hqd,hkd->hqk", query[0].double().numpy(), key[0].double().numpy().repeat(2, axis=0))
    return np.where(mask[0].numpy(), np.exp(logits), 0.0)


def normalised(weights: np.ndarray) -> np.ndarray:
    return weights / weights.sum(-1, keepdims=True)


def editor(*edits: SiteEdit) -> SiteEditor:
    return SiteEditor("joint", edits)


def change_of(*edits: SiteEdit, action=slice(0, QUERIES), own=None, layer=0, step=0):
    return editor(*edits).change(layer, step, CallKeys(action, own))


def factor(*values: float, **fields) -> SiteEdit:
    return SiteEdit("group", "factor", np.array(values), **fields)


FACTORS = (1.0, 0.0, 0.5, 1.0, 0.25, 1.0, 3.0, 0.0, 1.0)
WEIGHTS = np.array([0.0, 1.0, 1.0, 0.5, 0.0, 0.3, 0.0, 1.0, 1.0])


def test_factors():
    rows, _ = rows_of(change_of(factor(*FACTORS)))
    np.testing.assert_allclose(rows, normalised(weights_before_normalising() * FACTORS), atol=1e-6)
    assert (rows[..., [1, 2, 7]] == 0).all()
    np.testing.assert_allclose(rows.sum(-1), 1, atol=1e-6)


def test_uniform_inside_a_group():
    rows, _ = rows_of(change_of(SiteEdit("group", "uniform", WEIGHTS)))
    before = weights_before_normalising()
    allowed = WEIGHTS * (before > 0)
    mean = (allowed * before).sum(-1, keepdims=True) / allowed.sum(-1, keepdims=True)
    after = (1 - allowed) * before + allowed * mean
    np.testing.assert_allclose(after.sum(-1), before.sum(-1))
    np.testing.assert_allclose(rows, normalised(after), atol=1e-6)
    np.testing.assert_allclose(rows[..., 1], rows[..., 8], rtol=1e-5)
    assert (rows[..., [2, 7]] == 0).all()  # masked keys stay so


def test_a_uniform_group_of_small_weights_keeps_its_sum():
    logits = torch.tensor([[50.0, -80.0, -90.0, -100.0]])
    changed = make_uniform(logits, torch.tensor([0.0, 1.0, 1.0, 1.0]))
    expected = np.log(np.exp([-80.0, -90.0, -100.0]).mean())
    np.testing.assert_allclose(changed[0, 1:].numpy(), expected, rtol=1e-6)
    assert changed[0, 0] == 50


def test_edits_follow_one_another():
    both = change_of(factor(*FACTORS), SiteEdit("group", "uniform", WEIGHTS))
    one = change_of(factor(*FACTORS))
    other = change_of(SiteEdit("group", "uniform", WEIGHTS))
    np.testing.assert_array_equal(rows_of(both)[0], rows_of(lambda logits: other(one(logits)))[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_what_has_no_mass_changes_nothing(dtype):
    """A knockout of masked keys, and a factor of 1, leave every bit."""
    values = [1.0] * KEYS
    values[2] = values[7] = 0.0
    plain_rows, plain = rows_of(None, dtype=dtype)
    rows, out = rows_of(change_of(factor(*values)), dtype=dtype)
    assert torch.equal(out, plain)
    np.testing.assert_array_equal(rows, plain_rows)
    assert change_of(factor(*[1.0] * KEYS)) is None
    assert change_of(SiteEdit("group", "uniform", np.zeros(KEYS))) is None


def test_chosen_layers_denoise_steps_and_heads():
    edit = factor(*FACTORS, layers=(1, 3), denoise_steps=(2,), heads=(0, 3))
    assert change_of(edit, layer=0, step=2) is None
    assert change_of(edit, layer=1, step=0) is None
    change = change_of(edit, layer=3, step=2)
    assert change is not None
    rows, plain = rows_of(change)[0], rows_of(None)[0]
    np.testing.assert_array_equal(rows[[1, 2]], plain[[1, 2]])
    assert (rows[[0, 3]][..., 1] == 0).all()


def test_action_queries_only():
    rows, plain = rows_of(change_of(factor(*FACTORS), action=slice(1, 4)))[0], rows_of(None)[0]
    np.testing.assert_array_equal(rows[:, [0, 4]], plain[:, [0, 4]])
    assert (rows[:, 1:4, 1] == 0).all()
    assert change_of(factor(*FACTORS), action=slice(0, 0)) is None


def test_all_queries_but_a_token_that_is_no_action_reads_itself():
    # The tokens of the queries are keys 0 to 4; queries 1 to 4 are action queries.
    change = change_of(factor(*[0.0] * 5, 1, 1, 1, 1, queries="all"), action=slice(1, 5), own=slice(0, 5))
    rows = rows_of(change)[0]
    expected = weights_before_normalising()
    kept = expected[:, 0, 0].copy()
    expected[..., :5] = 0
    expected[:, 0, 0] = kept
    np.testing.assert_allclose(rows, normalised(expected), atol=1e-6)
    assert (rows[:, 1:, :5] == 0).all()


def test_the_prefix():
    """Queries and keys are the same tokens; those that do not exist are left out of the computation."""
    tokens = np.array([0, 1, 3, 4, 5])
    logits = torch.randn(1, HEADS, 5, 5, generator=torch.Generator().manual_seed(1))
    edit = factor(1, 0, 0, 0.5, 1, 1, 1, 1, 1, queries="all")
    assert change_of(edit) is not None
    change = editor(edit).change(0, None, CallKeys.of_prefix(tokens))
    expected = torch.exp(logits.double()).numpy()
    values = np.array([1, 0, 0.5, 1, 1])
    expected *= np.where(np.eye(5, dtype=bool), 1.0, values)
    np.testing.assert_allclose(torch.softmax(change(logits), -1).numpy(), normalised(expected), atol=1e-6)
    assert editor(factor(*FACTORS)).change(0, None, CallKeys.of_prefix(tokens)) is None  # the action queries only


def test_chosen_queries_of_the_prefix():
    readers = np.zeros(KEYS, dtype=bool)
    readers[[3, 4]] = True
    edit = factor(0, 0, *[1.0] * 7, queries="prefix", readers=readers)
    assert change_of(edit) is None
    tokens, logits = np.array([0, 1, 3, 4, 5]), torch.zeros(1, 1, 5, 5)
    rows = torch.softmax(editor(edit).change(0, None, CallKeys.of_prefix(tokens))(logits), -1)[0, 0].numpy()
    np.testing.assert_array_equal(rows[[0, 1, 4]], np.full((3, 5), np.float32(0.2)))
    np.testing.assert_allclose(rows[[2, 3]], [[0, 0, 1 / 3, 1 / 3, 1 / 3]] * 2, rtol=1e-6)


def test_a_query_without_keys():
    changes = editor(factor(*[0.0] * KEYS, heads=(2,)))
    rows_of(changes.change(5, 1, CallKeys(slice(0, QUERIES), None)))
    with pytest.raises(QueryWithoutKeys, match=r"'joint', layer 5, denoise step 1, head 2, query 0: group\."):
        changes.finish()
    # All allowed keys in two edits, which each leave some.
    first = factor(0, 0, 1, 0, 0, 1, 1, 1, 1)
    second = factor(1, 1, 1, 1, 1, 0, 0, 1, 0)
    changes = editor(first, second)
    rows_of(changes.change(0, 0, CallKeys(slice(0, QUERIES), None)))
    with pytest.raises(QueryWithoutKeys, match="query 0: group; group"):
        changes.finish()


def test_a_query_that_had_no_key_before_is_left_alone():
    logits = torch.full((1, 1, 1, KEYS), MASKED_LOGIT)
    rows = torch.softmax(change_of(factor(*FACTORS))(logits), -1)
    np.testing.assert_allclose(rows.numpy(), 1 / KEYS, rtol=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.one_of(st.just(0.0), st.just(1.0), st.floats(0, 4)), min_size=KEYS, max_size=KEYS),
    st.integers(0, 5),
)
def test_rows_stay_probabilities(values, seed):
    weights = weights_before_normalising(seed) * np.array(values)
    if (weights.sum(-1) <= 1e-30).any():
        return
    rows, out = rows_of(change_of(factor(*values)), seed)
    np.testing.assert_allclose(rows.sum(-1), 1, atol=1e-5)
    np.testing.assert_allclose(rows, normalised(weights), atol=1e-5)
    assert (rows[..., np.array(values) == 0] == 0).all()
    assert torch.isfinite(out).all()
