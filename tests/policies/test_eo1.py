"""EO-1 of LeRobot 0.6: the real class and processor, and a small Qwen 2.5 VL, with random weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot.policies.eo1", reason="LeRobot 0.6's, run by make test-policies in .venv-lerobot06")

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.lerobot_vlm_models import case_of, small_eo1
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
from vla_attention.capture.torch_policies.replan_text import KeysShifted
from vla_attention.schemas.errors import BadArgument

CHUNK, PATCHES, WORDS = 5, 12, len(INSTRUCTION.split())
#: Behind the task: "<|vla|><|im_end|>\n<|im_start|>assistant\n<|action_start|>"; keys more in the layout's prompt.
TEMPLATE, LONGER = 7, 2


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return small_eo1(tmp_path_factory.mktemp("qwen"))


@pytest.fixture(scope="module")
def before(policy):
    return models.preprocessor_of(policy)


@pytest.fixture(scope="module")
def tokenizer(before):
    return next(step for step in before.steps if hasattr(step, "_processor"))._processor.tokenizer


@pytest.fixture(scope="module")
def case(policy):
    longest = 1 + WORDS + TEMPLATE + LONGER
    return case_of(policy, lambda batch: va.layouts.eo1(policy, batch, prompt_tokens=longest))


def layers_of(case):
    return case.policy.model.vlm_backbone.model.language_model.layers


def test_inspect_finds_every_block_of_the_prefix_and_at_every_denoise_step(case):
    check_inspect(case, {r"language_model\.layers\.\d\.self_attn": 3 + 9})


def test_rows_are_those_of_the_policy_s_own_eager_softmax(case, tmp_path, tokenizer, monkeypatch):
    store = record(case, tmp_path, tokenizer=tokenizer)
    monkeypatch.setattr(case.policy.model.vlm_backbone.config.text_config, "_attn_implementation", "eager")
    attention = [layer.self_attn for layer in layers_of(case)]
    with kept_outputs(attention, lambda _module, _inputs, output: output[1][0].numpy()) as kept:
        case.call(case.observation)
    # The first call of each is the prefix's. The layout's longest prompt has keys that the call does not have.
    rows = np.array([block[1:] for block in kept])
    check_rows(store, "joint", np.insert(rows, [rows.shape[-1] - CHUNK] * LONGER, 0.0, axis=-1))


def test_keys_have_the_roles_of_pictures_words_and_the_state(case, tmp_path, tokenizer):
    roles = roles_of(record(case, tmp_path, tokenizer=tokenizer), "joint")
    views = [*["image"] * PATCHES, *["template"] * 2] * 2
    start = len(roles) - len(views) - 1 - case.layout.site("joint").keys.span("prompt").num_keys - CHUNK
    text = ["template", *["instruction"] * WORDS, *["template"] * TEMPLATE, *["absent"] * LONGER]
    assert roles == [*["template"] * start, *views, "state", *text, *["action"] * CHUNK]


def test_pictures_words_the_state_and_the_noise_reach_their_keys(case, before, tokenizer):
    given = case.observation
    for camera in models.CAMERAS:
        name = f"observation.images.{camera}"
        check_change(case, f"camera:{camera}", {**given, name: 1 - given[name]}, tokenizer=tokenizer)
    words = {**given, "task": [INSTRUCTION.replace("bowl", "robot")]}
    check_change(case, "word:bowl", words, tokenizer=tokenizer)
    check_change(case, "span:state", {**given, "observation.state": torch.zeros(1, 6)}, tokenizer=tokenizer)
    noise = models.chunk_of(case.policy, seed=5)
    changed = {"span:actions": lambda: noise(before(dict(given)))}
    found = va.check_layout(case.policy, lambda: case.call(given), case.layout, changed)
    assert found.fits, found


def test_contributions_are_what_the_blocks_add(case, tmp_path, tokenizer):
    layers = layers_of(case)

    def stream(block):
        return (layers[block].input_layernorm, "given"), (layers[block].post_attention_layernorm, "given")

    check_contributions(case, record(case, tmp_path, tokenizer=tokenizer), "joint", stream)


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path, tokenizer):
    cut = va.knockout("camera:wrist")
    rows = rows_of(record(case, tmp_path, replans=1, tokenizer=tokenizer, interventions=cut), "joint")
    wrist = case.layout.site("joint").keys.span("wrist")
    assert not rows[..., wrist.start : wrist.stop].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_the_total_effect_of_a_word_is_that_of_a_call_that_masks_its_token(
    case, tmp_path, tokenizer, before, monkeypatch
):
    (bowl,) = tokenizer(" bowl")["input_ids"]
    batch = before(dict(case.observation))
    masked = {**batch, "attention_mask": batch["attention_mask"].masked_fill(batch["input_ids"] == bowl, 0)}
    # Qwen counts positions without masked tokens: here they stay where they were.
    backbone = case.policy.model.vlm_backbone.model
    own = backbone.get_rope_index
    whole = {"attention_mask": batch["attention_mask"]}
    monkeypatch.setattr(backbone, "get_rope_index", lambda ids, **named: own(ids, **named | whole))
    by_hand = models.chunk_of(case.policy)(masked)
    monkeypatch.undo()
    check_total_effect(case, tmp_path, tokenizer, "bowl", by_hand)


def test_the_analysis_answers_and_queries_of_zero_have_lift_1(case, tmp_path, tokenizer):
    record(case, tmp_path, tokenizer=tokenizer)
    check_analysis(tmp_path, ["joint"])
    check_uniform_attention(case, tmp_path / "uniform", tokenizer=tokenizer)


def test_prompts_that_are_padded_on_the_left_are_refused(case, before, tmp_path, tokenizer):
    given = models.observation(24, 32, batch=2) | {"task": [INSTRUCTION, "put the bowl"]}
    facts = [{"task_id": row, "episode_index": 0, "instruction": task} for row, task in enumerate(given["task"])]
    with (
        va.record(tmp_path / "run.zarr", case.policy, layout=case.layout, tokenizer=tokenizer, durable=False) as run,
        pytest.raises(KeysShifted, match="row 1"),
        run.episodes(facts) as found,
        found.replan(env_step=0),
    ):
        case.call(given)


def test_a_batch_without_state_token_or_with_other_pictures_is_refused(case, before):
    batch = before(dict(case.observation))
    with pytest.raises(BadArgument, match="0 state tokens"):
        va.layouts.eo1(case.policy, {**batch, "state_token_id": -1})
    with pytest.raises(BadArgument, match="expected 6, 12 for the cameras"):
        va.layouts.eo1(case.policy, {**batch, "image_grid_thw": torch.tensor([[1, 4, 6], [1, 6, 8]])})
