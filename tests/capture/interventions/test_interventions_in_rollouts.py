"""Interventions in rollouts by the command line, without a simulator: what is stored, resumed and refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.kit.still_scene import capture_without_simulator
from vla_attention.capture.__main__ import main
from vla_attention.schemas.interventions import ImageChange, Interventions, KeyKnockout, NoiseChange, PromptChange
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.root import read_root

CHANGES = (
    *("--knockout", "camera:base_0_rgb", "--knockout-queries", "all", "--knockout-layers", "1", "2"),
    *("--image", "left_wrist_0_rgb=blank", "--prompt", "text:lift the cube", "--noise-seed", "5"),
)


@pytest.fixture(autouse=True)
def without_simulator(monkeypatch):
    capture_without_simulator(monkeypatch)


def run(store: Path, *words: str, family: str = "pi") -> int:
    first = [
        family,
        "--checkpoint",
        "untrained-tiny",
        "--task-suite",
        "robosuite",
        "--num-episodes",
        "1",
        "--max-steps",
        "8",
        "--precision",
        "exact",
    ]
    return main([*first, "--output", str(store), *words])


def captured(store: Path, *words: str, family: str = "pi") -> Store:
    assert run(store, *words, family=family) == 0
    return open_store(store)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        capture_without_simulator(patch)
        return captured(tmp_path_factory.mktemp("base") / "base.zarr", "--task-id", "0")


def test_what_is_stored(base, tmp_path, capsys):
    changed = captured(tmp_path / "a.zarr", "--task-id", "0", *CHANGES)
    expected = Interventions(
        keys=(KeyKnockout("camera:base_0_rgb", queries="all", layers=(1, 2)),),
        prompt=PromptChange("text", text="lift the cube"),
        images=(ImageChange("left_wrist_0_rgb", "blank"),),
        noise=NoiseChange(5),
    )
    assert read_root(tmp_path / "a.zarr").interventions == expected
    assert f"Interventions: {expected.describe()}." in capsys.readouterr().out.splitlines()
    before, after = base.episodes[0], changed.episodes[0]
    rows = after.read("joint/rows")
    (span,) = changed.attributes.sites[0].camera_spans("base_0_rgb")
    assert (rows[:, 0, ..., span.start : span.stop] > 0).all()
    assert (rows[:, 1:, ..., span.start : span.stop] == 0).all()
    np.testing.assert_allclose(rows.sum(-1), 1, atol=1e-5)
    assert after.attributes.prompts[0].instruction_text == "lift the cube"
    assert len(np.unique(after.read("frames/left_wrist_0_rgb"))) == 1
    np.testing.assert_array_equal(after.read("frames/base_0_rgb")[0], before.read("frames/base_0_rgb")[0])
    assert after.attributes.initial_state_digest == before.attributes.initial_state_digest
    assert (after.read("noise_seed") != before.read("noise_seed")).all()
    assert main(["status", str(tmp_path / "a.zarr")]) == 0


def test_a_camera_that_later_layers_do_not_read_adds_exactly_nothing_there(tmp_path):
    """Its contribution is what the other parts leave of the update, because it adds most in the first layer."""
    words = ("--checkpoint", "pi05_cubes", "--knockout", "camera:base_0_rgb", "--knockout-layers", "1", "2", "3")
    episode = captured(tmp_path / "a.zarr", "--task-id", "0", *words).episodes[0]
    mass = episode.read("joint/atoms")[..., :-1].sum(axis=(3, 4))  # (replan, layer, denoise, part)
    squared = np.diagonal(episode.read("joint/contribution"), axis1=-2, axis2=-1)[..., :-1]
    knocked_out = (mass[:, 0] > 0).all(axis=(0, 1)) & (mass[:, 1:] == 0).all(axis=(0, 1, 2))
    assert knocked_out.sum() == 1
    assert (squared[:, 0, :, knocked_out] > 0).all()
    assert (squared[:, 1:, :, knocked_out] == 0).all()


def test_resumed_runs_apply_them_bit_for_bit_and_others_are_refused(tmp_path, capsys):
    whole = captured(tmp_path / "whole.zarr", "--task-id", "0", "1", *CHANGES, "--random-keys", "3")
    path = tmp_path / "resumed.zarr"
    captured(path, "--task-id", "1", *CHANGES, "--random-keys", "3")
    resumed = captured(path, "--task-id", "0", "1", *CHANGES, "--random-keys", "3", "--resume")
    for one, other in zip(whole.episodes, resumed.episodes, strict=True):
        for name in ("joint/rows", "actions", "joint/contribution"):
            np.testing.assert_array_equal(one.read(name), other.read(name))
    capsys.readouterr()
    for words in ((), CHANGES, (*CHANGES, "--random-keys", "4")):
        assert run(path, "--task-id", "0", "1", *words, "--resume") == 2
        assert f"{path}: its interventions." in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--knockout", "camera:bas"), "'base_0_rgb'"),
        (("--knockout", "word:lift", "--knockout-layers", "9"), "0 to 2"),
        (("--knockout", "word:lift", "--knockout-queries", "all", "--knockout-steps", "1"), "prefix"),
    ],
)
def test_mistakes_are_found_before_anything_is_written(tmp_path, capsys, words, expected):
    assert run(tmp_path / "a.zarr", "--task-id", "0", *words) == 2
    said = capsys.readouterr().err.strip()
    assert expected in said
    assert "\n" not in said
    assert not (tmp_path / "a.zarr").exists()
