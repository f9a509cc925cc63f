"""Contributions of key parts: against a direct computation, and against what the block really added."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from vla_attention.capture.policies.pi.config import GemmaConfig
from vla_attention.capture.policies.pi.gemma import AttentionCalls, GemmaBlock, Rotation
from vla_attention.capture.recording.attention import attend
from vla_attention.capture.recording.contributions import gram_matrix, keys_of_parts, part_contributions
from vla_attention.capture.recording.recorder import AttentionRecorder, RecordingPlan, SiteNotRecorded, make_recorders
from vla_attention.schemas.stores.store_format import Recording

HEADS, KV_HEADS, QUERIES, KEYS, DIM, WIDTH = 4, 2, 3, 11, 5, 7


def random_tensors(seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    rows = torch.softmax(torch.randn(HEADS, QUERIES, KEYS, generator=generator) * 3, dim=-1)
    values = torch.randn(KV_HEADS, KEYS, DIM, generator=generator)
    weight = torch.randn(WIDTH, HEADS * DIM, generator=generator)
    gate = torch.randn(1, WIDTH, generator=generator)
    return rows, values, weight, gate


def parts_of(members: torch.Tensor) -> list[slice | torch.Tensor]:
    return keys_of_parts(members.numpy(), torch.device("cpu"))


def test_parts_equal_a_direct_computation_and_add_up_to_the_update():
    rows, values, weight, gate = random_tensors(0)
    members = torch.zeros(KEYS, 3, dtype=torch.bool)
    members[[0, 4, 5], 0] = True
    members[[1, 2, 3, 6], 1] = True
    members[[7, 8, 9, 10], 2] = True
    each = part_contributions(rows, values, parts_of(members), lambda mixed: mixed @ weight.T * gate)
    assert each.shape == (QUERIES, 3, WIDTH)
    for query in range(QUERIES):
        for part in range(3):
            direct = torch.zeros(WIDTH, dtype=torch.float64)
            for head in range(HEADS):
                for key in range(KEYS):
                    if members[key, part]:
                        block = weight[:, head * DIM : (head + 1) * DIM].double()
                        direct += rows[head, query, key].double() * (block @ values[head // 2, key].double())
            torch.testing.assert_close(each[query, part].double(), direct * gate[0].double(), rtol=1e-4, atol=1e-5)
    update = (rows @ values.repeat_interleave(2, dim=0)).transpose(0, 1).flatten(1) @ weight.T * gate
    torch.testing.assert_close(each.sum(dim=1), update, rtol=1e-4, atol=1e-5)
    gram = gram_matrix(each, update)
    torch.testing.assert_close(gram[:3, :3].sum(), update.square().sum(dim=1).mean(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(gram[3, 3], gram[:3, :3].sum(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(gram[:3].sum(dim=0), gram[3], rtol=1e-4, atol=1e-4)


def test_norms_of_unions_of_parts_follow_from_the_gram_matrix():
    rows, values, weight, gate = random_tensors(1)
    members = torch.eye(KEYS, dtype=torch.bool)

    def project(mixed: torch.Tensor) -> torch.Tensor:
        return mixed @ weight.T * gate

    each = part_contributions(rows, values, parts_of(members), project)
    gram = gram_matrix(each, each.sum(dim=1))
    chosen = torch.zeros(KEYS + 1)
    chosen[[2, 3, 9]] = 1
    union = members[:, [2, 3, 9]].any(dim=1, keepdim=True)
    together = part_contributions(rows, values, parts_of(union), project)
    torch.testing.assert_close(chosen @ gram @ chosen, together.square().sum(dim=2).mean(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("condition_width", [None, 6])
def test_a_block_passes_its_whole_update_to_the_recorder(condition_width):
    torch.manual_seed(0)
    config = GemmaConfig(width=8, depth=1, mlp_dim=16, num_heads=4, num_kv_heads=1, head_dim=4)
    block = GemmaBlock(config, condition_width)
    x = torch.randn(1, 6, 8)
    condition = None if condition_width is None else torch.randn(1, condition_width)
    rotation = Rotation.at(torch.arange(6)[None], 4)
    members = np.zeros((6, 2), dtype=bool)
    members[:2, 0], members[2:, 1] = True, True
    plan = RecordingPlan(layers=(0,), denoise_steps=(0,), heads=(1,), queries="mean", site="joint")
    recorder = AttentionRecorder(plan, 6, members)
    actions = slice(3, 6)
    seen: list[torch.Tensor] = []
    take_update = recorder.update_sink(0, 0, actions)
    assert take_update is not None
    with torch.no_grad():
        block(
            x,
            None,
            rotation,
            condition=condition,
            calls=AttentionCalls(
                rows_to=recorder.sink(0, 0, actions),
                update_to=lambda values, project, update: (seen.append(update), take_update(values, project, update)),
            ),
        )
    gram = recorder.finish().contribution
    assert gram is not None
    assert gram.shape == (1, 1, 3, 3)
    norm = seen[0][0, actions].square().sum(dim=1).mean().item()
    assert gram[0, 0, 2, 2] == pytest.approx(norm, rel=1e-5)
    assert gram[0, 0, :2, :2].sum() == pytest.approx(norm, rel=1e-4)


def test_masked_keys_contribute_nothing():
    query, key, value = (torch.randn(1, 2, 5, 4) for _ in range(3))
    mask = torch.ones(1, 5, 5, dtype=torch.bool)
    mask[:, :, 3:] = False
    rows: list[torch.Tensor] = []
    attend(query, key, value, mask, 0.5, rows_to=rows.append)
    members = torch.zeros(5, 2, dtype=torch.bool)
    members[:3, 0], members[3:, 1] = True, True
    each = part_contributions(rows[0][0], value[0], parts_of(members), lambda mixed: mixed)
    assert not each[:, 1].any()


def test_a_missing_update_is_an_error():
    plan = RecordingPlan(layers=(0,), denoise_steps=(0,), heads=(0,), queries="mean", site="joint")
    recorder = AttentionRecorder(plan, 4, np.ones((4, 1), dtype=bool))
    take = recorder.sink(0, 0, slice(0, 2))
    assert take is not None
    take(torch.full((1, 1, 2, 4), 0.25))
    with pytest.raises(SiteNotRecorded):
        recorder.finish()


@pytest.mark.parametrize("state_digits", [False, True])
@pytest.mark.parametrize("pi05", [True, False])
def test_contributions_of_all_steps_at_once_are_those_of_each_call(pi05, state_digits):
    """Value products of pieces, single keys and the part that is left: against rows times values, call by call."""
    from tests.kit.policy_inputs import make_observation
    from vla_attention.capture.policies.pi.embedded import DUMMY_CONFIG, build_random_model, dummy_policy
    from vla_attention.capture.policies.pi.policy import PiPolicy

    tiny = dummy_policy()
    config = dataclasses.replace(DUMMY_CONFIG, pi05=pi05, discrete_state_input=pi05 and state_digits)
    policy = PiPolicy(build_random_model(config, 3), tiny.tokenizer, tiny.processing, tiny.source)
    given = policy.prepare(make_observation(1), "put the red cube on the plate beside the very small green cube")
    layers, steps = (2, 0), (2, 0, 1)
    recording = Recording(layers, layers, steps, tuple(range(8)), "mean", 4, 10, contributions=True)

    class EachCall(AttentionRecorder):
        """Keeps no facts about the keys, so that every call is computed for itself from its rows."""

        def begin_call(self, allowed, lasting, pieces):
            return

    at_once = make_recorders(recording, policy.sites, given.key_role)["joint"]
    each = EachCall(at_once.plan, at_once.num_keys, at_once.parts)
    actions = [policy.act(given, 7, {"joint": recorder}) for recorder in (at_once, each)]
    np.testing.assert_array_equal(*actions)
    got, expected = at_once.finish(), each.finish()
    np.testing.assert_array_equal(got.rows, expected.rows)
    assert got.contribution is not None
    assert expected.contribution is not None
    scale = expected.contribution[..., -1:, -1:]
    np.testing.assert_allclose(got.contribution / scale, expected.contribution / scale, rtol=2e-4, atol=2e-6)
    masked = ~(given.tensors["token_mask"][0].numpy())
    assert masked.any()
    nothing_read = (expected.contribution == 0).all(axis=(0, 1, 2))
    assert nothing_read.any()  # the absent camera, the padding
    assert (got.contribution[..., nothing_read, :] == 0).all()


@pytest.mark.parametrize("pi05", [True, False])
def test_updates_of_pi_are_what_the_expert_adds_to_its_residual_stream(pi05):
    from tests.kit.policy_inputs import make_observation
    from vla_attention.capture.policies.pi.embedded import DUMMY_CONFIG, build_random_model, dummy_policy
    from vla_attention.capture.policies.pi.policy import PiPolicy

    tiny = dummy_policy()
    policy = PiPolicy(
        build_random_model(dataclasses.replace(DUMMY_CONFIG, pi05=pi05), 3),
        tiny.tokenizer,
        tiny.processing,
        tiny.source,
    )
    given = policy.prepare(make_observation(1), "put the red cube on the plate")
    recording = Recording((0, 1, 2), (0, 1, 2), (0, 1, 2), tuple(range(8)), "mean", 4, 10, contributions=True)
    recorder = make_recorders(recording, policy.sites, given.key_role)["joint"]
    actions = slice(policy.model.config.first_action_query, None)
    kept: dict[tuple[int, str], list[torch.Tensor]] = {}
    for number, block in enumerate(policy.model.paligemma_with_expert.gemma_expert.model.layers):
        for name in ("input_layernorm", "post_attention_layernorm"):
            streams = kept.setdefault((number, name), [])
            getattr(block, name).register_forward_hook(
                lambda _module, inputs, _output, streams=streams: streams.append(inputs[0][0, actions].clone())
            )
    policy.act(given, 7, {"joint": recorder})
    gram = recorder.finish().contribution
    assert gram is not None
    for layer in range(3):
        before, after = (torch.stack(kept[layer, name]) for name in ("input_layernorm", "post_attention_layernorm"))
        expected = (after - before).square().sum(dim=-1).mean(dim=-1).numpy()  # (denoise step,)
        np.testing.assert_allclose(gram[layer, :, -1, -1], expected, rtol=1e-4)
        np.testing.assert_allclose(gram[layer, :, :-1, :-1].sum(axis=(-1, -2)), expected, rtol=1e-3)


def test_contributions_that_wait_on_a_gpu_are_those_of_each_call(monkeypatch):
    """The way of a GPU, made on the processor: rows, values and updates are kept until the steps are done."""
    from tests.kit.policy_inputs import make_observation
    from vla_attention.capture.policies.pi.embedded import dummy_policy
    from vla_attention.capture.recording.call_contributions import CallContributions

    policy = dummy_policy()
    given = policy.prepare(make_observation(1), "put the red cube on the plate")
    recording = Recording((2, 0), (2, 0), (2, 0, 1), tuple(range(8)), "mean", 4, 10, contributions=True)
    made = {}
    for way in ("now", "later"):
        monkeypatch.setattr(CallContributions, "_choose", lambda *_, way=way: way)
        recorder = make_recorders(recording, policy.sites, given.key_role)["joint"]
        policy.act(given, 7, {"joint": recorder})
        made[way] = recorder.finish().contribution
    assert made["now"].any()
    scale = made["now"][..., -1:, -1:]
    np.testing.assert_allclose(made["later"] / scale, made["now"] / scale, rtol=2e-4, atol=2e-6)
