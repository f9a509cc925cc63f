"""LeRobot checkpoints: settings from their files, refused features, and preprocessing against LeRobot's numbers."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.kit.pi_golden import GOLDEN
from tests.kit.policy_inputs import assert_same_input, make_observation
from tests.kit.small_tokenizer import train_small_tokenizer
from vla_attention.capture.policies.checkpoints import CheckpointMismatch, UnreadableCheckpoint, UnsupportedCheckpoint
from vla_attention.capture.policies.pi.family import PiSettings
from vla_attention.capture.policies.pi.lerobot import lerobot_image
from vla_attention.capture.policies.pi.lerobot_config import read_lerobot_config
from vla_attention.capture.policies.pi.lerobot_pipeline import lerobot_normaliser, read_lerobot_pipeline
from vla_attention.capture.policies.pi.loading import load_pi_policy
from vla_attention.capture.policies.pi.preprocess import libero_state, turn
from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer, digitise_state
from vla_attention.capture.policies.policy import Policy
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.layout import Role

FOLDER = GOLDEN / "lerobot_preproc"
CASE = json.loads((FOLDER / "case.json").read_text())
TEXT = {name: text for entry in CASE["text"] for name, [text] in entry.items()}
MODES = {"MEAN_STD": "meanstd", "QUANTILES": "quantiles"}
INSTRUCTION = "put the black bowl on the plate"


@pytest.fixture(scope="module")
def tokenizer_path(tmp_path_factory):
    return train_small_tokenizer(tmp_path_factory.mktemp("tokenizer") / "small.model")


@pytest.fixture(params=["pi05_batch2", "pi0_batch2"])
def checkpoint(tmp_path, request):
    """A copy of a golden checkpoint, with the case.json beside it that states its odd sizes."""
    shutil.copytree(GOLDEN / request.param / "checkpoint_lerobot", tmp_path / "checkpoint")
    shutil.copy(GOLDEN / request.param / "case.json", tmp_path)
    return tmp_path / "checkpoint"


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


# --- preprocessing, number by number


@pytest.fixture(scope="module")
def inputs():
    return dict(np.load(FOLDER / "inputs.npz"))


@pytest.fixture(scope="module")
def expected():
    return dict(np.load(FOLDER / "expected.npz"))


def normaliser(mode, feature):
    statistics = {name: np.float32(values) for name, values in CASE["stats"][feature].items()}
    return lerobot_normaliser(mode, statistics, 1e-8, 0)


def state_of(inputs):
    names = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")
    return libero_state(*(inputs[name][0] for name in names))


def test_images(inputs, expected):
    got = lerobot_image(turn(inputs["agentview_image"][0]), 224)
    assert got.dtype == torch.float32
    assert np.abs(got.numpy() - expected["image_slot0"]).max() <= 2 / 255
    # in fact it is the same arithmetic, in float32
    np.testing.assert_allclose(got.numpy(), expected["image_slot0"], rtol=0, atol=1e-5)


def test_images_that_are_not_square_are_padded_and_those_of_the_right_size_kept():
    wide = lerobot_image(np.full((100, 200, 3), 255, dtype=np.uint8), 50)
    assert (wide[:, :, 12:37] == 1).all()
    assert (wide[:, :, :12] == -1).all()
    assert (wide[:, :, 37:] == -1).all()
    same = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    np.testing.assert_allclose((lerobot_image(same, 4)[0].permute(1, 2, 0) + 1) * 127.5, same, atol=1e-4)


@pytest.mark.parametrize("mode", MODES)
def test_numbers(inputs, expected, mode):
    state = state_of(inputs)
    np.testing.assert_allclose(state, expected["state8"][0], rtol=0, atol=1e-6)
    got = normaliser(mode, "observation.state").normalise(state)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, expected[f"state_{MODES[mode]}"][0], rtol=0, atol=1e-6)
    actions = normaliser(mode, "action").unnormalise(inputs["model_actions"])
    np.testing.assert_allclose(actions, expected[f"actions_{MODES[mode]}"], rtol=0, atol=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_prompts_with_state(inputs, mode, tokenizer_path):
    state = normaliser(mode, "observation.state").normalise(state_of(inputs))
    tokenizer = PromptTokenizer(tokenizer_path)
    got = tokenizer.tokenize(
        CASE["prompts"][0], max_token_len=200, state=state, prompt_format="task-state-action", cut=True
    )
    assert got.prompt.text == TEXT[MODES[mode]]
    assert " ".join(map(str, digitise_state(state))) in TEXT[MODES[mode]]


def test_pi0_prompt(tokenizer_path):
    tokenizer = PromptTokenizer(tokenizer_path)
    for task in (CASE["prompts"][0], CASE["prompts"][0] + "\n"):
        got = tokenizer.tokenize(task, max_token_len=48, prompt_format="raw-instruction-newline")
        assert got.prompt.text == TEXT["pi0_newline"]
        assert got.prompt.instruction_text == CASE["prompts"][0]
        assert got.roles[got.mask][-1] == Role.TEMPLATE
    # neither stripped nor cleaned, and encoded as one string
    raw = tokenizer.tokenize("  put_the bowl ", max_token_len=48, prompt_format="raw-instruction-newline")
    assert raw.prompt.text == "  put_the bowl \n"
    assert tokenizer.tokenize("put", max_token_len=48, prompt_format="raw-instruction").prompt.text == "put"


def test_ranges_of_zero_count_as_eps():
    statistics = {"q01": np.float32([1, 0]), "q99": np.float32([1, 2])}
    got = lerobot_normaliser("QUANTILES", statistics, 1e-8, 2).normalise(np.array([1.0, 1.0]))
    assert got.tolist() == [-1.0, 0.0]
    np.testing.assert_array_equal(lerobot_normaliser("IDENTITY", {}, 1e-8, 2).normalise(np.ones(2)), np.ones(2))


# --- the whole policy


def typed(policy) -> Policy:
    return policy


def load(checkpoint, tokenizer, **settings):
    return load_pi_policy(PiSettings(str(checkpoint), tokenizer=str(tokenizer), **settings))


def test_the_files_decide_everything(checkpoint, tokenizer_path):
    policy = typed(load(checkpoint, tokenizer_path))
    pi05 = policy.name == "pi05"
    config = policy.model.config
    assert config.cameras == ("image", "image2", "empty_camera_0")
    assert [(camera.name, camera.source) for camera in policy.cameras] == [
        ("image", "agentview"),
        ("image2", "robot0_eye_in_hand"),
    ]
    assert (policy.action_horizon, policy.default_replan_steps) == ((6, 5) if pi05 else (7, 5))
    assert (config.max_token_len, config.num_denoise_steps) == ((24, 10) if pi05 else (16, 5))
    assert config.time_convention == "stepped"
    identity = policy.identity()
    assert identity.checkpoint_format == "lerobot"
    facts = identity.config
    assert facts["normalisation"] == "state {0}, action {0}".format("QUANTILES" if pi05 else "MEAN_STD")
    assert facts["prompt_format"] == ("task-state-action" if pi05 else "raw-instruction-newline")
    assert facts["configuration"] == "case.json beside the checkpoint"

    given = policy.prepare(make_observation(1), INSTRUCTION)
    assert given.frames["image"].shape == (56, 56, 3)
    assert (
        np.abs(given.tensors["image:image"].numpy() * 127.5 + 127.5 - given.frames["image"].transpose(2, 0, 1)).max()
        < 0.51
    )
    assert (given.tensors["image:empty_camera_0"] == -1).all()
    assert not given.tensors["image_mask:empty_camera_0"].any()
    actions = policy.act(given, 0)
    assert actions.shape == (policy.action_horizon, 7)
    assert np.isfinite(actions).all()


def test_the_cameras_own_pictures_give_the_same_input_again(checkpoint, tokenizer_path):
    """Pictures that were rounded for the store would not: the model's image was resized in floating point."""
    policy = load(checkpoint, tokenizer_path)
    observation = make_observation(0)
    prepared = policy.prepare(observation, INSTRUCTION)
    assert policy.needs_camera_frames
    assert prepared.camera_frames.keys() == prepared.frames.keys()
    assert_same_input(policy.prepare_again(prepared.given), prepared)
    rounded = policy.prepare_again(dataclasses.replace(prepared.given, camera_frames={}))
    for camera in policy.cameras:
        np.testing.assert_array_equal(prepared.camera_frames[camera.name], observation.images[camera.source])
        difference = rounded.tensors[f"image:{camera.name}"] - prepared.tensors[f"image:{camera.name}"]
        assert 0 < difference.abs().max() <= 1.001 / 255


def test_renamed_cameras_and_empty_cameras_that_only_a_number_states(checkpoint, tokenizer_path):
    def change(config):
        features = config["input_features"]
        for name in ("image", "image2", "empty_camera_0"):
            feature = features.pop(f"observation.images.{name}")
        features |= {"observation.images.top": feature, "observation.images.wrist": feature}
        config["empty_cameras"] = 1

    edit(checkpoint / "config.json", change)
    with pytest.raises(BadArgument, match=r"top, wrist.*agentview, .*--camera"):
        load(checkpoint, tokenizer_path)
    names = {"observation.images.image": "observation.images.wrist"}
    step = {"registry_name": "rename_observations_processor", "config": {"rename_map": names}}
    edit(checkpoint / "policy_preprocessor.json", lambda content: content["steps"].__setitem__(0, step))
    policy = load(checkpoint, tokenizer_path)
    assert policy.model.config.cameras == ("wrist", "top", "empty_camera_0")
    assert [camera.source for camera in policy.cameras] == ["agentview"]


def test_weights_without_prefix_and_without_embed_tokens(checkpoint, tokenizer_path):
    whole = load(checkpoint, tokenizer_path).identity().digest
    tensors = load_file(checkpoint / "model.safetensors")
    table = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
    older = {name.removeprefix("model."): tensor for name, tensor in tensors.items()}
    older["paligemma_with_expert.paligemma.lm_head.weight"] = older.pop(table)
    save_file(older, checkpoint / "model.safetensors")
    assert load(checkpoint, tokenizer_path).identity().digest == whole


# --- refusals


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"use_relative_actions": True}, "use_relative_actions True"),
        ({"rtc_config": {"enabled": True}}, "rtc_config {'enabled': True}"),
        ({"n_action_steps": 51}, "n_action_steps 51.* chunk_size"),
        ({"dtype": "float16"}, "float32 .*bfloat16"),
        ({"output_features": {"action": {"type": "ACTION", "shape": [14]}}}, "\\b14 "),
    ],
)
def test_unsupported_features_are_refused_by_name(checkpoint, tokenizer_path, change, named):
    edit(checkpoint / "config.json", lambda content: content.update(change))
    if "output_features" in change:  # statistics are checked first: leave them out of it
        for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
            edit(checkpoint / name, lambda c: [s["config"].update(norm_map={"ACTION": "IDENTITY"}) for s in c["steps"]])
    with pytest.raises((UnsupportedCheckpoint, CheckpointMismatch), match=named) as caught:
        load(checkpoint, tokenizer_path)
    assert isinstance(caught.value, UserError)
    assert "\n" not in str(caught.value)


def step_of(content, name):
    return next(step for step in content["steps"] if step["registry_name"] == name)


@pytest.mark.parametrize(
    ("file", "change", "named"),
    [
        ("pre", lambda c: c["steps"].append({"registry_name": "crop_processor"}), "'crop_processor'"),
        ("pre", lambda c: c["steps"].append(step_of(c, "tokenizer_processor")), "tokenizer_processor"),
        ("pre", lambda c: step_of(c, "relative_actions_processor")["config"].update(enabled=True), "relative"),
        ("pre", lambda c: step_of(c, "tokenizer_processor")["config"].update(padding_side="left"), "padding_side"),
        ("pre", lambda c: step_of(c, "normalizer_processor")["config"]["norm_map"].update(STATE="MIN_MAX"), "MIN_MAX"),
        ("pre", lambda c: step_of(c, "normalizer_processor")["config"]["norm_map"].update(VISUAL="MEAN_STD"), "images"),
    ],
)  # fmt: skip
def test_unsupported_pipelines_are_refused_by_name(checkpoint, file, change, named):
    edit(checkpoint / f"policy_{file}processor.json", change)
    config = read_lerobot_config(checkpoint)

    with pytest.raises(UserError, match=named):
        read_lerobot_pipeline(checkpoint, config)


def test_missing_damaged_and_misshapen_statistics(checkpoint):
    config = read_lerobot_config(checkpoint)
    [state_file] = checkpoint.glob("policy_preprocessor_step_*.safetensors")
    key = "observation.state.q01" if config.pi05 else "observation.state.mean"
    tensors = load_file(state_file)
    save_file({**tensors, key: tensors[key][:7].clone()}, state_file)
    with pytest.raises(UnreadableCheckpoint, match=rf"{key}' .*\(7,\).* 8 "):
        read_lerobot_pipeline(checkpoint, config)
    state_file.unlink()
    with pytest.raises(UnreadableCheckpoint):
        read_lerobot_pipeline(checkpoint, config)


def test_statistics_of_a_data_set(checkpoint, tmp_path):
    """Where the checkpoint has none, as those have that are to be trained further."""
    config, stats = read_lerobot_config(checkpoint), {}
    own = read_lerobot_pipeline(checkpoint, config)
    for state_file in checkpoint.glob("policy_*_step_*.safetensors"):
        for name, values in load_file(state_file).items():
            feature, _, key = name.rpartition(".")
            stats.setdefault(feature, {})[key] = values.tolist()
        state_file.unlink()
    for name in ("pre", "post"):
        edit(checkpoint / f"policy_{name}processor.json", lambda c: [s.pop("state_file", None) for s in c["steps"]])
    with pytest.raises(UnreadableCheckpoint, match=r"policy_preprocessor\.json' .*--norm-stats FILE"):
        read_lerobot_pipeline(checkpoint, config)
    given = tmp_path / "stats.json"
    given.write_text(json.dumps(stats))
    read = read_lerobot_pipeline(checkpoint, config, given)
    for mine, its in ((read.state, own.state), (read.action, own.action)):
        assert mine.mode == its.mode
        for name in ("offset", "divisor", "factor"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(its, name))
    for wrong in ([1.0], None, "text", [[1.0], [2.0, 3.0]], [float("nan")] * config.state_dim):
        given.write_text(json.dumps(stats | {"observation.state": dict.fromkeys(stats["observation.state"], wrong)}))
        with pytest.raises(UnreadableCheckpoint, match=r"stats\.json"):
            read_lerobot_pipeline(checkpoint, config, given)
    given.write_text(json.dumps({"action": stats["action"]}))
    with pytest.raises(UnreadableCheckpoint, match=r"observation\.state"):
        read_lerobot_pipeline(checkpoint, config, given)


def test_the_type_must_be_that_of_the_tensors(checkpoint, tokenizer_path):
    pi05 = read_lerobot_config(checkpoint).pi05
    other = GOLDEN / ("pi0_batch2" if pi05 else "pi05_batch2") / "checkpoint_lerobot" / "model.safetensors"
    shutil.copy(other, checkpoint / "model.safetensors")
    with pytest.raises(CheckpointMismatch, match=r"pi0\b"):
        load(checkpoint, tokenizer_path)


def test_sizes_that_only_a_case_file_states(checkpoint, tokenizer_path, tmp_path):
    (tmp_path / "case.json").rename(tmp_path / "sizes.json")
    with pytest.raises(CheckpointMismatch, match=r"--model-config PATH .*case\.json"):
        load(checkpoint, tokenizer_path)
    assert (
        load(checkpoint, tokenizer_path, model_config=tmp_path / "sizes.json")
        .identity()
        .config["configuration"]
        .endswith("sizes.json")
    )
    contradiction = {"config_name": "pi05_libero", "model_config": tmp_path / "sizes.json"}
    with pytest.raises(BadArgument):
        load(checkpoint, tokenizer_path, **contradiction)
