"""Mistakes of a user: always one sentence, exit code 2, no traceback, and no partial output."""

from __future__ import annotations

import json
import re
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
    ("arguments", "named"),
    [
        (["--task-suite", "libero_spacial"], "'libero_spatial'"),
        (["--layers", "6"], "0 to 2, .*3 to 5"),
        (["--num-image-tokens", "256"], r"\b4 keys"),
        (["--checkpoint", "no/such/folder"], "no/such/folder"),
    ],
)
def test_capture(arguments, named, capsys, tmp_path):
    store = tmp_path / "a.zarr"
    assert re.search(named, run(capture, [*DUMMY, "--output", store, *arguments], capsys))


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--grouping", "defualt"], "'default'"),
        (["--group", "x=camera:base"], "'base_0_rgb'"),
        (["--group", "a=word:cube", "--group", "b=role:instruction"], "'a' and 'b'"),
        (["--layers", "6"], "0 to 2"),
    ],
)
def test_analyze(arguments, named, tmp_path, capsys):
    assert named in run(analyze, [STORED, "--output", tmp_path / "out", *arguments], capsys)
    assert not (tmp_path / "out").exists()


def test_stores_that_cannot_be_read(tmp_path, capsys):
    assert "robosite.zarr" in run(analyze, [STORED.with_name("robosite.zarr")], capsys)

    assert str(tmp_path) in run(analyze, [tmp_path], capsys)

    newer = tmp_path / "newer.zarr"
    shutil.copytree(STORED, newer)
    document = json.loads((newer / "zarr.json").read_text())
    document["attributes"]["store_version"] = STORE_VERSION + 1
    (newer / "zarr.json").write_text(json.dumps(document))
    assert re.search(rf"version {STORE_VERSION + 1}, .*version {STORE_VERSION}\b", run(analyze, [newer], capsys))


def test_output_folder_that_cannot_be_written(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    said = run(analyze, [STORED, "--output", tmp_path / "file" / "results", "--no-plots"], capsys)
    assert str(tmp_path / "file") in said
