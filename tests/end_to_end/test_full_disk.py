"""A disk that takes no more: one sentence, exit code 2, and no half-written file under its name, whatever is written.

The operating system refuses files beyond a size (RLIMIT_FSIZE); it says so at the same places as on a full disk.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.kit.planted_effects import planted_effects
from tests.kit.stores import StoreSpec, write_store

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=2, contributions=True, plant_effects=planted_effects())
OUT = ("--output", "OUT", "--no-cache")
#: Commands that together write all kinds of files, in this process and in the second one.
WRITING: dict[str, tuple[str, ...]] = {
    "analyze": ("analyze", "STORE", *OUT, "--layers", "0"),
    "analyze, csv": ("analyze", "STORE", *OUT, "--no-plots", "--csv"),
    "words": ("words", "STORE", *OUT, "--task", "0"),
    "overlay": ("overlay", "STORE", *OUT, "--video", "gif"),
    "effects": ("effects", "STORE", *OUT),
    "copy": ("store", "copy", "STORE", "OUT/copy.zarr"),
}
#: Bytes of the largest file.
LIMITS = (4_000, 20_000)
_RUN = """
import contextlib, io, json, resource, sys
from pathlib import Path
from vla_attention.analyze.__main__ import main
limit, jobs = json.loads(sys.argv[1])
if limit is not None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
for words in jobs:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except BaseException as error:
            code = f"{type(error).__name__}: {error}"
    print(json.dumps([code, err.getvalue()]), flush=True)
"""


def run(limit: int | None, jobs: Sequence[Sequence[str]], folder: Path) -> list[list[Any]]:
    """Run commands in one process of its own; returns the exit code and the errors of each."""
    done = subprocess.run(
        [sys.executable, "-c", _RUN, json.dumps([limit, jobs])],
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
        timeout=600,
    )
    assert done.stderr == ""
    return [json.loads(line) for line in done.stdout.splitlines()]


def words_of(name: str, store: Path, out: Path) -> list[str]:
    known = {"STORE": str(store), "OUT": str(out)}
    known["OUT/copy.zarr"] = str(out / "copy.zarr")
    return [known.get(word, word) for word in WRITING[name]]


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> tuple[Path, dict[str, dict[str, bytes]]]:
    """A store, and the files that every command writes of it."""
    folder = tmp_path_factory.mktemp("stores")
    store = write_store(folder / "a.zarr", spec=SPEC)
    outs = {name: folder / f"whole{number}" for number, name in enumerate(WRITING)}
    answers = run(None, [words_of(name, store, out) for name, out in outs.items()], folder)
    assert [(name, answer) for name, answer in zip(WRITING, answers, strict=True) if answer[0] != 0] == []
    return store, {name: files(out) for name, out in outs.items()}


@pytest.mark.thorough
@pytest.mark.parametrize("limit", LIMITS)
def test_a_full_disk_is_one_sentence_and_leaves_no_part_of_a_file(stores, tmp_path, limit):
    store, whole = stores
    outs = {name: tmp_path / f"out{number}" for number, name in enumerate(WRITING)}
    answers = run(limit, [words_of(name, store, out) for name, out in outs.items()], tmp_path)
    refused = 0
    for (name, out), (code, said) in zip(outs.items(), answers, strict=True):
        written = files(out)
        # A temporary file, or one of a copy's store, may be too large although no result is.
        too_large = code != 0
        assert code == 2 or all(len(content) <= limit for content in whole[name].values()), (name, code, said)
        assert code in (0, 2), (name, code, said)
        if too_large:
            assert said.startswith(f"vla-attention {WRITING[name][0]}: "), (name, said)
            assert said.endswith("\n"), name
            assert said.count("\n") == 1, (name, said)
            assert "File too large" in said or "No usable temporary directory" in said, (name, said)
        for file, content in written.items():
            if ".zarr/" not in file:  # an episode of a copy is a folder that appears whole
                assert whole[name].get(file) == content, (name, file)
        assert not [file for file in written if "partial" in file], name
        refused += too_large
    assert refused > 0
