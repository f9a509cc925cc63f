"""VQ-BeT of LeRobot 0.6: the real class with small random weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot", reason="run by make test-policies, in .venv-lerobot06")

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.policy_checks import (
    PolicyCase,
    check_analysis,
    check_change,
    check_contributions,
    check_cut,
    check_inspect,
    check_rows,
    check_uniform_attention,
    kept_outputs,
    record,
    roles_of,
    rows_of,
    softmax_rows,
)

pytestmark = pytest.mark.skipif(models.IS_04, reason="needs torchvision's ResNet, which is in .venv-lerobot06 only")

OBSERVATIONS, HEADS, DIM, QUERY, KEYS = 3, 2, 8, 8, 10


@pytest.fixture(scope="module")
def case():
    policy = models.small_vqbet()
    given = models.observation(64, 96, cameras=("top",))

    def call(batch):
        # As `select_action` makes it: the observations before the first are the same.
        torch.manual_seed(0)
        policy.reset()
        first = policy.select_action(dict(batch))
        return torch.stack([first, *policy._queues["action"]], dim=1)

    frames, state = models.frames_of(given), given["observation.state"]
    return PolicyCase(policy, va.layouts.vqbet(policy), call, given, frames, state)


def attention_of(case):
    return [block.attn for block in case.policy.vqbet.policy.transformer.h]


def test_inspect_finds_every_block(case):
    check_inspect(case, {r"transformer\.h\.\d\.attn": 3})


def test_rows_are_those_of_the_policy_s_own_queries_and_keys(case, tmp_path):
    store = record(case, tmp_path, tokenizer=None)

    def rows(module, _inputs, output):
        query, key, _ = output[0].unflatten(-1, (3, HEADS, DIM)).permute(1, 2, 0, 3)
        return softmax_rows(query[:, QUERY : QUERY + 1], key, DIM**-0.5, torch.arange(KEYS) <= QUERY)

    with kept_outputs([module.c_attn for module in attention_of(case)], rows) as kept:
        case.call(case.observation)
    check_rows(store, "self", np.array(kept))
    assert roles_of(store, "self") == ["image", "state", "learned"] * OBSERVATIONS + ["absent"]


def test_the_picture_and_the_state_reach_their_keys(case):
    name = "observation.images.top"
    check_change(case, "camera:top", {**case.observation, name: 1 - case.observation[name]}, tokenizer=None)
    state = {**case.observation, "observation.state": torch.zeros(1, 6)}
    check_change(case, "role:state", state, tokenizer=None)


def test_contributions_are_what_the_blocks_add(case, tmp_path):
    blocks = case.policy.vqbet.policy.transformer.h

    def stream(block):
        return (blocks[block].ln_1, "given"), (blocks[block].ln_2, "given")

    store = record(case, tmp_path, tokenizer=None)
    check_contributions(case, store, "self", stream, "vqbet.policy.transformer.h.{block}.attn.c_proj")


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path):
    cut = va.knockout("camera:top")
    rows = rows_of(record(case, tmp_path, replans=1, tokenizer=None, interventions=cut), "self")
    assert not rows[..., 0:QUERY:3].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_a_cut_of_a_state_is_a_call_with_another_causal_mask(case, tmp_path):
    masks = [module.bias for module in attention_of(case)]
    for mask in masks:
        mask[..., QUERY, 4] = 0  # the state of the second observation
    by_hand = case.call(case.observation)
    for mask in masks:
        mask.copy_(torch.ones_like(mask).tril())
    check_cut(case, tmp_path, "span:state_1", by_hand)


def test_the_analysis_answers_without_a_ratio_and_queries_of_zero_have_lift_1(case, tmp_path):
    record(case, tmp_path, tokenizer=None)
    check_analysis(tmp_path, ["self"], ratios=False)
    check_uniform_attention(case, tmp_path / "uniform", tokenizer=None)
