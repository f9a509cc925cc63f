"""Formats of checkpoint folders, and the errors for other folders."""

import json

import pytest

from tests.kit.pi_golden import GOLDEN
from vla_attention.capture.policies.checkpoints import UnsupportedCheckpoint
from vla_attention.capture.policies.pi.formats import detect_format


def make(folder, *names, config=None):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    if config is not None:
        (folder / "config.json").write_text(json.dumps(config))
    return folder


@pytest.mark.parametrize(
    ("folder", "expected"),
    [
        ("pi0_batch2/checkpoint", "openpi_jax"),
        ("pi0_batch2/checkpoint_lerobot", "lerobot"),
        ("pi05_batch2/checkpoint_openpi_torch", "openpi_torch"),
        ("pi05_batch2/checkpoint_lerobot", "lerobot"),
    ],
)
def test_golden_checkpoints_are_recognised(folder, expected):
    assert detect_format(GOLDEN / folder) == expected
    assert detect_format(GOLDEN / folder, expected) == expected


def test_a_folder_in_two_formats_is_taken_as_the_user_says(tmp_path):
    make(tmp_path, "params/_METADATA", "model.safetensors", config={"action_horizon": 10})
    assert detect_format(tmp_path) == "openpi_jax"
    assert detect_format(tmp_path, "openpi_torch") == "openpi_torch"
    with pytest.raises(UnsupportedCheckpoint):
        detect_format(GOLDEN / "pi05_batch2" / "checkpoint_lerobot", "openpi_jax")


@pytest.mark.parametrize(
    ("config", "family"),
    [
        ({"type": "smolvla"}, "smolvla"),
        ({"model_type": "openvla", "architectures": ["OpenVLAForActionPrediction"]}, "openvla"),
        ({"model_type": "llama"}, "llama"),
    ],
)
@pytest.mark.parametrize("weights", ["model.safetensors", "model-00001-of-00002.safetensors"])
def test_other_families_are_named(tmp_path, config, family, weights):
    make(tmp_path, weights, config=config)
    with pytest.raises(UnsupportedCheckpoint, match=family):
        detect_format(tmp_path)
