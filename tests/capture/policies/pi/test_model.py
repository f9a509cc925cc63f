"""Our model against openpi's: attention of every layer and denoise step, and actions."""

import dataclasses

import numpy as np
import torch

from tests.kit.pi_golden import read_manifest_dtypes
from tests.kit.policy_inputs import KeepAll
from vla_attention.capture.policies.pi.config import find_config
from vla_attention.capture.policies.pi.flow_time import denoise_times, embed_times
from vla_attention.capture.policies.pi.model import PiModel, model_from_state
from vla_attention.capture.recording.recorder import AttentionRecorder, RecordingPlan

LIMIT = 5e-5
_JUNK = "paligemma_with_expert.gemma_expert.lm_head.weight"
_TIED = "paligemma_with_expert.paligemma.lm_head.weight"
_TABLE = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"


def model_of(case, dtype=torch.float32):
    return model_from_state(case.config, case.weights, dtype=dtype)


def test_attention_and_actions_are_the_reference_s(golden_case):
    keep = KeepAll()
    actions = golden_case.sample(model_of(golden_case), keep)
    rows = keep.stacked()
    assert rows.dtype == np.float32
    assert rows.shape == golden_case.expected["attn"].shape
    np.testing.assert_allclose(rows, golden_case.expected["attn"], rtol=0, atol=LIMIT)
    np.testing.assert_allclose(actions, golden_case.expected["actions"], rtol=0, atol=LIMIT)


def test_a_sample_alone_is_the_same_as_in_a_batch(pi05_case):
    """Alone, invalid prefix tokens are left out of the computation."""
    for entry in range(2):
        keep = KeepAll()
        actions = pi05_case.single(entry).sample(model_of(pi05_case), keep)
        wanted = pi05_case.expected["attn"][:, :, entry : entry + 1]
        np.testing.assert_allclose(keep.stacked(), wanted, rtol=0, atol=LIMIT)
        np.testing.assert_allclose(actions[0], pi05_case.expected["actions"][entry], rtol=0, atol=LIMIT)


def test_masked_keys_get_exactly_nothing(golden_case):
    keep = KeepAll()
    golden_case.sample(model_of(golden_case), keep)
    rows, given = keep.stacked(), golden_case.inputs
    tokens = golden_case.config.siglip.num_tokens
    valid = np.concatenate(
        [np.repeat(given[f"image_mask_{camera}"][:, None], tokens, axis=1) for camera in golden_case.config.cameras]
        + [given["tokenized_prompt_mask"]],
        axis=1,
    )
    for entry, keys in enumerate(valid):
        assert (rows[:, :, entry][..., : len(keys)][..., ~keys] == 0).all()
    np.testing.assert_allclose(rows.sum(-1, dtype=np.float64), 1, atol=1e-5)


def test_recording_does_not_change_a_bit_of_the_actions(golden_case):
    for dtype in (torch.float32, torch.bfloat16):
        model = model_of(golden_case, dtype)
        np.testing.assert_array_equal(golden_case.sample(model), golden_case.sample(model, KeepAll()))


def test_bfloat16_stays_near_and_records_float32_rows_that_sum_to_one(golden_case):
    keep = KeepAll()
    actions = golden_case.sample(model_of(golden_case, torch.bfloat16), keep)
    rows = keep.stacked()
    assert rows.dtype == np.float32
    np.testing.assert_allclose(rows.sum(-1, dtype=np.float64), 1, atol=1e-5)
    # the reference's own bfloat16 moves attention by 0.03 to 0.05
    np.testing.assert_allclose(rows, golden_case.expected["attn"], rtol=0, atol=0.1)
    np.testing.assert_allclose(actions, golden_case.expected["actions"], rtol=0, atol=0.2)


def test_recorder_is_told_which_queries_are_actions(golden_case):
    """pi0's state token comes first and must not count as an action."""
    config = golden_case.config
    keep = KeepAll()
    one = golden_case.single(0)
    model = model_of(one)
    one.sample(model, keep)
    plan = RecordingPlan(layers=(1, 0), denoise_steps=(0, 2), heads=(5, 2), queries="all", site="joint")
    recorder = AttentionRecorder(plan, config.prefix_len + config.suffix_len)
    one.sample(model, recorder)
    got = recorder.finish()
    assert got.rows.shape == (2, 2, 2, config.action_horizon, config.prefix_len + config.suffix_len)
    everything = keep.stacked()
    for i, layer in enumerate(plan.layers):
        for j, step in enumerate(plan.denoise_steps):
            expected = everything[step, layer, 0][[5, 2]][:, config.first_action_query :]
            np.testing.assert_array_equal(got.rows[i, j], expected)


def test_bfloat16_placement_is_openpi_s():
    manifest = read_manifest_dtypes("openpi_torch_pi05_libero")
    with torch.device("meta"):
        model = PiModel(find_config("pi05_libero"), torch.bfloat16)
    placed = {name: str(tensor.dtype).removeprefix("torch.") for name, tensor in model.state_dict().items()}
    assert {name: dtype for name, dtype in placed.items() if name != _TABLE} == {
        name: dtype for name, dtype in manifest.items() if name not in (_JUNK, _TIED)
    }


def test_denoise_times_are_accumulated_in_float32():
    times = denoise_times(10)
    assert times.dtype == np.float32
    assert times[0] == 1.0
    assert times[2] == np.float32(0.79999995)
    np.testing.assert_allclose(times, np.arange(10, 0, -1) / 10, atol=1e-6)


def test_lerobot_steps_time_and_embeds_it_in_float64():
    times = denoise_times(10, "stepped")
    assert times.dtype == np.float32
    np.testing.assert_array_equal(times, np.float32(1.0 - np.arange(10) * 0.1))
    period = 4e-3 * 1000.0 ** np.linspace(0, 1, 8)
    angle = times.astype(np.float64)[:, None] * (1.0 / period * 2 * np.pi)
    wanted = np.concatenate([np.sin(angle), np.cos(angle)], axis=-1).astype(np.float32)
    np.testing.assert_allclose(embed_times(times, 16, "stepped").numpy(), wanted, rtol=0, atol=1e-7)
    assert np.abs(embed_times(times, 16).numpy() - wanted).max() > 1e-6


def test_the_two_conventions_of_time_differ_by_what_was_measured(pi05_case):
    """LeRobot's own code differs from the JAX numbers by 4.4e-5 on this case, as its convention does here."""
    keep = KeepAll()
    config = dataclasses.replace(pi05_case.config, time_convention="stepped")
    actions = pi05_case.sample(model_from_state(config, pi05_case.weights), keep)
    difference = np.abs(keep.stacked() - pi05_case.expected["attn"]).max()
    assert 2e-5 < difference < 1.5e-4
    np.testing.assert_allclose(actions, pi05_case.expected["actions"], rtol=0, atol=1.5e-4)


def test_lerobot_keeps_the_image_encoder_in_float32():
    with torch.device("meta"):
        model = PiModel(dataclasses.replace(find_config("pi05_libero"), float32_vision=True), torch.bfloat16)
    manifest = read_manifest_dtypes("lerobot_pi05")
    junk = {f"model.{name}" for name in (_JUNK, _TIED)}
    placed = {f"model.{name}": str(tensor.dtype).removeprefix("torch.") for name, tensor in model.state_dict().items()}
    assert placed == {name: dtype for name, dtype in manifest.items() if name not in junk}
