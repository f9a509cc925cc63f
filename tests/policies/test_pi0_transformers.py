"""pi0 of transformers 5: the real class with small random weights."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("transformers", minversion="5.6", reason="run by make test-policies, in .venv-transformers")

import torch

import vla_attention as va
from tests.policies.pi0_model import CAMERAS, CHUNK, LONGEST, PATCHES, inputs, small_pi0
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
from vla_attention.schemas.stores.reader import open_store


@pytest.fixture(scope="module")
def case() -> PolicyCase:
    policy = small_pi0()
    given = inputs()
    frames = {name: (given["pixel_values"][0, i] + 1) / 2 for i, name in enumerate(CAMERAS)}
    layout = va.layouts.pi0_transformers(policy, cameras=CAMERAS, prompt_tokens=LONGEST)
    return PolicyCase(policy, layout, lambda batch: policy.sample_actions(**batch), given, frames, given["state"])


def test_rows_are_those_of_the_model_run_with_eager_attention(case, tmp_path):
    store = record(case, tmp_path)
    eager = small_pi0("eager")
    layers = [layer.self_attn for layer in eager.model.dit.layers]
    with kept_outputs(layers, lambda _module, _inputs, output: output[1]) as weights:
        eager.sample_actions(**case.observation)
    expected = torch.stack([torch.stack([step[0] for step in layer]) for layer in weights])[..., -CHUNK:, :]
    check_rows(store, "joint", expected.detach().numpy())


def test_keys_have_the_roles_of_the_prompt_and_its_padding(case, tmp_path):
    store = record(case, tmp_path)
    words = len(INSTRUCTION.split())
    roles = roles_of(store, "joint")
    assert roles[: 2 * PATCHES] == ["image"] * (2 * PATCHES)
    assert roles[2 * PATCHES : -1 - CHUNK] == ["bos", *["instruction"] * words, "padding", "padding"]
    assert roles[-1 - CHUNK :] == ["state", *["action"] * CHUNK]
    assert [piece.text.strip() for piece in store.episodes[0].attributes.prompts[0].pieces] == INSTRUCTION.split()


def test_a_shorter_prompt_leaves_absent_keys(case, tmp_path):
    given = inputs(padding=0)
    store = record(PolicyCase(case.policy, case.layout, case.call, given), tmp_path)
    roles = roles_of(store, "joint")
    assert roles[2 * PATCHES :].count("absent") == LONGEST - 1 - len(INSTRUCTION.split())
    assert not rows_of(store, "joint")[..., [role == "absent" for role in roles]].any()


@pytest.mark.parametrize("number", [0, 1])
def test_a_camera_s_picture_reaches_its_keys_and_no_others(case, number):
    pictures = case.observation["pixel_values"].clone()
    pictures[:, number] = torch.rand(pictures[:, number].shape, generator=torch.Generator().manual_seed(9))
    check_change(case, f"camera:{CAMERAS[number]}", {**case.observation, "pixel_values": pictures})


def test_the_state_and_the_noise_reach_their_keys(case):
    check_change(case, "span:state", {**case.observation, "state": torch.zeros(1, 5)})
    check_change(case, "span:actions", {**case.observation, "noise": torch.zeros(1, CHUNK, 4)})


def test_a_word_reaches_its_key_and_no_others(case):
    check_change(case, "word:bowl", inputs(instruction=INSTRUCTION.replace("bowl", "plate")))


def test_contributions_are_what_the_layers_add(case, tmp_path):
    layers = case.policy.model.dit.layers

    def stream(block):
        return (layers[block].input_layernorm, "given"), (layers[block].post_attention_layernorm, "given")

    check_contributions(case, record(case, tmp_path), "joint", stream)


def test_a_knockout_takes_the_keys_mass_away_and_changes_actions(case, tmp_path):
    store = record(case, tmp_path, replans=1, interventions=va.knockout("word:bowl"))
    rows, roles = rows_of(store, "joint"), roles_of(store, "joint")
    bowl = 2 * PATCHES + 1 + INSTRUCTION.split().index("bowl")
    assert roles[bowl] == "instruction"
    assert not rows[..., bowl].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_a_batch_is_split_by_row(case, tmp_path):
    given = inputs(batch=2)
    given["state"][1] += 1
    with (
        va.record(tmp_path / "two.zarr", case.policy, layout=case.layout, bits=23, durable=False) as run,
        run.episodes(
            [{"task_id": 0, "episode_index": number, "instruction": INSTRUCTION} for number in range(2)]
        ) as episodes,
        episodes.replan(env_step=[0, 0]),
    ):
        case.policy.sample_actions(**given)
    store = va.open(tmp_path / "two.zarr")
    assert store.analyze()["steps_groups"].height > 0
    for number, episode in enumerate(open_store(tmp_path / "two.zarr").episodes):
        one = {name: value[number : number + 1] for name, value in given.items()}
        alone = record(
            PolicyCase(case.policy, case.layout, case.call, one),
            tmp_path / str(number),
            queries="mean",
            denoise_steps=("first", "last"),
            tokenizer=None,
        )
        np.testing.assert_allclose(episode.read("joint/rows")[0], rows_of(alone, "joint")[0], atol=2e-6)


def test_the_analysis_answers(case, tmp_path):
    record(case, tmp_path)
    check_analysis(tmp_path, ["joint"])


def test_another_policy_is_refused_by_name():
    with pytest.raises(ValueError, match="PI0ForConditionalGeneration, but a Linear was given"):
        va.layouts.pi0_transformers(torch.nn.Linear(2, 2))


def test_queries_of_zero_have_lift_1(case, tmp_path):
    check_uniform_attention(case, tmp_path)
