"""X-VLA of LeRobot: the real class with small random weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot", reason="run by make test-policies, in .venv-lerobot")

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
    roles_of,
    rows_of,
    softmax_rows,
)
from tests.policies.word_tokenizer import INSTRUCTION

CHUNK, HEADS, DIM, PATCHES, PADDING = 5, 4, 8, 4, 3
WORDS = len(INSTRUCTION.split())


@pytest.fixture(scope="module")
def case():
    policy = models.small_xvla(tokenizer_max_length=WORDS + PADDING)
    given = models.observation(64, 64, padding=PADDING)
    frames, state = models.frames_of(given), given["observation.state"]
    return PolicyCase(policy, va.layouts.xvla(policy), models.chunk_of(policy), given, frames, state)


def test_rows_are_those_of_the_policy_s_own_queries_and_keys(case, tmp_path):
    store = record(case, tmp_path)
    projections = [block.attn.qkv for block in case.policy.model.transformer.blocks]
    with kept_outputs(projections, lambda _module, _inputs, output: output[0]) as outputs:
        case.call(case.observation)

    def rows(qkv):
        query, key, _ = qkv.reshape(len(qkv), 3, HEADS, DIM).permute(1, 2, 0, 3)
        return softmax_rows(query[:, :CHUNK], key, DIM**-0.5)

    check_rows(store, "joint", np.array([[rows(step) for step in layer] for layer in outputs]))


def test_keys_have_the_roles_of_actions_views_words_and_soft_prompts(case, tmp_path):
    roles = roles_of(record(case, tmp_path), "joint")
    view = ["image"] * (1 + PATCHES)
    # The prompt's padding takes part in attention: it is text without a word.
    prompt = ["instruction"] * WORDS + ["template"] * PADDING
    assert roles == [*["action"] * CHUNK, *view, *prompt, *view, *["blank"] * (1 + PATCHES), *["learned"] * 3]


def test_further_views_and_the_state_reach_their_keys(case):
    wrist = {**case.observation, "observation.images.wrist": 1 - case.observation["observation.images.wrist"]}
    check_change(case, "span:wrist_mean | camera:wrist", wrist)
    # The state is part of every action token.
    check_change(case, "span:actions", {**case.observation, "observation.state": torch.zeros(1, 6)})
    # Florence 2's encoder mixes the first view and the words.
    top = {**case.observation, "observation.images.top": 1 - case.observation["observation.images.top"]}
    check_change(case, "span:top_mean | camera:top | span:prompt", top)


def test_contributions_are_what_the_blocks_add(case, tmp_path):
    blocks = case.policy.model.transformer.blocks

    def stream(block):
        return (blocks[block].norm1, "given"), (blocks[block].norm2, "given")

    check_contributions(case, record(case, tmp_path), "joint", stream, "model.transformer.blocks.{block}.attn.proj")


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path):
    rows = rows_of(record(case, tmp_path, replans=1, interventions=va.knockout("camera:wrist")), "joint")
    start = CHUNK + 1 + PATCHES + WORDS + PADDING + 1
    assert not rows[..., start : start + PATCHES].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_the_analysis_answers(case, tmp_path):
    record(case, tmp_path)
    check_analysis(tmp_path, ["joint"])


def test_queries_of_zero_have_lift_1(case, tmp_path):
    check_uniform_attention(case, tmp_path)
