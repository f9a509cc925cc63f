"""EVO-1 of LeRobot 0.6: the real class, a small InternVL 3 and Qwen 2's tokenizer with small random weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot.policies.evo1", reason="LeRobot 0.6's, run by make test-policies in .venv-lerobot06")

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.policy_checks import (
    PolicyCase,
    check_analysis,
    check_change,
    check_contributions,
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

CHUNK, HEADS, DIM, PATCHES, LONGEST = 5, 2, 8, 4, 64
WORDS = len(INSTRUCTION.split())
#: "Image-1: <img>", and "</img>\nImage-2: <img>", and "</img>\n" before the task.
FIRST, BETWEEN, LAST = 6, 8, 2
WRIST = FIRST + PATCHES + BETWEEN
TEXT_END = WRIST + 2 * PATCHES + BETWEEN + LAST + WORDS


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    policy = models.small_evo1(tmp_path_factory.mktemp("vlm"))
    given = {**models.observation(24, 24), "task": [INSTRUCTION]}
    frames, state = models.frames_of(given), given["observation.state"]
    return PolicyCase(policy, va.layouts.evo1(policy), models.chunk_of(policy), given, frames, state)


@pytest.fixture(scope="module")
def tokenizer(case):
    return case.policy.model.embedder.tokenizer


@pytest.fixture(scope="module")
def unmixed(tmp_path_factory):
    """A policy whose encoders give every token its own place's content only."""
    policy = models.small_evo1(tmp_path_factory.mktemp("vlm"))
    vlm = policy.model.embedder.model
    for layer in vlm.language_model.layers:
        torch.nn.init.zeros_(layer.self_attn.o_proj.weight)
    for layer in vlm.vision_tower.encoder.layer:
        torch.nn.init.zeros_(layer.lambda_1)
    given = {**models.observation(24, 24), "task": [INSTRUCTION]}
    return PolicyCase(policy, va.layouts.evo1(policy), models.chunk_of(policy), given)


def test_rows_are_those_of_the_policy_s_own_queries_and_keys(case, tmp_path, tokenizer):
    store = record(case, tmp_path, tokenizer=tokenizer)
    modules = [block.attn for block in case.policy.model.action_head.transformer_blocks]
    kept: list[np.ndarray] = []

    def keep(module, inputs, named):
        tokens, context, _ = (part[0] for part in inputs)
        query, key = (
            torch.nn.functional.linear(given, weight, bias).unflatten(-1, (HEADS, DIM)).transpose(0, 1)
            for given, weight, bias in zip(
                (tokens, context), module.in_proj_weight.chunk(3), module.in_proj_bias.chunk(3), strict=False
            )
        )
        rows = softmax_rows(query, key, DIM**-0.5, ~named["key_padding_mask"][0])
        # The layout's longest prompt has keys that the call does not have.
        kept.append(np.insert(rows, [TEXT_END] * (LONGEST - TEXT_END), 0.0, axis=-1))

    handles = [module.register_forward_pre_hook(keep, with_kwargs=True) for module in modules]
    case.call(case.observation)
    for handle in handles:
        handle.remove()
    check_rows(store, "cross", np.array([kept[block :: len(modules)] for block in range(len(modules))]))


def test_keys_have_the_roles_of_views_words_and_the_state(case, tmp_path, tokenizer):
    roles = roles_of(record(case, tmp_path, tokenizer=tokenizer), "cross")
    view, between = ["image"] * PATCHES, ["template"] * BETWEEN
    prompt = ["template"] * LAST + ["instruction"] * WORDS + ["absent"] * (LONGEST - TEXT_END)
    empty = ["masked_image"] * PATCHES
    assert roles == [*["template"] * FIRST, *view, *between, *view, *between, *empty, *prompt, "state"]


def test_pictures_patches_words_and_the_state_reach_their_keys(unmixed, tokenizer):
    given = unmixed.observation
    names = {camera: f"observation.images.{camera}" for camera in models.CAMERAS}
    for camera, name in names.items():
        check_change(unmixed, f"camera:{camera}", {**given, name: 1 - given[name]}, tokenizer=tokenizer)
    # As far from the other quarters as the resizing reaches.
    part = given[names["top"]].clone()
    part[..., :9, 15:] = 1 - part[..., :9, 15:]
    check_change(unmixed, "patch:top[0:1,1:2]", {**given, names["top"]: part}, tokenizer=tokenizer)
    words = {**given, "task": [INSTRUCTION.replace("bowl", "robot")]}
    check_change(unmixed, "word:bowl", words, tokenizer=tokenizer)
    check_change(unmixed, "span:state", {**given, "observation.state": torch.zeros(1, 6)}, tokenizer=tokenizer)


def test_contributions_are_what_the_blocks_add(case, tmp_path, tokenizer):
    blocks = case.policy.model.action_head.transformer_blocks
    check_contributions(
        case,
        record(case, tmp_path, tokenizer=tokenizer),
        "cross",
        lambda block: ((blocks[block].norm1, "given"), (blocks[block].norm2, "given")),
        "model.action_head.transformer_blocks.{block}.attn.out_proj",
    )


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path, tokenizer):
    cut = va.knockout("camera:wrist")
    rows = rows_of(record(case, tmp_path, replans=1, tokenizer=tokenizer, interventions=cut), "cross")
    assert not rows[..., WRIST : WRIST + PATCHES].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_the_total_effect_of_a_word_is_that_of_a_call_that_masks_its_token(case, tmp_path, tokenizer, monkeypatch):
    embedder, (bowl,) = case.policy.model.embedder, tokenizer(" bowl")["input_ids"]
    own = embedder._mask_absent_image_tokens
    monkeypatch.setattr(
        embedder, "_mask_absent_image_tokens", lambda ids, *given: own(ids, *given).masked_fill(ids == bowl, 0)
    )
    by_hand = case.call(case.observation)
    monkeypatch.undo()
    check_total_effect(case, tmp_path, tokenizer, "bowl", by_hand)


def test_the_analysis_answers_and_queries_of_zero_have_lift_1(case, tmp_path, tokenizer):
    record(case, tmp_path, tokenizer=tokenizer)
    check_analysis(tmp_path, ["cross"])
    check_uniform_attention(case, tmp_path / "uniform", tokenizer=tokenizer)


def test_one_token_of_pictures_and_words_is_refused(tmp_path):
    with pytest.raises(NotThisPolicy, match="return_cls_only=True"):
        va.layouts.evo1(models.small_evo1(tmp_path, return_cls_only=True))
