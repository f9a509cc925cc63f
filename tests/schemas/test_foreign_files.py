"""Files that anybody may have made: what is no regular file, is too long or too deep ends with an error at once."""

from __future__ import annotations

import os

import pytest

from vla_attention.capture.interventions.prompts import read_synonyms
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.foreign_files import decode_toml, open_regular, read_regular, read_toml
from vla_attention.schemas.groupings.grouping import read_grouping_file
from vla_attention.schemas.jsonable import decode_json


def test_a_regular_file_is_read(tmp_path):
    file, link = tmp_path / "a.toml", tmp_path / "link"
    file.write_text('[a]\nb.c = "1.2.3"')
    link.symlink_to(file)
    size = file.stat().st_size
    assert read_regular(link, size) == file.read_bytes()
    assert read_toml(link) == {"a": {"b": {"c": "1.2.3"}}}
    with pytest.raises(OSError, match=f"{size} bytes"):
        read_regular(file, size - 1)


@pytest.mark.parametrize("kind", ["pipe", "device", "link to a device", "folder", "socket", "nothing"])
@pytest.mark.parametrize("read", [open_regular, read_regular, read_toml, read_synonyms, read_grouping_file])
def test_what_is_no_regular_file_is_an_error(tmp_path, kind, read):
    path = tmp_path / "a.toml"
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "link to a device":
            path.symlink_to("/dev/zero")
        case "folder":
            path.mkdir()
        case "socket":
            os.mknod(path, 0o140600)
    with pytest.raises((OSError, UserError)):
        read("/dev/zero" if kind == "device" and read in (open_regular, read_regular) else path)


@pytest.mark.parametrize(("open_", "value", "close"), [("[", "1", "]"), ("[", "NaN", "]"), ('{"a":', "NaN", "}")])
@pytest.mark.parametrize("depth", [5_000, 1_000_000])
def test_json_that_is_too_deep_is_an_error(open_, value, close, depth):
    with pytest.raises(ValueError, match="deep"):
        decode_json((open_ * depth + value + close * depth).encode())


@pytest.mark.parametrize(
    "text",
    [f"{'a.' * 100_000}a = 1", f"[{'a.' * 100_000}a]", f"a = {'[' * 100_000}{']' * 100_000}", "a = " + "{b = " * 9_999],
)
def test_toml_that_is_too_deep_or_too_long_is_an_error(text):
    with pytest.raises(ValueError, match=r"deep|dots"):
        decode_toml(text)
