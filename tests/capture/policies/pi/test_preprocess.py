"""openpi's LIBERO preprocessing, number by number against what openpi computed."""

import json

import numpy as np
import pytest
from PIL import Image

from tests.kit.pi_golden import GOLDEN
from vla_attention.capture.policies.checkpoints import CheckpointNotFound, UnreadableCheckpoint
from vla_attention.capture.policies.pi.config import find_config
from vla_attention.capture.policies.pi.lerobot import lerobot_pictures
from vla_attention.capture.policies.pi.preprocess import (
    NormStats,
    Statistics,
    axis_angle,
    libero_state,
    pad_to,
    parse_norm_stats,
    read_norm_stats,
    resize_with_pad,
    turn,
)
from vla_attention.capture.policies.pi.processing import openpi_processing, simulated_arm
from vla_attention.capture.policies.pi.tokenizer import digitise_state
from vla_attention.capture.torch_policies.replan_inputs import model_picture
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.fitted_pictures import fitted_part
from vla_attention.schemas.layout import PatchGrid

FOLDER = GOLDEN / "libero_preproc"
MODES = {"z-score": "z", "quantile": "q"}


@pytest.fixture(scope="module")
def inputs():
    return dict(np.load(FOLDER / "inputs.npz"))


@pytest.fixture(scope="module")
def expected():
    return dict(np.load(FOLDER / "expected.npz"))


@pytest.fixture(scope="module")
def stats():
    return parse_norm_stats(json.loads((FOLDER / "norm_stats.json").read_text()), "golden")


@pytest.mark.parametrize(("camera", "name"), [("agentview_image", "base"), ("robot0_eye_in_hand_image", "wrist")])
def test_images_are_rotated_and_resized_within_one_grey_level(inputs, expected, camera, name):
    for frame, wanted in zip(inputs[camera], expected[name], strict=True):
        got = resize_with_pad(turn(frame), 224)
        assert got.dtype == np.uint8
        assert np.abs(got.astype(int) - wanted.astype(int)).max() <= 1


@pytest.mark.parametrize("shape", [(480, 640), (720, 1280), (640, 480), (64, 96), (100, 333), (224, 224), (256, 256)])
def test_what_shows_the_picture_is_where_it_is_drawn(shape):
    """Of a white picture all that is not black, whoever fits it in; and how much of every patch."""
    white, size, grid = np.full((*shape, 3), 255, np.uint8), (224, 224), PatchGrid(16, 16, 224, 224)
    drawn = {
        "openpi": (resize_with_pad(white, 224), 0.5),
        "lerobot": (lerobot_pictures(white, 224)[0], 0.5),
        "pad": (model_picture(white, "front", size, "pad")[0], 0.5),
        "pad_left_top": (model_picture(white, "front", size, "pad_left_top")[0], 1.0),
    }
    for who, (picture, towards) in drawn.items():
        seen = picture.any(axis=2)
        part = fitted_part(shape, size, towards)
        expected = np.zeros(size, dtype=bool)
        top, left, height, width = (round(224 * side) for side in part)
        expected[top : top + height, left : left + width] = True
        np.testing.assert_array_equal(seen, expected, err_msg=who)
        patches = seen.reshape(16, 14, 16, 14).mean(axis=(1, 3)).ravel()
        np.testing.assert_allclose(grid.shown(part), patches, atol=1e-9, err_msg=who)


def states(inputs):
    names = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")
    return np.stack([libero_state(*values) for values in zip(*(inputs[name] for name in names), strict=True)])


def test_states(inputs, expected, stats):
    state = states(inputs)
    np.testing.assert_allclose(state, expected["state8"], rtol=0, atol=1e-6)
    for mode, name in MODES.items():
        got = pad_to(stats.state.normaliser(mode).normalise(state), 32)
        np.testing.assert_allclose(got, expected[f"{name}_state32"], rtol=0, atol=1e-6)


def test_digitised_states(inputs, expected, stats):
    digits = digitise_state(stats.state.normaliser("quantile").normalise(states(inputs)))
    np.testing.assert_array_equal(digits, expected["digitized"])
    assert (digits == -1).any()
    assert (digits == 255).any()


def processing(stats, pi05, relative=0):
    cameras = {"base_0_rgb": "agentview"}
    config = find_config("pi05_libero" if pi05 else "pi0_libero")
    return openpi_processing(config, stats, simulated_arm(cameras, relative))


@pytest.mark.parametrize("mode", MODES)
def test_actions(inputs, expected, stats, mode):
    made = processing(stats, mode == "quantile")
    got = [made.environment_actions(*given) for given in zip(inputs["model_actions"], states(inputs), strict=True)]
    assert np.shape(got) == (3, 10, 7)
    np.testing.assert_allclose(got, expected[f"{MODES[mode]}_actions7"], rtol=0, atol=1e-6)


def test_actions_relative_to_the_state(inputs, expected, stats):
    made = processing(stats, False, relative=6)
    got = [made.environment_actions(*given) for given in zip(inputs["model_actions"], states(inputs), strict=True)]
    np.testing.assert_allclose(got, expected["z_actions7_extra_delta"], rtol=0, atol=1e-6)


def test_longer_statistics_are_cut_and_longer_data_passes_through():
    long = Statistics(mean=np.arange(32.0), std=np.ones(32)).normaliser("z-score")
    assert long.normalise(np.arange(8.0)).tolist() == [0.0] * 8
    short = Statistics(mean=np.zeros(2), std=np.ones(2), q01=np.zeros(2), q99=np.ones(2)).normaliser("quantile")
    assert short.unnormalise(np.full((1, 4), 5.0))[0, 2:].tolist() == [5.0, 5.0]


def test_axis_angle_of_special_orientations():
    assert axis_angle(np.array([0.0, 0, 0, 1])).tolist() == [0, 0, 0]
    assert axis_angle(np.array([0.0, 0, 0, 1.0000001])).tolist() == [0, 0, 0]
    np.testing.assert_allclose(axis_angle(np.array([1.0, 0, 0, 0])), [np.pi, 0, 0])
    # the same orientation with the other sign gives an angle above pi: openpi's convention, not the shortest turn
    np.testing.assert_allclose(axis_angle(-np.array([0.6, 0, 0, 0.8])), [-2 * np.arccos(-0.8), 0, 0])


def test_wide_and_tall_images_are_padded_centrally():
    wide = resize_with_pad(np.full((100, 200, 3), 255, dtype=np.uint8), 50)
    assert (wide[:12] == 0).all()
    assert (wide[12:37] == 255).all()
    assert (wide[38:] == 0).all()
    tall = resize_with_pad(np.full((200, 100, 3), 255, dtype=np.uint8), 50)
    np.testing.assert_array_equal(tall, wide.transpose(1, 0, 2))
    same = np.asarray(Image.new("RGB", (50, 50), (1, 2, 3)))
    assert resize_with_pad(same, 50) is same


def test_statistics_come_from_the_checkpoint_s_assets(tmp_path, stats):
    with pytest.raises(CheckpointNotFound, match=r"norm_stats\.json"):
        read_norm_stats(tmp_path)
    target = tmp_path / "assets" / "physical-intelligence" / "libero" / "norm_stats.json"
    target.parent.mkdir(parents=True)
    target.write_text((FOLDER / "norm_stats.json").read_text())
    np.testing.assert_array_equal(read_norm_stats(tmp_path).actions.q99, stats.actions.q99)
    second = tmp_path / "assets" / "droid" / "norm_stats.json"
    second.parent.mkdir()
    second.write_text("{}")
    for wrong, named in (
        ({}, "droid, physical-intelligence/libero.*--asset-id NAME"),
        ({"asset_id": "libero"}, "libero.*droid, physical-intelligence/libero"),
        ({"given": tmp_path / "none.json"}, r"none\.json"),
        ({"given": tmp_path / "assets"}, "folder"),
        ({"asset_id": "droid"}, "norm_stats"),
    ):
        with pytest.raises(UserError, match=named):
            read_norm_stats(tmp_path, **wrong)
    for right in ({"asset_id": "physical-intelligence/libero"}, {"given": FOLDER / "norm_stats.json"}):
        np.testing.assert_array_equal(read_norm_stats(tmp_path, **right).actions.q99, stats.actions.q99)


def numbers(dim):
    return Statistics(mean=np.zeros(dim), std=np.ones(dim))


def test_statistics_must_be_those_of_state_and_actions(stats):
    stats.check(8, 7, 32)
    NormStats(numbers(32), numbers(32)).check(8, 7, 32)
    for state, actions, needed in (
        (7, 7, "'state' .* 7 .* 8 "),
        (14, 7, "'state' .* 14 .* 8 "),
        (8, 8, "'actions' .* 8 .* 7 .* 32"),
    ):
        with pytest.raises(UnreadableCheckpoint, match=needed):
            NormStats(numbers(state), numbers(actions)).check(8, 7, 32)
    with pytest.raises(UnreadableCheckpoint, match="q01 and q99"):
        numbers(8).normaliser("quantile")
