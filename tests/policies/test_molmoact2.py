"""MolmoAct2 of LeRobot 0.6: the real class and processor with small random weights."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot.policies.molmoact2", reason="LeRobot 0.6's, run by make test-policies in .venv-lerobot06")

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.lerobot_vlm_models import case_of, small_molmoact2
from tests.policies.policy_checks import (
    check_analysis,
    check_change,
    check_contributions,
    check_inspect,
    check_rows,
    check_total_effect,
    check_uniform_attention,
    record,
    roles_of,
    rows_of,
    softmax_rows,
)
from tests.policies.word_tokenizer import INSTRUCTION
from vla_attention.capture.torch_policies.layouts.layout_building import NotThisPolicy
from vla_attention.schemas.errors import BadArgument

RETURNED, CHUNK, HEADS, DIM, PATCHES, STATE = 4, 5, 2, 8, 4, models.STATE_DIM
WORDS = len(INSTRUCTION.split())
#: BOS and "Image 1<im_start>"; "<im_end>Image 2<im_start>"; from "<im_end><|im_start|>user" to the task, and from there
#: to the state; from "<state_end>" to the end of the prompt.
FIRST, BETWEEN, BEFORE, AFTER, LAST = 5, 5, 8, 19, 33
#: Of the layout, two more than the call has between the last picture and the state.
LONGEST = BEFORE + WORDS + AFTER + 2
WRIST = FIRST + PATCHES + BETWEEN
PROMPT = WRIST + PATCHES


def ids_of(before: Any, observation: Any) -> list[int]:
    return before(dict(observation))["input_ids"][0].tolist()


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return small_molmoact2(tmp_path_factory.mktemp("molmo"))


@pytest.fixture(scope="module")
def before(policy):
    return models.preprocessor_of(policy)


@pytest.fixture(scope="module")
def tokenizer(before):
    return next(step for step in before.steps if hasattr(step, "processor")).processor.tokenizer


@pytest.fixture(scope="module")
def case(policy):
    def layout_of(batch):
        ids = batch["input_ids"][0].tolist()
        return va.layouts.molmoact2(policy, ids, cameras=models.CAMERAS, prompt_tokens=LONGEST)

    return case_of(policy, layout_of, 24, 24)


def test_inspect_finds_every_block_at_every_denoise_step(case):
    check_inspect(case, {r"action_expert\..*\.cross_attn": 9, r"action_expert\..*\.self_attn": 9})


def test_rows_are_those_of_the_policy_s_own_queries_and_keys(case, tmp_path, tokenizer):
    store = record(case, tmp_path, tokenizer=tokenizer)
    blocks = case.policy.model.model.action_expert.blocks
    kept: dict[str, list[np.ndarray]] = {"cross": [], "self": []}

    def cross(module, inputs, named):
        query = module.q_norm(module.q_proj(inputs[0])[0].unflatten(-1, (HEADS, DIM)).transpose(0, 1))
        mask = named["attn_mask"][0, 0, 0] == 0
        rows = softmax_rows(query[:, :RETURNED], named["kv_k"][0].transpose(0, 1), DIM**-0.5, mask)
        # The layout's longest prompt has keys that the call does not have.
        kept["cross"].append(np.insert(rows, [PROMPT + LONGEST - 2] * 2, 0.0, axis=-1))

    def own(module, inputs, named):
        query, key, _ = module.qkv(inputs[0])[0].unflatten(-1, (3, HEADS, DIM)).permute(1, 2, 0, 3)
        query, key = module.rope(module.q_norm(query)[None], module.k_norm(key)[None], rope_cache=named["rope_cache"])
        kept["self"].append(softmax_rows(query[0, :, :RETURNED], key[0], DIM**-0.5))

    handles = [block.cross_attn.register_forward_pre_hook(cross, with_kwargs=True) for block in blocks]
    handles += [block.self_attn.register_forward_pre_hook(own, with_kwargs=True) for block in blocks]
    case.call(case.observation)
    for handle in handles:
        handle.remove()
    for site, rows in kept.items():
        check_rows(store, site, np.array([rows[block :: len(blocks)] for block in range(len(blocks))]))


def test_keys_have_the_roles_of_pictures_words_state_and_masked_ends(case, tmp_path, tokenizer):
    roles = roles_of(record(case, tmp_path, tokenizer=tokenizer), "cross")
    text = ["template"] * BEFORE + ["instruction"] * WORDS + ["template"] * AFTER + ["absent"] * 2
    # The action expert does not see the token that ends a turn, which also begins the sequence; four tokens follow it.
    end = ["template"] * (LAST - 6) + ["padding"] + ["template"] * 5
    image = ["image"] * PATCHES
    first = ["padding"] + ["template"] * (FIRST - 1)
    assert roles == [*first, *image, *["template"] * BETWEEN, *image, *text, *["state"] * STATE, *end]


def test_pictures_words_the_state_and_the_noise_reach_their_keys(case, before, tokenizer):
    given = case.observation
    for camera in models.CAMERAS:
        name = f"observation.images.{camera}"
        check_change(case, f"camera:{camera}", {**given, name: 1 - given[name]}, tokenizer=tokenizer)
    words = {**given, "task": [INSTRUCTION.replace("bowl", "robot")]}
    check_change(case, "word:bowl", words, tokenizer=tokenizer)
    other = torch.where(given["observation.state"] > 0, -0.9, 0.9)
    check_change(case, "span:state", {**given, "observation.state": other}, tokenizer=tokenizer)
    noise = models.chunk_of(case.policy, seed=5)
    moved = va.check_layout(
        case.policy,
        lambda: case.call(given),
        case.layout,
        {"span:actions | span:later_actions": lambda: noise(before(dict(given)))},
    )
    assert moved.fits, moved


@pytest.mark.parametrize("site", ["self", "cross"])
def test_contributions_are_what_the_blocks_add(case, tmp_path, tokenizer, site):
    blocks = case.policy.model.model.action_expert.blocks

    def stream(block):
        norms = [blocks[block].self_norm, blocks[block].cross_norm, blocks[block].ff_norm]
        first = ["self", "cross"].index(site)
        return (norms[first], "given"), (norms[first + 1], "given")

    check_contributions(case, record(case, tmp_path, tokenizer=tokenizer), site, stream)


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path, tokenizer):
    cut = va.knockout("camera:wrist")
    rows = rows_of(record(case, tmp_path, replans=1, tokenizer=tokenizer, interventions=cut), "cross")
    assert not rows[..., WRIST : WRIST + PATCHES].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_the_total_effect_of_a_word_is_that_of_a_call_that_masks_its_token(case, tmp_path, tokenizer, before):
    (bowl,) = tokenizer(" bowl")["input_ids"]
    batch = before(dict(case.observation))
    masked = {**batch, "attention_mask": batch["attention_mask"].masked_fill(batch["input_ids"] == bowl, 0)}
    check_total_effect(case, tmp_path, tokenizer, "bowl", models.chunk_of(case.policy)(masked))


def test_the_analysis_answers_and_queries_of_zero_have_lift_1(case, tmp_path, tokenizer):
    record(case, tmp_path, tokenizer=tokenizer)
    check_analysis(tmp_path, ["cross"])
    check_analysis(tmp_path, ["self"], ratios=False)
    check_uniform_attention(case, tmp_path / "uniform", tokenizer=tokenizer)


def test_what_the_layout_cannot_cover_is_refused(policy, before, case, monkeypatch):
    ids = ids_of(before, case.observation)
    with pytest.raises(BadArgument, match="hold 2 runs of placeholders"):
        va.layouts.molmoact2(policy, ids, cameras=["top"])
    monkeypatch.setattr(policy.config, "inference_action_mode", "discrete")
    with pytest.raises(NotThisPolicy, match="inference_action_mode='continuous'"):
        va.layouts.molmoact2(policy, ids, cameras=models.CAMERAS)
    monkeypatch.setattr(policy.config, "inference_action_mode", None)
    monkeypatch.setattr(policy.config, "enable_inference_cuda_graph", True)
    with pytest.raises(NotThisPolicy, match="enable_inference_cuda_graph = False"):
        va.layouts.molmoact2(policy, ids, cameras=models.CAMERAS)
