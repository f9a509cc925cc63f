"""Multi-Task DiT of LeRobot 0.6: the real class and CLIP encoders with small random weights."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot.policies.multi_task_dit", reason="LeRobot 0.6's, run in .venv-lerobot06")

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.policy_checks import (
    PolicyCase,
    check_analysis,
    check_change,
    check_contributions,
    check_rows,
    check_uniform_attention,
    kept_outputs,
    record,
    rows_of,
    softmax_rows,
)

HORIZON, HEADS, DIM, PAST, CHUNK = 8, 2, 8, 1, 4
#: Name -> settings: rotary attention or `nn.MultiheadAttention`, and every kind of denoise step.
KINDS: dict[str, dict[str, Any]] = {
    "DDPM": {},
    "DDIM, MultiheadAttention": {"noise_scheduler_type": "DDIM", "use_rope": False, "use_positional_encoding": True},
    "Euler": {"objective": "flow_matching"},
    "Runge-Kutta": {"objective": "flow_matching", "integration_method": "rk4"},
}


@pytest.fixture(scope="module", params=KINDS)
def case(request, tmp_path_factory):
    policy = models.small_multi_task_dit(tmp_path_factory.mktemp("clip"), **KINDS[request.param])
    given = models.observation(24, 24)

    def call(batch):
        # As `select_action` makes it: the chunk is not given otherwise.
        torch.manual_seed(0)
        policy.reset()
        first = policy.select_action(dict(batch))
        return torch.stack([first, *policy._queues["action"]], dim=1)

    return PolicyCase(policy, va.layouts.multi_task_dit(policy), call, given, {}, given["observation.state"])


def test_rows_of_the_returned_actions_are_those_of_the_policy_s_own_queries_and_keys(case, tmp_path):
    store = record(case, tmp_path, tokenizer=None)
    blocks = case.policy.noise_predictor.transformer_blocks
    rope = case.policy.config.use_rope

    def rows(module, inputs, output):
        if rope:
            query, key = (part[0] for part in output)
        else:
            projected = torch.nn.functional.linear(inputs[0][0], module.in_proj_weight, module.in_proj_bias)
            query, key, _ = projected.unflatten(-1, (3, HEADS, DIM)).permute(1, 2, 0, 3)
        return softmax_rows(query[:, PAST : PAST + CHUNK], key, DIM**-0.5)

    attention = [block.attn.rope if rope else block.multihead_attn for block in blocks]
    network = case.policy.noise_predictor
    with (
        kept_outputs(attention, rows) as kept,
        kept_outputs([network], lambda _m, inputs, _o: inputs[1][0]) as (times,),
    ):
        case.call(case.observation)
    check_rows(store, "self", np.array(kept))
    if case.policy.config.is_flow_matching:
        np.testing.assert_allclose(case.layout.denoise_times, times, rtol=1e-6)


def test_noisy_actions_reach_their_keys_and_an_observation_all_of_them(case):
    network = case.policy.noise_predictor

    def with_noise(places):
        def change(_module, given):
            given[0][:, places] = 1.0

        handle = network.input_proj.register_forward_pre_hook(change)
        try:
            return case.call(case.observation)
        finally:
            handle.remove()

    spans = {"past_actions": slice(0, 1), "actions": slice(1, 5), "later_actions": slice(5, 8)}
    changed = {f"span:{span}": functools.partial(with_noise, places) for span, places in spans.items()}
    found = va.check_layout(case.policy, lambda: case.call(case.observation), case.layout, changed)
    assert found.fits, found
    # What is seen, read and felt is no key: it scales and shifts all of them.
    for name in ("images.top", "state", "language.tokens"):
        given = case.observation[f"observation.{name}"]
        check_change(case, "*", {**case.observation, f"observation.{name}": given + 1}, tokenizer=None)


def test_contributions_are_what_the_blocks_add(case, tmp_path):
    blocks = case.policy.noise_predictor.transformer_blocks
    for block in blocks:  # the biases are gated like the rest, and belong to no key
        torch.nn.init.zeros_((block.attn if case.policy.config.use_rope else block.multihead_attn).out_proj.bias)

    def stream(block):
        return (blocks[block].norm1, "given"), (blocks[block].norm2, "given")

    check_contributions(case, record(case, tmp_path, tokenizer=None), "self", stream)


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path):
    cut = va.knockout("span:later_actions")
    rows = rows_of(record(case, tmp_path, replans=1, tokenizer=None, interventions=cut), "self")
    assert not rows[..., PAST + CHUNK :].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_the_analysis_answers_without_a_ratio_and_queries_of_zero_have_lift_1(case, tmp_path):
    record(case, tmp_path, tokenizer=None)
    check_analysis(tmp_path, ["self"], ratios=False)
    check_uniform_attention(case, tmp_path / "uniform", tokenizer=None)
