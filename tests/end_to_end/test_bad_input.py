"""Mistakes of a user: always one sentence, exit code 2, no traceback, and no partial output."""

from __future__ import annotations

import json
import shutil

import pytest

from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.stores.store_format import STORE_VERSION

DUMMY = ["pi", "--checkpoint", "untrained-tiny", "--task-suite", "robosuite", "--replan-steps", "4"]


def run(command, arguments, capsys) -> str:
    """Run in this process; check the form of the error on stderr and return it."""
    try:
        code = command([str(argument) for argument in arguments])
    except SystemExit as stopped:  # argparse
        code = stopped.code
    said = capsys.readouterr().err.strip()
    assert code == 2, said
    assert said.count("\n") == 0
    assert "Traceback" not in said
    return said


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--task-suite", "libero_spacial"], "Did you mean 'libero_spatial'?"),
        (["--task-id", "8"], "its tasks are 0 to 7"),
        (["--task-id", "-1"], "its tasks are 0 to 7"),
        (["--task-suite", "libero_10", "--task-id", "10"], "its tasks are 0 to 9"),
        (["--layers", "6"], "expected block indices 0 to 2, or recorded-call numbers 3 to 5"),
        (["--layers", "1", "4", "1"], "name one of them twice"),
        (["--layers", "one"], "is neither a number nor a range"),
        (["--heads", "8"], "expected 0 to 7"),
        (["--denoise", "3"], "expected numbers 0 to 2, 'first', 'last' or 'all'"),
        (["--queries", "some"], "expected 'mean', 'steps' or 'all'"),
        (["--precision", "24"], "expected mantissa bits from 1 to 23, or 'exact'"),
        (["--replan-steps", "5"], "expected 1 to 4"),
        (["--max-steps", "0"], "expected at least 1"),
        (["--num-episodes", "0"], "expected at least 1"),
        (["--num-episodes", "51"], "its initial states are 0 to 49"),
        (["--num-image-tokens", "256"], "4 keys; leave the option out"),
        (["--paligemma-variant", "gemma_2b"], "contradicts the policy 'untrained-tiny'"),
        (["--action-expert-variant", "gemma_300"], "Did you mean 'gemma_300m'?"),
        (["--device", "cuda:99"], "CUDA devices"),
        (["--resume", "--overwrite"], "not allowed with"),
        (["--checkpoint", "no/such/folder"], "There is no checkpoint"),
        (["--checkpoint", "dummy"], "now called 'untrained-tiny'"),
        (["--checkpoint", "gs://bucket/name", "--config-name", "pi05_libro"], "Did you mean 'pi05_libero'?"),
        (["--dtype", "float16"], "expected float32, bfloat16"),
        (["--checkpoint-format", "openpi"], "Existing: openpi_torch, openpi_jax, lerobot"),
        (["--discrete-state-input"], "are for checkpoints"),
        (["--libero-assets", "no/such/folder", "--task-suite", "libero_10", "--task-id", "0"], "--libero-assets"),
    ],
)
def test_capture(arguments, expected, capsys, tmp_path):
    store = tmp_path / "a.zarr"
    assert expected in run(capture, [*DUMMY, "--output", store, *arguments], capsys)


def test_store_without_suffix_or_in_an_unwritable_place(tmp_path, capsys):
    assert capture([*DUMMY, "--store", str(tmp_path / "store")]) == 2
    said = capsys.readouterr().err
    assert "vla-capture: --store is called --output now.\n" in said
    assert "ends with '.zarr'" in said
    (tmp_path / "file").write_text("")
    said = run(capture, [*DUMMY, "--output", tmp_path / "file" / "a.zarr"], capsys)
    assert "give another --output" in said


@pytest.mark.simulator
def test_existing_store_needs_resume_or_overwrite(captured_store, capsys):
    said = run(capture, [*DUMMY, "--task-id", "0", "--output", captured_store], capsys)
    assert "exists already and holds 4 episodes; add --resume" in said


@pytest.mark.simulator
def test_resume_with_other_settings_names_the_field(captured_store, capsys):
    said = run(capture, [*DUMMY, "--max-steps", 12, "--seed", 8, "--output", captured_store, "--resume"], capsys)
    assert "its protocol.seed is 7, this run's is 8" in said


@pytest.mark.simulator
@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--grouping", "defualt"], "Did you mean 'default'?"),
        (["--grouping", "missing.toml"], "Cannot read grouping file missing.toml"),
        (["--group", "nouns"], "expected NAME=SELECTOR"),
        (["--group", "x=camera:base"], "Did you mean 'base_0_rgb'?"),
        (["--group", "x=word:cubes"], "Did you mean 'cube'?"),
        (["--group", "x=object:backround"], "Did you mean 'background'?"),
        (["--group", "x=wrod:cube"], "did you mean 'word'"),
        (["--group", "x=role:state & role:bos"], "has no key in any of the 4 selected episodes"),
        (["--group", "a=word:cube", "--group", "b=role:instruction"], "Groups 'a' and 'b' share"),
        (["--group", "x=word:cube", "--ratio", "y/x"], "refers to group 'y'"),
        (["--ratio", "visual"], "expected GROUP[,GROUP]/GROUP[,GROUP]"),
        (["--layers", "6"], "expected block indices 0 to 2"),
        (["--denoise", "1"], "was not recorded; recorded: 0, 2"),
        (["--heads", "9"], "Head 9 was not recorded"),
        (["--task", "5"], "it has tasks 0, 1"),
        (["--site", "cross"], "Unknown site 'cross'. Existing: joint."),
    ],
)
def test_analyze(arguments, expected, captured_store, tmp_path, capsys):
    assert expected in run(analyze, [captured_store, "--output", tmp_path / "out", *arguments], capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.simulator
def test_stores_that_cannot_be_read(captured_store, tmp_path, capsys):
    assert "There is no store at" in run(analyze, [captured_store.with_name("robosite.zarr")], capsys)
    assert "Did you mean" in run(analyze, [captured_store.with_name("robosite.zarr")], capsys)
    assert "is not a store" in run(analyze, [tmp_path], capsys)

    newer = tmp_path / "newer.zarr"
    shutil.copytree(captured_store, newer)
    document = json.loads((newer / "zarr.json").read_text())
    document["attributes"]["store_version"] = STORE_VERSION + 1
    (newer / "zarr.json").write_text(json.dumps(document))
    expected = f"is a store of version {STORE_VERSION + 1}, and this program reads stores up to version {STORE_VERSION}"
    assert expected in run(analyze, [newer], capsys)

    (newer / "zarr.json").write_text("{")
    assert "cannot be read" in run(analyze, [newer], capsys)


@pytest.mark.simulator
def test_output_folder_that_cannot_be_written(captured_store, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    said = run(analyze, [captured_store, "--output", tmp_path / "file" / "results", "--no-plots"], capsys)
    assert "Cannot write results to" in said


@pytest.mark.simulator
def test_two_stores_with_the_same_episodes_are_refused(captured_store, tmp_path, capsys):
    copy = tmp_path / "copy.zarr"
    shutil.copytree(captured_store, copy)
    assert "both hold task000_episode000" in run(analyze, [captured_store, copy, "--no-plots"], capsys)
