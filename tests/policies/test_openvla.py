"""OpenVLA and OpenVLA-OFT on a stand-in of the same calls around transformers' Llama: not run on the real classes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("transformers", minversion="5.0", reason="run by make test-policies, in .venv-transformers")

import vla_attention as va
from tests.policies.openvla_stand_in import HEADS, LAYERS, PATCH, SIDE, OpenVLAForActionPrediction
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
from tests.policies.word_tokenizer import INSTRUCTION, WordTokenizer

PATCHES, DIMENSIONS, CHUNK, LONGEST = SIDE * SIDE, 7, 2, 9
WORDS = len(INSTRUCTION.split())


def picture(cameras: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(1, cameras, 3, SIDE * PATCH, SIDE * PATCH, generator=torch.Generator().manual_seed(seed))


def ids() -> torch.Tensor:
    return torch.tensor([[2, *WordTokenizer().encode(INSTRUCTION)]])


@pytest.fixture(scope="module")
def one() -> PolicyCase:
    policy = OpenVLAForActionPrediction()
    layout = va.layouts.openvla(policy, prompt_tokens=LONGEST, patches=PATCHES)
    given = {"ids": ids(), "pictures": picture(1)}
    return PolicyCase(
        policy,
        layout,
        lambda batch: policy.predict_action(**batch, dimensions=DIMENSIONS)[..., None].float(),
        given,
        {"image": given["pictures"][0, 0]},
    )


@pytest.fixture(scope="module")
def chunked() -> PolicyCase:
    policy = OpenVLAForActionPrediction()
    cameras = ("image", "wrist_image")
    layout = va.layouts.openvla_oft(policy, chunk=CHUNK, prompt_tokens=LONGEST, patches=PATCHES)
    given = {"ids": ids(), "pictures": picture(2), "state": torch.ones(1, 5)}
    return PolicyCase(
        policy,
        layout,
        lambda batch: policy.predict_chunk(**batch, count=DIMENSIONS * CHUNK),
        given,
        {name: given["pictures"][0, number] for number, name in enumerate(cameras)},
        given["state"],
    )


def eager_rows(case: PolicyCase, call) -> list[list[np.ndarray]]:
    """Weights (head, query, key) of each call of each layer, with transformers' eager attention."""
    eager = OpenVLAForActionPrediction("eager")
    layers = [layer.self_attn for layer in eager.language_model.model.layers]
    with kept_outputs(layers, lambda _module, _inputs, output: output[1][0].numpy()) as weights:
        call(eager)
    return weights


def test_one_row_for_each_action_token(one, tmp_path):
    store = record(one, tmp_path)
    weights = eager_rows(one, lambda policy: policy.predict_action(**one.observation, dimensions=DIMENSIONS))
    prefix, absent = 1 + PATCHES + WORDS, LONGEST - WORDS
    expected = np.zeros((LAYERS, 1, HEADS, DIMENSIONS, prefix + absent + DIMENSIONS - 1))
    for layer, calls in enumerate(weights):
        for token, rows in enumerate(calls):
            expected[layer, 0, :, token, :prefix] = rows[:, -1, :prefix]
            expected[layer, 0, :, token, prefix + absent : prefix + absent + token] = rows[:, -1, prefix:]
    check_rows(store, "joint", expected)
    words = ["instruction"] * WORDS + ["absent"] * absent
    assert roles_of(store, "joint") == ["bos", *["image"] * PATCHES, *words, *["action"] * (DIMENSIONS - 1)]


def test_the_chunk_s_queries_are_the_positions_before_its_placeholders(chunked, tmp_path):
    store = record(chunked, tmp_path)
    count, prefix, absent = DIMENSIONS * CHUNK, 2 + 2 * PATCHES + WORDS, LONGEST - WORDS
    weights = eager_rows(chunked, lambda policy: policy.predict_chunk(**chunked.observation, count=count))
    rows = np.stack([calls[0] for calls in weights])[:, None, :, prefix - 1 : prefix - 1 + count]
    check_rows(store, "joint", np.insert(rows, [prefix] * absent, 0.0, axis=-1))
    words = ["instruction"] * WORDS + ["absent"] * absent
    assert roles_of(store, "joint") == [
        *["bos", *["image"] * (2 * PATCHES), "state", *words],
        *[*["action"] * count, "template"],
    ]
    # The hidden states that the policy reads are those of these queries: the last block's values reach them alone.
    assert chunked.call(chunked.observation).shape[1] == rows.shape[3]


@pytest.mark.parametrize("camera", [0, 1])
def test_a_camera_s_picture_reaches_its_patches_and_no_others(chunked, camera):
    pictures = chunked.observation["pictures"].clone()
    pictures[:, camera] = 1 - pictures[:, camera]
    names = ["image", "wrist_image"]
    check_change(chunked, f"camera:{names[camera]}", {**chunked.observation, "pictures": pictures})


def test_the_state_reaches_its_key(chunked):
    check_change(chunked, "span:state", {**chunked.observation, "state": torch.zeros(1, 5)})


@pytest.mark.parametrize("name", ["one", "chunked"])
def test_a_word_reaches_its_key_and_no_others(name, request):
    case = request.getfixturevalue(name)
    exchanged = case.observation["ids"].clone()
    exchanged[exchanged == WordTokenizer().encode("bowl")[0]] = WordTokenizer().encode("plate")[0]
    check_change(case, "word:bowl", {**case.observation, "ids": exchanged})


@pytest.mark.parametrize("kind", ["one", "chunked"])
def test_contributions_are_what_the_layers_add(request, tmp_path, kind):
    case = request.getfixturevalue(kind)
    layers = case.policy.language_model.model.layers

    def stream(block):
        return (layers[block].input_layernorm, "given"), (layers[block].post_attention_layernorm, "given")

    check_contributions(case, record(case, tmp_path), "joint", stream)


@pytest.mark.parametrize("name", ["one", "chunked"])
def test_a_knockout_takes_the_keys_mass_away(name, request, tmp_path):
    rows = rows_of(
        record(request.getfixturevalue(name), tmp_path, replans=1, interventions=va.knockout("camera:image")), "joint"
    )
    assert not rows[..., 1 : 1 + PATCHES].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


@pytest.mark.parametrize("name", ["one", "chunked"])
def test_the_analysis_answers(name, request, tmp_path):
    record(request.getfixturevalue(name), tmp_path)
    check_analysis(tmp_path, ["joint"])


def test_a_number_of_patches_without_a_root_is_refused(one):
    with pytest.raises(ValueError, match="needs square pictures, but there are 250 patches"):
        va.layouts.openvla(one.policy, patches=250)


@pytest.mark.parametrize("name", ["one", "chunked"])
def test_queries_of_zero_have_lift_1(name, request, tmp_path):
    check_uniform_attention(request.getfixturevalue(name), tmp_path)
