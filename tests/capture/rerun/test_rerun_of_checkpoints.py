"""Reruns of checkpoints in every format: the golden cases, whose pictures have whole grey levels or finer ones."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.kit.pi_golden import GOLDEN
from tests.kit.small_tokenizer import train_small_tokenizer
from tests.kit.still_scene import capture_without_simulator
from vla_attention.capture.__main__ import main
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

CHECKPOINTS = ("pi0_batch2/checkpoint", "pi05_batch2/checkpoint_openpi_torch", "pi05_batch2/checkpoint_lerobot")


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory):
    return str(train_small_tokenizer(tmp_path_factory.mktemp("tokenizer") / "small.model"))


def said(capsys):
    return capsys.readouterr().out


def capture(monkeypatch, checkpoint, tokenizer, target):
    capture_without_simulator(monkeypatch)
    words = [
        "--checkpoint",
        str(GOLDEN / checkpoint),
        "--tokenizer",
        tokenizer,
        "--task-id",
        "0",
        "--output",
        str(target),
    ]
    assert main(["pi", *words, "--num-episodes", "1", "--max-steps", "7"]) == 0
    return target


@pytest.mark.parametrize("checkpoint", CHECKPOINTS)
def test_a_checkpoint_is_found_again_and_its_calls_are_bit_equal(checkpoint, tokenizer, tmp_path, monkeypatch, capsys):
    base = capture(monkeypatch, checkpoint, tokenizer, tmp_path / "base.zarr")
    assert verify_store(open_store(base)) == []
    capsys.readouterr()
    again = tmp_path / "again.zarr"
    assert main(["rerun", str(base), "--tokenizer", tokenizer, "--output", str(again)]) == 0
    assert re.search(r"\b2 .*task000_episode000.*\bbit-equal", said(capsys))
    old, new = (open_store(path).episodes[0].attributes.arrays for path in (base, again))
    assert old == new
    finer = "lerobot" in checkpoint
    assert [name for name in old if name.startswith("camera_frames/")] == finer * [
        "camera_frames/image",
        "camera_frames/image2",
    ]


def test_a_changed_picture_of_lerobot_is_of_whole_grey_levels_and_made_again(tokenizer, tmp_path, monkeypatch, capsys):
    base = capture(monkeypatch, CHECKPOINTS[2], tokenizer, tmp_path / "base.zarr")
    target = tmp_path / "turned.zarr"
    words = ["--tokenizer", tokenizer, "--check", "0"]
    assert main(["rerun", str(base), *words, "--output", str(target), "--image", "image=rotated"]) == 0
    [old], [new] = open_store(base).episodes, open_store(target).episodes
    np.testing.assert_array_equal(new.read("frames/image"), old.read("frames/image")[:, ::-1, ::-1])
    assert "camera_frames/image" not in new.attributes.arrays
    np.testing.assert_array_equal(new.read("camera_frames/image2"), old.read("camera_frames/image2"))
    capsys.readouterr()
    assert main(["rerun", str(target), "--tokenizer", tokenizer]) == 0
    assert ": bit-equal" in said(capsys)
