"""WALL-X of LeRobot 0.6: the real class on a small Qwen 2.5 VL with two experts and random weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot", reason="LeRobot 0.6's, run by make test-policies in .venv-lerobot06")

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.lerobot_vlm_models import case_of, small_wall_x
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
)
from tests.policies.word_tokenizer import INSTRUCTION
from vla_attention.capture.torch_policies.layouts.layout_building import NotThisPolicy

pytestmark = pytest.mark.skipif(not models.IS_06, reason="the class of LeRobot 0.6, in .venv-lerobot06")

CHUNK, PATCHES, STEPS, WORDS = 5, 9, 10, len(INSTRUCTION.split())
#: Around the task: from "<|vision_end|>\nInstruction:", and to the state; keys more in the layout's prompt.
BEFORE, AFTER, LONGER = 6, 13, 2


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return small_wall_x(tmp_path_factory.mktemp("qwen"))


@pytest.fixture(scope="module")
def tokenizer(policy):
    return policy.model.processor.tokenizer


@pytest.fixture(scope="module")
def case(policy):
    longest = BEFORE + WORDS + AFTER + LONGER
    return case_of(policy, lambda batch: va.layouts.wall_x(policy, batch, prompt_tokens=longest))


def test_inspect_finds_every_block_at_every_denoise_step(case):
    check_inspect(case, {r"^model\.model\.layers\.\d\.self_attn": 3 * STEPS})


def test_rows_are_those_of_the_policy_s_own_eager_softmax(case, tmp_path, tokenizer):
    store = record(case, tmp_path, tokenizer=tokenizer)
    attention = [layer.self_attn for layer in case.policy.model.model.layers]
    with kept_outputs(attention, lambda _module, _inputs, output: output[1][0, :, -CHUNK:].numpy()) as kept:
        case.call(case.observation)
    # The layout's longest prompt has keys that the call does not have.
    end = case.layout.site("joint").keys.span("prompt").stop - LONGER
    check_rows(store, "joint", np.insert(np.array(kept), [end] * LONGER, 0.0, axis=-1))


def test_keys_have_the_roles_of_pictures_words_and_the_state(case, tmp_path, tokenizer):
    roles = roles_of(record(case, tmp_path, tokenizer=tokenizer), "joint")
    spans = {span.name: roles[span.start : span.stop] for span in case.layout.site("joint").keys.spans}
    prompt = [*["template"] * BEFORE, *["instruction"] * WORDS, *["template"] * AFTER, *["absent"] * LONGER]
    assert (spans.pop("prompt"), spans.pop("state"), spans.pop("actions")) == (prompt, ["state"], ["action"] * CHUNK)
    assert (spans.pop("top"), spans.pop("wrist")) == (["image"] * PATCHES,) * 2
    assert {role for of_span in spans.values() for role in of_span} == {"template"}


def test_pictures_words_the_state_and_the_noise_reach_their_keys(case, tokenizer):
    given = case.observation
    for camera in models.CAMERAS:
        name = f"observation.images.{camera}"
        check_change(case, f"camera:{camera}", {**given, name: 1 - given[name]}, tokenizer=tokenizer)
    words = {**given, "task": [INSTRUCTION.replace("bowl", "robot")]}
    check_change(case, "word:bowl", words, tokenizer=tokenizer)
    check_change(case, "span:state", {**given, "observation.state": torch.zeros(1, 6)}, tokenizer=tokenizer)
    noise, before = models.chunk_of(case.policy, seed=5), models.preprocessor_of(case.policy)
    changed = {"span:actions": lambda: noise(before(dict(given)))}
    found = va.check_layout(case.policy, lambda: case.call(given), case.layout, changed)
    assert found.fits, found


def test_contributions_are_what_the_blocks_add(case, tmp_path, tokenizer):
    layers = case.policy.model.model.layers

    def stream(block):
        return (layers[block].input_layernorm, "given"), (layers[block].post_attention_layernorm, "given")

    check_contributions(case, record(case, tmp_path, tokenizer=tokenizer), "joint", stream)


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path, tokenizer):
    cut = va.knockout("camera:wrist")
    rows = rows_of(record(case, tmp_path, replans=1, tokenizer=tokenizer, interventions=cut), "joint")
    wrist = case.layout.site("joint").keys.span("wrist")
    assert not rows[..., wrist.start : wrist.stop].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_the_total_effect_of_a_word_is_that_of_a_call_that_masks_its_token(case, tmp_path, tokenizer, monkeypatch):
    (bowl,) = tokenizer(" bowl")["input_ids"]
    model = case.policy.model
    own_inputs, own_places = case.policy.preprocess_inputs, model.get_rope_index

    def masked(batch):
        inputs = own_inputs(batch)
        inputs["attention_mask"] = inputs["attention_mask"].masked_fill(inputs["input_ids"] == bowl, 0)
        return inputs

    monkeypatch.setattr(case.policy, "preprocess_inputs", masked)
    # Qwen counts positions without masked tokens: here they stay where they were.
    monkeypatch.setattr(model, "get_rope_index", lambda *given: own_places(*given[:-1], torch.ones_like(given[-1])))
    by_hand = case.call(case.observation)
    monkeypatch.undo()
    check_total_effect(case, tmp_path, tokenizer, "bowl", by_hand)


def test_the_analysis_answers_and_queries_of_zero_have_lift_1(case, tmp_path, tokenizer):
    record(case, tmp_path, tokenizer=tokenizer)
    check_analysis(tmp_path, ["joint"])
    check_uniform_attention(case, tmp_path / "uniform", tokenizer=tokenizer)


def test_what_the_layout_cannot_cover_is_refused(case, monkeypatch):
    for name, value in (("prediction_mode", "fast"), ("vision_attn_implementation", "auto")):
        monkeypatch.setattr(case.policy.config, name, value)
        with pytest.raises(NotThisPolicy, match=f"This WALL-X has {name}='{value}'"):
            va.layouts.wall_x(case.policy, case.observation)
        monkeypatch.undo()
