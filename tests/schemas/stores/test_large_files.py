"""Large files that are read in parts: a damage in any part is found."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.kit.durable_stores import write_store
from tests.kit.stores import StoreSpec
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.store import codecs
from vla_attention.schemas.stores import reader, sealed_files
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

MOST = 5_000
ROWS = "joint/rows/c.0.0.0.0.0.0"
SPEC = StoreSpec(tasks=(0,), episodes=1, replans=40)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    with pytest.MonkeyPatch.context() as patch:  # chunks of a few replans
        patch.setattr(codecs, "TARGET_CHUNK_BYTES", MOST)
        return write_store(tmp_path_factory.mktemp("large") / "a.zarr", spec=SPEC)


@pytest.fixture(autouse=True)
def small_parts(monkeypatch) -> None:
    """Parts so small that the file of the rows counts as large."""
    monkeypatch.setattr(sealed_files, "PART_BYTES", MOST)
    monkeypatch.setattr(reader, "READ_AT_ONCE_BYTES", MOST)


@pytest.mark.parametrize("at", [0, 6_000, -1], ids=["first part", "second part", "last byte"])
def test_a_damage_in_any_part_is_found(made, tmp_path, capsys, at):
    assert analyze(["store", "copy", str(made), str(tmp_path / "b.zarr")]) == 0
    file = tmp_path / "b.zarr/episodes/task000_episode000" / ROWS
    content = bytearray(file.read_bytes())
    content[at] ^= 1
    file.write_bytes(content)
    assert any(ROWS in fault.problem for fault in verify_store(open_store(tmp_path / "b.zarr")))
    assert analyze(["store", "copy", str(tmp_path / "b.zarr"), str(tmp_path / "c.zarr")]) == 2
    assert ROWS in capsys.readouterr().err
    assert not list((tmp_path / "c.zarr/episodes").glob("task*"))
    for changed in (content + b"x", content[:-1]):
        file.write_bytes(changed)
        assert any(ROWS in fault.problem for fault in verify_store(open_store(tmp_path / "b.zarr")))
