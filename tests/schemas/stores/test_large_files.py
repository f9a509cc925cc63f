"""Large files are never in memory whole where a part would do: in `verify`, `copy`, packing and merging."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import pytest

from tests.kit.durable_stores import store_bytes, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.store import codecs
from vla_attention.schemas.stores import reader, sealed_files
from vla_attention.schemas.stores.byte_source import Folder
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.seal import read_seal, seal_episode
from vla_attention.schemas.stores.store_format import STORE_VERSION
from vla_attention.schemas.stores.verify import verify_store
from vla_attention.schemas.stores.zip_members import ZipMembers
from vla_attention.testing.stores import StoreSpec

MOST = 5_000
ROWS = "joint/rows/c.0.0.0.0.0.0"
SPEC = StoreSpec(tasks=(0,), episodes=1, replans=40)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    with pytest.MonkeyPatch.context() as patch:  # chunks of a few replans
        patch.setattr(codecs, "TARGET_CHUNK_BYTES", MOST)
        return write_store(tmp_path_factory.mktemp("large") / "a.zarr", spec=SPEC)


@pytest.fixture
def asked(monkeypatch) -> list[int]:
    """Bytes of the rows' file that are asked for at once, with parts so small that the file counts as large."""
    monkeypatch.setattr(sealed_files, "PART_BYTES", MOST)
    monkeypatch.setattr(reader, "READ_AT_ONCE_BYTES", MOST)
    asked: list[int] = []
    for kind in (Folder, ZipMembers):

        def whole(self: Any, file: str, real: Any = kind.whole, **options: Any) -> bytes:
            content: bytes = real(self, file, **options)
            if file == ROWS:
                asked.append(len(content))
            return content

        def parts(self: Any, file: str, offset: int, lengths: Any, real: Any = kind.parts, **options: Any) -> Any:
            if file == ROWS:
                asked.append(max(lengths))
            return real(self, file, offset, lengths, **options)

        monkeypatch.setattr(kind, "whole", whole)
        monkeypatch.setattr(kind, "parts", parts)
    return asked


def test_the_files_are_larger_than_a_part(made):
    assert (made / "episodes/task000_episode000" / ROWS).stat().st_size > 3 * MOST


@pytest.mark.parametrize("packed", [False, True], ids=["folders", "packed"])
def test_no_more_than_a_part_is_read_at_once(made, tmp_path, asked, packed):
    expected = store_bytes(made)
    words = ["--packed"] if packed else []
    assert analyze(["copy", str(made), str(tmp_path / "b.zarr"), *words]) == 0
    assert verify_store(open_store(tmp_path / "b.zarr")) == []
    assert analyze(["copy", str(tmp_path / "b.zarr"), str(tmp_path / "c.zarr")]) == 0
    assert store_bytes(tmp_path / "c.zarr") == expected
    assert max(asked) == MOST
    if packed:
        (path,) = tmp_path.glob("b.zarr/episodes/*/*.zip")
        with zipfile.ZipFile(path) as opened:
            assert opened.testzip() is None


@pytest.mark.parametrize("at", [0, 6_000, -1], ids=["first part", "second part", "last byte"])
def test_a_damage_in_any_part_is_found(made, tmp_path, asked, capsys, at):
    assert analyze(["copy", str(made), str(tmp_path / "b.zarr")]) == 0
    file = tmp_path / "b.zarr/episodes/task000_episode000" / ROWS
    content = bytearray(file.read_bytes())
    content[at] ^= 1
    file.write_bytes(content)
    assert any(ROWS in fault.problem for fault in verify_store(open_store(tmp_path / "b.zarr")))
    assert analyze(["copy", str(tmp_path / "b.zarr"), str(tmp_path / "c.zarr")]) == 2
    assert f"its {ROWS} does not agree with its seal" in capsys.readouterr().err
    assert not list((tmp_path / "c.zarr/episodes").glob("task*"))
    for changed in (content + b"x", content[:-1]):
        file.write_bytes(changed)
        assert any(ROWS in fault.problem for fault in verify_store(open_store(tmp_path / "b.zarr")))


def test_a_seal_made_in_parts_is_the_same(made):
    folder = made / "episodes/task000_episode000"
    before = read_seal(folder)
    assert seal_episode(folder, before.episode, before.run, STORE_VERSION) == before
