"""VLA-JEPA of LeRobot 0.6: the real class and a small Qwen 3 VL with random weights, in float32."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot.policies.vla_jepa", reason="LeRobot 0.6's, run by make test-policies in .venv-lerobot06")

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.lerobot_vlm_models import case_of, small_vla_jepa
from tests.policies.policy_checks import (
    check_analysis,
    check_change,
    check_contributions,
    check_inspect,
    check_rows,
    check_total_effect,
    check_uniform_attention,
    kept_outputs,
    record,
    roles_of,
    rows_of,
    softmax_rows,
)
from tests.policies.word_tokenizer import INSTRUCTION

CHUNK, PATCHES, EMBODIED, FRAMES, HEADS, DIM, WORDS = 5, 12, 4, 2, 2, 8, len(INSTRUCTION.split())
#: Around the task: "<|vision_end|>Your task is ", and to the tokens for frames; keys more in the layout's prompt.
BEFORE, AFTER, LONGER = 5, 8, 2


@pytest.fixture(scope="module", autouse=True)
def in_float32():
    from lerobot.policies.vla_jepa import modeling_vla_jepa

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(modeling_vla_jepa, "_get_autocast_context", lambda *_: nullcontext())
        yield


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return small_vla_jepa(tmp_path_factory.mktemp("qwen"))


@pytest.fixture(scope="module")
def tokenizer(policy):
    return policy.model.qwen.processor.tokenizer


@pytest.fixture(scope="module")
def case(policy):
    longest = BEFORE + WORDS + AFTER + LONGER
    return case_of(policy, lambda batch: va.layouts.vla_jepa(policy, batch, prompt_tokens=longest))


@pytest.fixture(scope="module")
def head(policy, case):
    return replace(case, layout=va.layouts.vla_jepa(policy, case.observation, head=True), frames={})


def test_inspect_finds_qwen_once_and_the_head_at_every_denoise_step(case):
    check_inspect(case, {r"language_model\.layers\.\d\.self_attn": 3, r"transformer_blocks\.\d\.attn1": 3 * 3})


def test_rows_of_the_embodied_tokens_are_those_of_the_policy_s_own_eager_softmax(
    case, tmp_path, tokenizer, monkeypatch
):
    store = record(case, tmp_path, tokenizer=tokenizer)
    monkeypatch.setattr(case.policy.model.qwen.model.config.text_config, "_attn_implementation", "eager")
    attention = [layer.self_attn for layer in case.policy.model.qwen.model.model.language_model.layers]
    queries = slice(*case.layout.site("joint").action_queries)
    with kept_outputs(attention, lambda _module, _inputs, output: output[1][0, :, queries].numpy()) as kept:
        case.call(case.observation)
    # The layout's longest prompt has keys that the call does not have.
    end = case.layout.site("joint").keys.span("prompt").stop - LONGER
    check_rows(store, "joint", np.insert(np.array(kept), [end] * LONGER, 0.0, axis=-1))


def test_rows_of_the_head_are_those_of_its_own_queries_and_keys(head, tmp_path):
    store = record(head, tmp_path, tokenizer=None)
    attention = [block.attn1 for block in head.policy.model.action_model.model.transformer_blocks]

    def heads(_module, _inputs, output):
        return output[0].unflatten(-1, (HEADS, DIM)).transpose(0, 1)

    projections = [part for module in attention for part in (module.to_q, module.to_k)]
    with kept_outputs(projections, heads) as kept:
        head.call(head.observation)
    for site, blocks in (("cross", (0, 2)), ("self", (1,))):
        rows = [
            [
                softmax_rows(query[:, -CHUNK:], key, DIM**-0.5)
                for query, key in zip(*kept[2 * b : 2 * b + 2], strict=True)
            ]
            for b in blocks
        ]
        check_rows(store, site, np.array(rows))


def test_keys_have_the_roles_of_pictures_words_and_learned_tokens(case, tmp_path, tokenizer):
    roles = roles_of(record(case, tmp_path, tokenizer=tokenizer), "joint")
    spans = {span.name: roles[span.start : span.stop] for span in case.layout.site("joint").keys.spans}
    prompt = [*["template"] * BEFORE, *["instruction"] * WORDS, *["template"] * AFTER, *["absent"] * LONGER]
    assert spans["prompt"] == prompt
    assert (spans["top"], spans["wrist"]) == (["image"] * PATCHES,) * 2
    assert (spans["frame_tokens"], spans["embodied"]) == (["learned"] * FRAMES, ["learned"] * EMBODIED)
    # No embodied token sees what comes after it.
    assert set(spans["prompt_end"]) == {"padding"}


def test_pictures_and_words_reach_their_keys_in_qwen_and_all_of_the_head_s(case, head, tokenizer):
    given = case.observation
    for camera in models.CAMERAS:
        name = f"observation.images.{camera}"
        check_change(case, f"camera:{camera}", {**given, name: 1 - given[name]}, tokenizer=tokenizer)
    words = {**given, "task": [INSTRUCTION.replace("bowl", "robot")]}
    check_change(case, "word:bowl", words, tokenizer=tokenizer)
    check_change(head, "span:embodied", words, tokenizer=None, site="cross")
    before, noise = models.preprocessor_of(case.policy), models.chunk_of(case.policy, seed=5)
    changed = {"span:actions": lambda: noise(before(dict(given)))}
    found = va.check_layout(head.policy, lambda: head.call(given), head.layout, changed, site="self")
    # Block 0 has mixed nothing but each action's own reading of the embodied tokens.
    assert found.fits, found


def test_contributions_are_what_the_blocks_add(case, head, tmp_path, tokenizer):
    layers = case.policy.model.qwen.model.model.language_model.layers
    blocks = case.policy.model.action_model.model.transformer_blocks

    def of_qwen(block):
        return (layers[block].input_layernorm, "given"), (layers[block].post_attention_layernorm, "given")

    def of_head(block):
        return (blocks[block].norm1, "given"), (blocks[block].norm2, "given")

    check_contributions(case, record(case, tmp_path / "qwen", tokenizer=tokenizer), "joint", of_qwen)
    store = record(head, tmp_path / "head", tokenizer=None)
    for site in ("cross", "self"):
        projection = "model.action_model.model.transformer_blocks.{block}.attn1.to_out.0"
        check_contributions(head, store, site, of_head, projection)


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path, tokenizer):
    cut = va.knockout("camera:wrist")
    rows = rows_of(record(case, tmp_path, replans=1, tokenizer=tokenizer, interventions=cut), "joint")
    wrist = case.layout.site("joint").keys.span("wrist")
    assert not rows[..., wrist.start : wrist.stop].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_the_total_effect_of_a_word_is_that_of_a_call_that_masks_its_token(case, tmp_path, tokenizer, monkeypatch):
    (bowl,) = tokenizer(" bowl")["input_ids"]
    qwen = case.policy.model.qwen
    own_inputs, own_places = qwen.build_inputs, qwen.model.model.get_rope_index

    def masked(**named):
        inputs = own_inputs(**named)
        inputs["attention_mask"] = inputs["attention_mask"].masked_fill(inputs["input_ids"] == bowl, 0)
        return inputs

    def places(ids, **named):
        return own_places(ids, **named | {"attention_mask": torch.ones_like(ids)})

    monkeypatch.setattr(qwen, "build_inputs", masked)
    # Qwen counts positions without masked tokens: here they stay where they were.
    monkeypatch.setattr(qwen.model.model, "get_rope_index", places)
    by_hand = case.call(case.observation)
    monkeypatch.undo()
    check_total_effect(case, tmp_path, tokenizer, "bowl", by_hand)


def test_the_analysis_answers_and_queries_of_zero_have_lift_1(case, head, tmp_path, tokenizer):
    record(case, tmp_path / "qwen", tokenizer=tokenizer)
    check_analysis(tmp_path / "qwen", ["joint"])
    record(head, tmp_path / "head", tokenizer=None)
    check_analysis(tmp_path / "head", ["cross", "self"], ratios=False)
    check_uniform_attention(case, tmp_path / "uniform", tokenizer=tokenizer)
    check_uniform_attention(head, tmp_path / "uniform_head", tokenizer=None)
