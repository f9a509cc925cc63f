"""Mistakes of a user: always one sentence, exit code 2, no traceback, and no partial output."""

from __future__ import annotations

import json
import shutil

import pytest

from tests.kit.golden_stores import golden_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.stores.store_format import STORE_VERSION

STORED = golden_store("joint")
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
        (["--layers", "6"], "expected block indices 0 to 2, or recorded-call numbers 3 to 5"),
        (["--num-image-tokens", "256"], "4 keys; leave the option out"),
        (["--checkpoint", "no/such/folder"], "There is no checkpoint"),
    ],
)
def test_capture(arguments, expected, capsys, tmp_path):
    store = tmp_path / "a.zarr"
    assert expected in run(capture, [*DUMMY, "--output", store, *arguments], capsys)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--grouping", "defualt"], "Did you mean 'default'?"),
        (["--group", "x=camera:base"], "Did you mean 'base_0_rgb'?"),
        (["--group", "a=word:cube", "--group", "b=role:instruction"], "Groups 'a' and 'b' share"),
        (["--layers", "6"], "expected block indices 0 to 2"),
    ],
)
def test_analyze(arguments, expected, tmp_path, capsys):
    assert expected in run(analyze, [STORED, "--output", tmp_path / "out", *arguments], capsys)
    assert not (tmp_path / "out").exists()


def test_stores_that_cannot_be_read(tmp_path, capsys):
    assert "There is no store at" in run(analyze, [STORED.with_name("robosite.zarr")], capsys)

    assert "is not a store" in run(analyze, [tmp_path], capsys)

    newer = tmp_path / "newer.zarr"
    shutil.copytree(STORED, newer)
    document = json.loads((newer / "zarr.json").read_text())
    document["attributes"]["store_version"] = STORE_VERSION + 1
    (newer / "zarr.json").write_text(json.dumps(document))
    expected = f"is a store of version {STORE_VERSION + 1}, and this program reads version {STORE_VERSION}"
    assert expected in run(analyze, [newer], capsys)


def test_output_folder_that_cannot_be_written(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    said = run(analyze, [STORED, "--output", tmp_path / "file" / "results", "--no-plots"], capsys)
    assert "Cannot write results to" in said
