"""pi0-FAST of LeRobot: the real class with small random weights.

The class asks for LeRobot's own transformers, which this environment does not have; that check is answered. What that
version changes (Gemma's norms for pi0.5, the scale of picture features) is not in the attention that is recorded here.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot", reason="run by make test-policies, in .venv-lerobot")

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.lerobot_pi_models import small_pi0_fast
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
)
from tests.policies.word_tokenizer import INSTRUCTION
from vla_attention.capture.torch_policies.replan_inputs import ReplanInputs
from vla_attention.capture.torch_policies.replan_text import PromptIds, ReplanText
from vla_attention.schemas.layout import Piece, Prompt, Role

PATCHES, TOKENS, PADDING, LAYERS = 16, 5, 3, 3
WORDS = len(INSTRUCTION.split())
PREFIX = 2 * PATCHES + WORDS + PADDING + 1


def case_of(**changes) -> PolicyCase:
    policy = small_pi0_fast(**changes)
    given = models.observation(56, 56, padding=PADDING)
    layout = va.layouts.pi0_fast(policy)
    return PolicyCase(
        policy, layout, models.chunk_of(policy), given, models.frames_of(given), given["observation.state"]
    )


@pytest.fixture(scope="module")
def case():
    return case_of()


def by_hand(case: PolicyCase) -> np.ndarray:
    """Rows (layer, denoise, head, token, key) of the same policy with eager attention."""
    model = case.policy.model.paligemma_with_expert.paligemma.model.language_model
    own = model.config._attn_implementation
    model.config._attn_implementation = "eager"
    try:
        layers = [layer.self_attn for layer in model.layers]
        with kept_outputs(layers, lambda _module, _inputs, output: output[1][0, :, -1].detach()) as weights:
            case.call(case.observation)
    finally:
        model.config._attn_implementation = own
    rows = np.zeros((LAYERS, 1, 4, TOKENS, PREFIX + TOKENS - 1), dtype=np.float32)
    for layer, tokens in enumerate(weights):
        for token, row in enumerate(tokens):
            rows[layer, 0, :, token, : row.shape[-1]] = row
    return rows


@pytest.mark.parametrize("cache", [True, False])
def test_rows_of_every_token_are_those_of_eager_attention(tmp_path, cache):
    case = case_of(use_kv_cache=cache)
    store = record(case, tmp_path)
    check_rows(store, "joint", by_hand(case))


def test_tokens_see_those_written_before_them_only(case, tmp_path):
    store = record(case, tmp_path)
    roles = roles_of(store, "joint")
    # The prompt ends with the BOS after its padding.
    prompt = ["instruction"] * WORDS + ["padding"] * PADDING + ["template"]
    assert roles == [*["image"] * (2 * PATCHES), *prompt, *["action"] * (TOKENS - 1)]
    later = np.triu(np.ones((TOKENS, TOKENS - 1), dtype=bool))
    rows = rows_of(store, "joint")[..., PREFIX:]
    assert not rows[..., later].any()
    assert (rows[..., ~later] > 0).all()
    assert store.attributes.sites[0].growing_span.name == "action_tokens"


@pytest.mark.parametrize("camera", models.CAMERAS)
def test_a_camera_s_picture_reaches_its_patches_and_no_others(case, camera):
    name = f"observation.images.{camera}"
    check_change(case, f"camera:{camera}", {**case.observation, name: 1 - case.observation[name]})


def test_contributions_are_what_the_layers_add(case, tmp_path):
    layers = case.policy.model.paligemma_with_expert.paligemma.model.language_model.layers

    def stream(block):
        return (layers[block].input_layernorm, "given"), (layers[block].post_attention_layernorm, "given")

    check_contributions(case, record(case, tmp_path), "joint", stream)


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path):
    rows = rows_of(record(case, tmp_path, replans=1, interventions=va.knockout("word:bowl")), "joint")
    assert not rows[..., 2 * PATCHES + INSTRUCTION.split().index("bowl")].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_the_analysis_answers_of_the_mean_and_of_all_tokens(case, tmp_path):
    for queries in ("mean", "all"):
        record(case, tmp_path / queries, queries=queries)
        check_analysis(tmp_path / queries, ["joint"])


def test_another_policy_is_refused_by_name():
    with pytest.raises(ValueError, match="for PI0FastPolicy"):
        va.layouts.pi0_fast(torch.nn.Linear(2, 2))


def test_the_state_s_digits_in_the_prompt_are_state(case):
    words = ["Task:", "put", "bowl,", "State:", "12", "7;", "Action:"]
    text, pieces = "", []
    for key, word in enumerate(words, 2 * PATCHES):
        pieces.append(Piece(key, f" {word}", len(text), len(text) + 1 + len(word)))
        text += f" {word}"
    start = text.index("put")
    prompt = Prompt(text, tuple(pieces), (start, start + len("put bowl")))
    site = case.layout.site("joint")
    text = ReplanText(case.layout, None, PromptIds({}, 1), {0: ReplanInputs(env_step=0)}, {})
    roles = [Role(int(code)).label for code in text.roles(0, site, prompt)]
    assert roles[2 * PATCHES :][: len(words)] == [
        *["template", "instruction", "instruction", "template"],
        *["state", "state", "template"],
    ]


def test_queries_of_zero_have_lift_1(case, tmp_path):
    check_uniform_attention(case, tmp_path)
