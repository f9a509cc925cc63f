"""Every source of bytes gives the same bytes, as new ones and into memory that is there."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest

from vla_attention.schemas.stores.byte_source import ByteSource, Folder
from vla_attention.schemas.stores.zip_members import ZipMembers

FILES = {"large/c": bytes(range(256)) * 3, "small": b"metadata of a few bytes"}


@pytest.fixture(params=["folder", "zip", "zip whose end holds all"])
def source(request, tmp_path) -> ByteSource:
    for name, content in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    if request.param == "folder":
        return Folder(tmp_path)
    path = tmp_path / "packed.zip"
    with zipfile.ZipFile(path, "w") as packed:
        for name in FILES:
            packed.write(tmp_path / name, name)
    tail = 0 if request.param.endswith("all") else path.read_bytes().index(b"small")
    return ZipMembers(Folder(tmp_path), path.name, path.stat().st_size, tail)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(("offset", "length"), [(0, 5), (3, 10), (7, 0), (20, 100_000), (800, 4)])
def test_parts_and_memory_are_filled_with_the_same_bytes(source, name, offset, length):
    expected = FILES[name][offset : offset + length]
    memory = np.full(length + 3, 255, np.uint8)
    assert source.parts(name, offset, (length,)) == [expected]
    assert source.read_into(memory[:length], name, offset) == len(expected)
    assert memory[: len(expected)].tobytes() == expected
    assert (memory[len(expected) :] == 255).all()


def test_a_missing_file_is_an_error_of_the_system(source):
    with pytest.raises(FileNotFoundError):
        source.read_into(np.empty(4, np.uint8), "nothing", 0)
