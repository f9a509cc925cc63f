"""Packed stores: the same numbers, the captured store again, copies that go on."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.store import packing
from vla_attention.analyze.store.copying import copy_store
from vla_attention.schemas.stores.packed_index import INDEX_FILE
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=2, contributions=True)


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("original") / "a.zarr", spec=SPEC)


@pytest.fixture(scope="module")
def packed(original, tmp_path_factory) -> Path:
    return pack(original, tmp_path_factory.mktemp("packed") / "a.zarr")


def pack(store: Path, to: Path) -> Path:
    copy_store(open_store(store), to, (), packed=True)
    return to


def all_bytes(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_an_episode_is_one_file_and_holds_the_same_numbers(original, packed):
    files = {file.relative_to(packed).as_posix() for file in packed.rglob("*") if file.is_file()}
    names = {f"episodes/task{task:03d}_000/task{task:03d}_episode{i:03d}.zip" for task in (0, 1) for i in (0, 1)}
    assert files == names | {"zarr.json", "episodes/zarr.json", INDEX_FILE}
    mine, theirs = open_store(packed), open_store(original)
    assert (mine.attributes, mine.run) == (theirs.attributes, theirs.run)
    assert verify_store(mine) == []
    for one, other in zip(mine.episodes, theirs.episodes, strict=True):
        assert (one.name, one.seal) == (other.name, other.seal)
        for name in other.attributes.arrays:
            assert np.array_equal(one.read(name), other.read(name), equal_nan=True), name
        with zipfile.ZipFile(packed / f"episodes/{one.name[:7]}_000/{one.name}.zip") as found:
            assert found.testzip() is None
            assert {member.compress_type for member in found.infolist()} == {zipfile.ZIP_STORED}


def test_a_copy_of_a_packed_store_is_the_captured_one_again(original, packed, tmp_path):
    copy_store(open_store(packed), tmp_path / "b.zarr", ())
    assert all_bytes(tmp_path / "b.zarr") == all_bytes(original)
    copied = copy_store(open_store(packed), tmp_path / "c.zarr", ("frames",), packed=True)
    assert copied.left_bytes > 0
    slim = open_store(tmp_path / "c.zarr")
    assert verify_store(slim) == []
    assert "frames/base_0_rgb" not in slim.episodes[0].attributes.arrays


def test_an_interrupted_copy_goes_on(original, packed, tmp_path, monkeypatch):
    class Interrupted(Exception):
        pass

    done = 0
    write_zip = packing.write_zip

    def stop_in_the_third(folder: Path, path: Path) -> int:
        nonlocal done
        if done == 2:
            path.write_bytes(b"PK\x03\x04 half of a zip")
            raise Interrupted
        done += 1
        return write_zip(folder, path)

    target = tmp_path / "b.zarr"
    with monkeypatch.context() as patch:
        patch.setattr(packing, "write_zip", stop_in_the_third)
        with pytest.raises(Interrupted):
            copy_store(open_store(original), target, (), packed=True)
    assert not list(target.rglob("*.partial*"))
    assert not list(tmp_path.glob("*.partial"))
    # What is there is a packed store of the whole zips, and nothing else passes for an episode.
    assert verify_store(open_store(target)) == []
    assert len(open_store(target).episodes) == 2
    again = copy_store(open_store(original), target, (), packed=True)
    assert (again.present, again.added) == (2, 2)
    assert all_bytes(target) == all_bytes(packed)
