"""FastWAM of LeRobot 0.6: the real class on a small Wan VAE and UMT5 with random weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot.policies.fastwam", reason="LeRobot 0.6's, run by make test-policies in .venv-lerobot06")

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.lerobot_vlm_models import small_fastwam
from tests.policies.policy_checks import (
    PolicyCase,
    check_analysis,
    check_change,
    check_contributions,
    check_cut,
    check_inspect,
    check_rows,
    check_uniform_attention,
    record,
    roles_of,
    rows_of,
    softmax_rows,
)
from tests.policies.word_tokenizer import INSTRUCTION
from vla_attention.schemas.errors import BadArgument

CHUNK, STEPS, HEADS, DIM, VIDEO, LONGEST, WORDS = 4, 3, 2, 8, 8, 12, len(INSTRUCTION.split())


@pytest.fixture(scope="module")
def case():
    policy = small_fastwam()
    for layer in policy.model.mot.layers:
        # Called as a module, so that hooks see the residual stream before it.
        layer.blocks["action"].norm3 = torch.nn.Sequential(layer.blocks["action"].norm3)
    given = {**models.observation(64, 64), "task": [INSTRUCTION]}
    before, chunk = models.preprocessor_of(policy), models.chunk_of(policy)
    frames, state = models.frames_of(given), given["observation.state"]
    return PolicyCase(
        policy, va.layouts.fastwam(policy), lambda batch: chunk(before(dict(batch))), given, frames, state
    )


def blocks_of(case):
    return [layer.blocks["action"] for layer in case.policy.model.mot.layers]


def test_inspect_finds_every_block_of_the_actions_at_every_denoise_step(case):
    # `joint` also runs once a block over the picture's tokens.
    joint = {r"mot\.layers\.\d$": 3 + 3 * STEPS}
    check_inspect(case, {r"mixtures\.action\.blocks\.\d$": 3 * STEPS} | joint)


def test_rows_are_those_of_the_policy_s_own_queries_and_keys(case, tmp_path, monkeypatch):
    from lerobot.policies.fastwam.wan import modular, video_dit

    store = record(case, tmp_path)
    kept: dict[str, list[np.ndarray]] = {"joint": [], "cross": []}
    own = video_dit.fastwam_masked_attention

    def heads(tokens):
        return tokens[0].unflatten(-1, (HEADS, DIM)).transpose(0, 1)

    def attention(q, k, v, num_heads, ctx_mask=None, fp32_attention=True):
        if q.shape[1] == CHUNK:
            site = "joint" if k.shape[1] == VIDEO + CHUNK else "cross"
            mask = ctx_mask if ctx_mask.ndim == 2 else ctx_mask[0, 0]
            kept[site].append(softmax_rows(heads(q), heads(k), DIM**-0.5, mask))
        return own(q, k, v, num_heads, ctx_mask, fp32_attention)

    for module in (modular, video_dit):
        monkeypatch.setattr(module, "fastwam_masked_attention", attention)
    case.call(case.observation)
    for site, rows in kept.items():
        check_rows(store, site, np.array([rows[block::3] for block in range(3)]))


def test_denoise_times_are_those_that_the_policy_gives_its_actions(case, monkeypatch):
    expert, times = case.policy.model.action_expert, []
    own = expert.pre_dit

    def keep(timestep, **named):
        times.append(float(timestep) / 1000)
        return own(timestep=timestep, **named)

    monkeypatch.setattr(expert, "pre_dit", keep)
    case.call(case.observation)
    np.testing.assert_allclose(case.layout.denoise_times, times, rtol=1e-6)


def test_keys_have_the_roles_of_pictures_words_and_the_state(case, tmp_path):
    store = record(case, tmp_path)
    assert roles_of(store, "joint") == ["image"] * VIDEO + ["action"] * CHUNK
    padding = LONGEST - 2 - WORDS  # which takes part in attention
    prompt = ["template"] * 2 + ["instruction"] * WORDS + ["template"] * padding
    assert roles_of(store, "cross") == [*prompt, "state"]


def test_the_words_and_the_state_reach_their_keys(case):
    given = case.observation
    check_change(case, "span:state", {**given, "observation.state": torch.zeros(1, 6)}, site="cross")
    # UMT5 mixes the words; this task has no padding.
    long = f"{INSTRUCTION} now slowly robot task"
    whole = replace(case, observation={**given, "task": [long]}, instruction=long)
    check_change(whole, "span:prompt", {**given, "task": [long.replace("bowl", "robot")]}, site="cross")


def test_pictures_and_patches_reach_their_keys_where_the_vae_mixes_nothing(case, monkeypatch):
    def means(videos, **_):
        return torch.nn.functional.avg_pool3d(torch.stack(videos), (1, 16, 16)).repeat(1, 16, 1, 1, 1)

    monkeypatch.setattr(case.policy.model.vae, "encode", means)
    given, names = case.observation, {camera: f"observation.images.{camera}" for camera in models.CAMERAS}
    for camera, name in names.items():
        check_change(case, f"camera:{camera}", {**given, name: 1 - given[name]}, site="joint")
    part = given[names["top"]].clone()
    part[..., 32:, :32] = 1 - part[..., 32:, :32]
    check_change(case, "patch:top[0.5:1,0:0.5]", {**given, names["top"]: part}, site="joint")


@pytest.mark.parametrize("site", ["joint", "cross"])
def test_contributions_are_what_the_blocks_add(case, tmp_path, site):
    blocks = blocks_of(case)
    for block in blocks:  # the bias of the self-attention is gated like the rest, and belongs to no key
        torch.nn.init.zeros_(block.self_attn.o.bias)
        torch.nn.init.zeros_(block.cross_attn.o.bias)

    def stream(block):
        norms = [blocks[block].norm1, blocks[block].norm3, blocks[block].norm2]
        first = ["joint", "cross"].index(site)
        return (norms[first], "given"), (norms[first + 1], "given")

    check_contributions(case, record(case, tmp_path), site, stream)


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path):
    cut = va.knockout("camera:wrist")
    rows = rows_of(record(case, tmp_path, replans=1, interventions=cut), "joint")
    assert not rows[..., [2, 3, 6, 7]].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_a_cut_of_the_state_is_a_call_in_which_no_action_reads_it(case, tmp_path, monkeypatch):
    expert = case.policy.model.action_expert
    own = expert.pre_dit

    def without_state(context_mask, **named):
        context_mask = context_mask.clone()
        context_mask[:, -1] = False
        return own(context_mask=context_mask, **named)

    monkeypatch.setattr(expert, "pre_dit", without_state)
    by_hand = case.call(case.observation)
    monkeypatch.undo()
    check_cut(case, tmp_path, "span:state", by_hand)


def test_effects_for_all_queries_are_refused(case, tmp_path):
    with pytest.raises(BadArgument, match=r"readers=\('action',\)"):
        va.record(tmp_path / "a.zarr", case.policy, layout=case.layout, effects=va.EffectSettings(("text",)))


def test_the_analysis_answers_and_queries_of_zero_have_lift_1(case, tmp_path):
    record(case, tmp_path)
    check_analysis(tmp_path, ["joint", "cross"])
    check_uniform_attention(case, tmp_path / "uniform")
