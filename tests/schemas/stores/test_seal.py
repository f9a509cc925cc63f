"""What a seal says of files and documents, and that bits which were chosen to keep a checksum are found."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.kit.attacks import FIRST, forge_chunk
from tests.kit.examples import examples
from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.seal import seal_document
from vla_attention.schemas.stores.sealed_files import index_size
from vla_attention.schemas.stores.store_format import CorruptEpisode, StoreError
from vla_attention.schemas.stores.verify import verify_store

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


#: What a stranger writes in place of a number, a text or a list of a seal.
FORGED = st.sampled_from([-1, 0, 1, 7, 10**9, 10**13, 2**62, 2**70, 1.5, None, "", "S1000000000", [], [0], {}])


def places(value: Any, above: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where everything of a document is, as the keys that lead there."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [(*above, key) for key, _ in inside] + [
        place for key, each in inside for place in places(each, (*above, key))
    ]


@settings(max_examples=examples(50), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_forged_seal_gives_an_error_and_no_other_number(original, tmp_path, data):
    """Whatever it says of sizes, shapes, chunks and types; nothing hangs, and nothing takes all memory."""
    path = Path(shutil.copytree(original, tmp_path / os.urandom(6).hex()))
    seal = seal_of(path)
    part = data.draw(st.sampled_from(["files", "documents"]))
    place = data.draw(st.sampled_from(places(seal[part])))
    at = seal[part]
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = data.draw(FORGED)
    (path / "episodes" / FIRST / "seal/zarr.json").write_bytes(seal_document(seal))
    true, forged = open_store(original).episodes[0], open_store(path).episodes[0]
    for name in true.attributes.arrays:
        with suppress(CorruptEpisode):
            np.testing.assert_array_equal(forged.read(name), true.read(name))
    with suppress(CorruptEpisode):
        for file, record in forged.files.records.items():
            assert forged.copy_file(file, tmp_path / "copy") == record.size
    verify_store(open_store(path))
    shutil.rmtree(path)


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_what_is_no_regular_file_in_place_of_one_is_a_fault(original, tmp_path, kind):
    """Whichever of a store's files it is."""
    files = [str(file.relative_to(original)) for file in original.rglob("*") if file.is_file() and FIRST in str(file)]
    for file in ["zarr.json", "episodes/zarr.json", *files]:
        path = Path(shutil.copytree(original, tmp_path / "a.zarr"))
        (path / file).unlink()
        if kind == "pipe":
            os.mkfifo(path / file)
        else:
            (path / file).symlink_to("/dev/zero")
        if file == "zarr.json":
            with pytest.raises(StoreError):
                open_store(path)
        else:
            assert verify_store(open_store(path)), file
        if FIRST in file:
            with pytest.raises(CorruptEpisode):
                open_store(path).episodes[0].files.whole(str(Path(file).relative_to(f"episodes/{FIRST}")))
        shutil.rmtree(path)
