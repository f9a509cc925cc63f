"""Checkpoints through the real command line: each format in the simulator, and one sentence for each mistake."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import zarr

from tests.kit.raw_rows import probabilities
from tests.kit.small_tokenizer import train_small_tokenizer
from tests.kit.thorough import thorough_except
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture

GOLDEN = Path(__file__).parents[1] / "golden" / "pi"
#: folder -> format, prompt and normalisation in the manifest
CHECKPOINTS = {
    "pi0_batch2/checkpoint": ("openpi_jax", "instruction-newline", "z-score"),
    "pi0_batch2/checkpoint_lerobot": ("lerobot", "raw-instruction-newline", "state MEAN_STD, action MEAN_STD"),
    "pi05_batch2/checkpoint_openpi_torch": ("openpi_torch", "instruction-newline", "quantile"),
    "pi05_batch2/checkpoint_lerobot": ("lerobot", "task-state-action", "state QUANTILES, action QUANTILES"),
}


@pytest.fixture(scope="session")
def small_tokenizer(tmp_path_factory) -> Path:
    return train_small_tokenizer(tmp_path_factory.mktemp("tokenizer") / "small.model")


@pytest.mark.simulator
@pytest.mark.parametrize("name", thorough_except(("pi05_batch2/checkpoint_lerobot",), CHECKPOINTS))
def test_a_checkpoint_drives_the_simulator_and_its_store_is_analysed(name, small_tokenizer, tmp_path, capsys):
    store = tmp_path / "store.zarr"
    arguments = [
        "--tokenizer",
        small_tokenizer,
        "--task-id",
        0,
        "--num-episodes",
        1,
        "--max-steps",
        7,
        "--output",
        store,
    ]
    assert capture(["pi", "--checkpoint", str(GOLDEN / name), *map(str, arguments)]) == 0
    said = capsys.readouterr()
    checkpoint_format, prompt, normalisation = CHECKPOINTS[name]

    # the state does not fit into this model's 24 text slots: LeRobot cuts it, visibly
    assert ("Warning" in said.err) == (prompt == "task-state-action")

    attributes = dict(zarr.open_group(store, mode="r").attrs)
    policy = attributes["policy"]
    assert policy["checkpoint_format"] == checkpoint_format
    assert policy["family"] == name.split("_")[0]
    assert len(policy["digest"]) == 64
    assert policy["untrained"] is False
    facts = policy["config"]
    assert facts["prompt_format"] == prompt
    assert facts["normalisation"] == normalisation
    assert facts["configuration"] == "case.json beside the checkpoint"
    assert facts["dtype"] == "float32"
    assert facts["config"]["siglip"]["image_size"] == 56
    protocol = attributes["protocol"]
    # A checkpoint is evaluated as in its own ecosystem; the number of executed actions is that of the checkpoint.
    expected = ("lerobot", 1000, 360) if checkpoint_format == "lerobot" else ("openpi", 7, 256)
    assert (protocol["name"], protocol["seed"], protocol["image_size"]) == expected
    assert protocol["replan_steps"] == 5

    episode = zarr.open_group(store / "episodes/task000_episode000", mode="r")
    camera = policy["cameras"][0]["name"]
    assert episode[f"frames/{camera}"].shape == (2, 56, 56, 3)
    assert np.isfinite(probabilities(episode["joint/rows"])).all()
    np.testing.assert_allclose(episode["joint/atoms"][..., -1], 1, atol=1e-5)
    if prompt == "task-state-action":
        prompt_read = dict(episode.attrs)["prompts"][0]
        assert prompt_read["pieces"][-1]["stop"] < len(prompt_read["text"])
    assert analyze([str(store), "--output", str(tmp_path / "results"), "--no-plots"]) == 0
    assert analyze(["store", "verify", str(store)]) == 0
    covered = episode[f"objects/{camera}"][:]
    np.testing.assert_allclose(covered.sum(axis=-1), 1, atol=1e-5)

    capsys.readouterr()
    other = "openpi" if expected[0] == "lerobot" else "lerobot"
    resumed = ["--resume", "--protocol", other, "--seed", expected[1]]
    said = refused(["--checkpoint", GOLDEN / name, *arguments, *resumed], capsys)
    assert re.search(f"protocol.name .*'{expected[0]}',.*'{other}'", said)


def test_the_three_formats_of_one_model_have_one_digest(small_tokenizer):
    from vla_attention.capture.policies.pi.family import PiSettings
    from vla_attention.capture.policies.pi.loading import load_pi_policy

    digests = {
        load_pi_policy(PiSettings(str(GOLDEN / name), tokenizer=str(small_tokenizer))).identity().digest
        for name in CHECKPOINTS
        if name.startswith("pi0_")
    }
    assert len(digests) == 1


# --- mistakes


def refused(arguments, capsys) -> str:
    code = capture(["pi", *map(str, arguments)])
    said = capsys.readouterr().err.strip()
    assert code == 2, said
    assert "\n" not in said, said
    assert "Traceback" not in said
    return said


TORCH, JAX, LEROBOT = "pi05_batch2/checkpoint_openpi_torch", "pi0_batch2/checkpoint", "pi05_batch2/checkpoint_lerobot"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--paligemma-variant", "gemma_300m"], "gemma_300m"),
        (["--config-name", "pi0_libero"], "tensors"),
        (["--replan-steps", "8"], "1 to 7"),
    ],
)
def test_arguments_that_contradict_a_checkpoint(arguments, named, small_tokenizer, tmp_path, capsys):
    said = refused(
        ["--checkpoint", GOLDEN / JAX, "--tokenizer", small_tokenizer, "--output", tmp_path / "a.zarr", *arguments],
        capsys,
    )
    assert named in said
