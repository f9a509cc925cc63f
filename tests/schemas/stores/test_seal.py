"""What a seal says of files and documents, and that bits which were chosen to keep a checksum are found."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.kit.attacks import FIRST, forge_chunk
from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.seal import seal_document
from vla_attention.schemas.stores.sealed_files import index_size

#: Two layers and two denoise steps: four chunks of 39 keys.
SPEC = StoreSpec(tasks=(0, 1), episodes=1, replans=9)
ROWS = "joint/rows/c.0.0.0.0.0.0"
#: A group that cuts a segment: its masses are read from the rows.
CORNER = "corner=patch:base_0_rgb[0:1,0:1]"


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("original") / "a.zarr", spec=SPEC)


@pytest.fixture
def path(original, tmp_path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "a.zarr"))


def seal_of(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((path / "episodes" / FIRST / "seal/zarr.json").read_text())["attributes"]
    return found


def test_a_seal_has_digests_of_files_and_indices_and_repeats_documents(original):
    seal, folder = seal_of(original), original / "episodes" / FIRST
    assert {*seal["files"], "seal/zarr.json"} == {
        file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()
    }
    for file, record in seal["files"].items():
        content = (folder / file).read_bytes()
        assert (record["size"], record["sha256"]) == (len(content), hashlib.sha256(content).hexdigest())
        if file.endswith("zarr.json"):
            assert seal["documents"].pop(file) == json.loads(content)
    assert seal["documents"] == {}
    content = (folder / ROWS).read_bytes()
    assert seal["files"][ROWS]["index"] == hashlib.sha256(content[-index_size(4) :]).hexdigest()


def refused_by(command: list[str], capsys) -> str:
    capsys.readouterr()
    code = analyze(command)
    said = capsys.readouterr()
    assert code == (1 if "verify" in command else 2), said
    return said.out + said.err


def test_bits_that_keep_the_checksum_are_refused(path, tmp_path, capsys):
    """A chunk of 32 bits of checksum: sums of rows tell it to an analysis, and sha256 to whatever reads whole files."""
    file = path / "episodes" / FIRST / ROWS
    file.write_bytes(forge_chunk(file.read_bytes(), 2, 4, 39))
    asked = ["--group", CORNER, "--no-plots", "--no-cache", "--output", str(tmp_path / "out")]
    assert "row sums" in refused_by([str(path), *asked], capsys)
    assert analyze([str(path), *asked, "--skip-corrupt"]) == 0
    assert FIRST in (tmp_path / "out/result.json").read_text()
    assert ROWS in refused_by(["store", "verify", str(path)], capsys)
    assert ROWS in refused_by(["store", "copy", str(path), str(tmp_path / "c.zarr")], capsys)
    parts = [Path(shutil.copytree(path, tmp_path / f"{task}.zarr")) for task in (0, 1)]
    for part, task in zip(parts, (1, 0), strict=True):
        shutil.rmtree(part / f"episodes/task00{task}_episode000")
    assert ROWS in refused_by(["store", "copy", *map(str, parts), "-o", str(tmp_path / "merged.zarr")], capsys)


def test_a_seal_that_repeats_something_else_is_named(path, capsys):
    file = path / "episodes" / FIRST / "seal/zarr.json"
    seal = json.loads(file.read_text())["attributes"]
    seal["documents"]["joint/zarr.json"]["attributes"]["layer"] = [7, 8]
    file.write_bytes(seal_document(seal))
    assert "joint/zarr.json" in refused_by(["store", "verify", str(path)], capsys)
    del seal["documents"]["joint/rows/zarr.json"]
    file.write_bytes(seal_document(seal))
    assert "joint/rows/zarr.json" in refused_by([str(path), "--group", CORNER], capsys)
    assert open_store(path).episodes[1].read("joint/rows").shape[0] == 9
