"""Our model against openpi's: attention of every layer and denoise step, and actions."""

import json

import numpy as np
import pytest
import torch
from pi_golden import GOLDEN, KeepAll

from capture.attention import AttentionRecorder, RecordingPlan
from capture.policies.pi.config import find_config
from capture.policies.pi.jax_weights import from_jax_flat
from capture.policies.pi.model import PiModel, denoise_times
from capture.policies.pi.strict import expected_shapes, model_from_state

LIMIT = 5e-5
_JUNK = "paligemma_with_expert.gemma_expert.lm_head.weight"
_TIED = "paligemma_with_expert.paligemma.lm_head.weight"
_TABLE = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"


def model_of(case, dtype=torch.float32):
    return model_from_state(case.config, from_jax_flat(case.weights, case.config), dtype=dtype)


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
    """pi0's state token comes first and must not be taken for an action."""
    config = golden_case.config
    keep = KeepAll()
    one = golden_case.single(0)
    model = model_of(one)
    one.sample(model, keep)
    plan = RecordingPlan(layers=(1, 0), denoise_steps=(0, 2), heads=(5, 2), queries="all", site="joint")
    recorder = AttentionRecorder(plan, config.key_len)
    one.sample(model, recorder)
    got = recorder.finish()
    assert got.rows.shape == (2, 2, 2, config.action_horizon, config.key_len)
    everything = keep.stacked()
    for i, layer in enumerate(plan.layers):
        for j, step in enumerate(plan.denoise_steps):
            expected = everything[step, layer, 0][[5, 2]][:, config.first_action_query :]
            np.testing.assert_array_equal(got.rows[i, j], expected)


@pytest.mark.parametrize(("name", "count"), [("pi05_libero", 812), ("pi0_libero", 777)])
def test_full_size_names_and_shapes_are_those_of_openpi(name, count):
    manifest = json.loads((GOLDEN / "key_manifests" / f"openpi_torch_{name}.json").read_text())
    assert len(manifest) == count
    shapes = {key: tuple(shape) for key, (shape, _) in manifest.items() if key != _JUNK}
    shapes[_TABLE] = shapes.pop(_TIED)
    assert expected_shapes(find_config(name)) == shapes


def test_bfloat16_placement_is_openpi_s():
    manifest = json.loads((GOLDEN / "key_manifests" / "openpi_torch_pi05_libero.json").read_text())
    with torch.device("meta"):
        model = PiModel(find_config("pi05_libero"), torch.bfloat16)
    placed = {name: str(tensor.dtype).removeprefix("torch.") for name, tensor in model.state_dict().items()}
    assert {name: dtype for name, dtype in placed.items() if name != _TABLE} == {
        name: dtype for name, (_, dtype) in manifest.items() if name not in (_JUNK, _TIED)
    }


def test_denoise_times_are_accumulated_in_float32():
    times = denoise_times(10)
    assert times.dtype == np.float32
    assert times[0] == 1.0
    assert times[2] == np.float32(0.79999995)
    np.testing.assert_allclose(times, np.arange(10, 0, -1) / 10, atol=1e-6)
