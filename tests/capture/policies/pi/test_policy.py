"""The pi policy behind its interface: consistent layout, roles and tensors, and actions independent of recording."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from tests.kit.pi_golden import GOLDEN
from tests.kit.policy_inputs import assert_same_input
from vla_attention.capture.policies.checkpoints import CheckpointNotFound
from vla_attention.capture.policies.identity import PolicySource
from vla_attention.capture.policies.pi.config import find_config
from vla_attention.capture.policies.pi.embedded import DUMMY_CONFIG, build_random_model, builtin_stats
from vla_attention.capture.policies.pi.family import PiSettings
from vla_attention.capture.policies.pi.loading import load_pi_policy
from vla_attention.capture.policies.pi.policy import PiPolicy, site_layout
from vla_attention.capture.policies.pi.preprocess import resize_with_pad, turn
from vla_attention.capture.policies.pi.processing import openpi_processing
from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer, check_vocabulary
from vla_attention.capture.policies.sentencepiece_model import EMBEDDED_TOKENIZER
from vla_attention.capture.policies.weights import weights_digest
from vla_attention.capture.recording.recorder import AttentionRecorder, RecordingPlan
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.layout import Role

INSTRUCTION = "put the black bowl on the plate"


def plan_of(policy, queries="mean"):
    return RecordingPlan(
        layers=tuple(range(policy.num_layers)),
        denoise_steps=tuple(range(policy.num_denoise_steps)),
        heads=tuple(range(policy.num_heads)),
        queries=queries,
        site="joint",
    )


@pytest.fixture(scope="module")
def dummy_pi0():
    """pi0 of test size: a state token, z-scores, relative actions."""
    config = dataclasses.replace(DUMMY_CONFIG, pi05=False, discrete_state_input=False, max_token_len=48)
    return PiPolicy(
        build_random_model(config, 0),
        PromptTokenizer(EMBEDDED_TOKENIZER),
        openpi_processing(config, builtin_stats()),
        PolicySource("dummy-pi0", "random weights, seed 0", "seeded", untrained=True),
    )


@pytest.fixture(params=["dummy", "dummy_pi0"])
def policy(request):
    return request.getfixturevalue(request.param)


def test_full_size_layouts():
    layout = site_layout(find_config("pi05_libero"))
    spans = [(span.name, span.kind, span.start, span.stop) for span in layout.spans]
    assert spans == [
        ("base_0_rgb", "image", 0, 256),
        ("left_wrist_0_rgb", "image", 256, 512),
        ("right_wrist_0_rgb", "image", 512, 768),
        ("prompt", "text", 768, 968),
        ("actions", "action", 968, 978),
    ]
    (grid,) = layout.grids("left_wrist_0_rgb")
    assert (grid.rows, grid.columns, grid.image_height, grid.image_width) == (16, 16, 224, 224)
    pi0 = site_layout(find_config("pi0_libero"))
    assert [(s.name, s.start, s.stop) for s in pi0.spans[3:]] == [
        ("prompt", 768, 816),
        ("state", 816, 817),
        ("actions", 817, 867),
    ]


def test_frames_are_the_rotated_pictures_of_the_real_cameras(policy, observation):
    given = policy.prepare(observation, INSTRUCTION)
    size = policy.model.config.siglip.image_size
    assert list(given.frames) == [camera.name for camera in policy.cameras] == ["base_0_rgb", "left_wrist_0_rgb"]
    for camera in policy.cameras:
        assert camera.upright
        assert camera.mirrored
        expected = resize_with_pad(turn(observation.images[camera.source]), size)
        np.testing.assert_array_equal(given.frames[camera.name], expected)
        tensor = given.tensors[f"image:{camera.name}"]
        np.testing.assert_allclose((tensor[0].permute(1, 2, 0).numpy() + 1) * 127.5, expected, atol=1e-4)
    assert (given.tensors["image:right_wrist_0_rgb"] == -1).all()
    assert not given.tensors["image_mask:right_wrist_0_rgb"].any()


def test_what_a_call_was_given_gives_the_same_input_again(policy, observation):
    prepared = policy.prepare(observation, INSTRUCTION)
    assert not policy.needs_camera_frames
    assert not prepared.camera_frames
    assert_same_input(policy.prepare_again(prepared.given), prepared)


def test_a_changed_picture_and_no_words_reach_the_model(policy, observation):
    prepared = policy.prepare(observation, INSTRUCTION)
    grey = {**prepared.frames, "base_0_rgb": np.full_like(prepared.frames["base_0_rgb"], 51)}
    changed = policy.prepare_again(dataclasses.replace(prepared.given, frames=grey, instruction=""))
    assert torch.all(changed.tensors["image:base_0_rgb"] == torch.tensor(np.float32(51) / 255 * 2 - 1))
    assert torch.equal(changed.tensors["image:left_wrist_0_rgb"], prepared.tensors["image:left_wrist_0_rgb"])
    assert changed.prompt.instruction_text == ""
    assert Role.INSTRUCTION not in changed.key_role["joint"]
    assert np.isfinite(policy.act(changed, 3)).all()
    for empty in ("", "__"):
        with pytest.raises(BadArgument, match="empty"):
            policy.prepare(observation, empty)


def test_roles_agree_with_the_keys_that_get_attention(policy, observation):
    given = policy.prepare(observation, INSTRUCTION)
    [layout] = policy.sites
    assert given.key_role["joint"].shape == (layout.num_keys,)
    recorder = AttentionRecorder(plan_of(policy, "all"), layout.num_keys)
    policy.act(given, 0, {"joint": recorder})
    rows = recorder.finish().rows
    assert rows.shape[3] == policy.num_action_queries == policy.action_horizon
    invalid = np.isin(given.key_role["joint"], [Role.MASKED_IMAGE, Role.PADDING])
    assert (rows[..., invalid] == 0).all()
    assert (rows[..., ~invalid].max(axis=(0, 1, 2, 3)) > 0).all()
    np.testing.assert_allclose(recorder.finish().row_sum, 1, atol=1e-5)

    role = dict(zip(*np.unique(given.key_role["joint"], return_counts=True), strict=True))
    tokens = policy.model.config.siglip.num_tokens
    assert role[Role.IMAGE] == 2 * tokens
    assert role[Role.MASKED_IMAGE] == tokens
    assert role[Role.BOS] == 1
    assert role[Role.ACTION] == policy.action_horizon
    for piece in given.prompt.pieces:
        inside = given.prompt.instruction[0] <= piece.start < given.prompt.instruction[1]
        assert (given.key_role["joint"][piece.key] == Role.INSTRUCTION) == inside or piece.text.startswith("▁")


def test_pi0_has_one_state_key_and_pi05_states_it_in_the_prompt(dummy, dummy_pi0, embedded, observation):
    pi0 = dummy_pi0.prepare(observation, INSTRUCTION)
    span = dummy_pi0.sites[0].span("state")
    assert np.flatnonzero(pi0.key_role["joint"] == Role.STATE).tolist() == [span.start]
    digits = dummy.prepare(observation, INSTRUCTION)
    assert (digits.key_role["joint"] == Role.STATE).sum() > 8
    assert ", State: " in digits.prompt.text
    assert not (embedded.prepare(observation, INSTRUCTION).key_role["joint"] == Role.STATE).any()


def test_recording_does_not_change_a_bit_of_the_actions(policy, observation):
    given = policy.prepare(observation, INSTRUCTION)
    plain = policy.act(given, 7)
    recorder = AttentionRecorder(plan_of(policy), policy.sites[0].num_keys)
    np.testing.assert_array_equal(policy.act(given, 7, {"joint": recorder}), plain)
    assert plain.shape == (policy.action_horizon, 7)
    assert plain.dtype == np.float64
    assert np.isfinite(plain).all()


def test_relative_actions_move_with_the_state(dummy_pi0, observation):
    given = dummy_pi0.prepare(observation, INSTRUCTION)
    moved = dataclasses.replace(given, state=given.state + 1.0)  # the model still sees the old state
    difference = dummy_pi0.act(moved, 0) - dummy_pi0.act(given, 0)
    np.testing.assert_allclose(difference, np.tile([1, 1, 1, 1, 1, 1, 0], (4, 1)), atol=1e-9)


def test_digest_sees_a_single_changed_weight_and_handles_bfloat16():
    one = build_random_model(DUMMY_CONFIG, 0)
    before = weights_digest(one)
    one.action_in_proj.weight[0, 0] += 1e-6
    assert weights_digest(one) != before
    assert len(weights_digest(one.bfloat16())) == 64


def test_a_tokenizer_of_another_full_size_model_is_refused(dummy):
    """Llama's 32000 pieces fit into PaliGemma's table, but with other words."""

    class Pieces:
        def __init__(self, count):
            self.vocab_size = count

    for count in (256_000, 257_152):
        check_vocabulary(Pieces(count), 257_152, "pi05")
    for count in (32_000, 300_000):
        with pytest.raises(BadArgument, match=rf"{count} pieces"):
            check_vocabulary(Pieces(count), 257_152, "pi05")


def test_a_cut_prompt_is_reported_once_and_stays_visible(dummy, observation, capsys):
    config = dataclasses.replace(DUMMY_CONFIG, max_token_len=12)
    policy = PiPolicy(build_random_model(config, 0), dummy.tokenizer, dummy.processing, dummy.source)
    for _ in range(2):
        given = policy.prepare(observation, INSTRUCTION)
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "12 slots" in said
    assert len(given.prompt.pieces) == 11
    assert given.prompt.text.endswith(";\nAction: ")
    assert given.prompt.pieces[-1].stop < len(given.prompt.text)
    assert policy.identity().config["long_prompts"] == "cut"
    assert np.isfinite(policy.act(given, 0)).all()


def test_policy_from_a_checkpoint_folder(tmp_path, observation):
    config = dataclasses.replace(DUMMY_CONFIG, discrete_state_input=False)
    model = build_random_model(config, 4)
    save_file(dict(model.state_dict()), tmp_path / "model.safetensors")
    sizes = {**dataclasses.asdict(config), "num_steps": config.num_denoise_steps}
    (tmp_path / "config.json").write_text(json.dumps({"model": "pi05", "config": sizes}))
    stats = tmp_path / "assets" / "physical-intelligence" / "libero" / "norm_stats.json"
    stats.parent.mkdir(parents=True)
    stats.write_text((GOLDEN / "libero_preproc" / "norm_stats.json").read_text())
    policy = load_pi_policy(PiSettings(str(tmp_path), tokenizer=str(EMBEDDED_TOKENIZER)))
    assert policy.identity().digest == weights_digest(model)
    assert policy.identity().untrained is False
    assert policy.name == "pi05"
    assert np.isfinite(policy.act(policy.prepare(observation, INSTRUCTION), 0)).all()
    with pytest.raises(CheckpointNotFound):
        load_pi_policy(PiSettings(str(tmp_path), tokenizer=str(tmp_path / "none.model")))
