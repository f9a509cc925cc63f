from __future__ import annotations

import re
from pathlib import Path

import pytest

from vla_attention.analyze.render.files import write_text, writing
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.store_format import StoreNotFound


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    write_text(path, "ratio ± 1\n")
    assert path.read_text(encoding="utf-8") == "ratio ± 1\n"
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "half a \ud800 pair")
    assert path.read_text(encoding="utf-8") == "ratio ± 1\n"
    assert [file.name for file in path.parent.iterdir()] == ["a.txt"]


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadArgument) as caught, writing("the page", tmp_path / "file" / "a.html", "another path"):
        write_text(tmp_path / "file" / "a.html", "")
    assert re.search(rf"the page .*{tmp_path / 'file' / 'a.html'}: .*another path", str(caught.value))
    # A mistake of the user that is an OSError too keeps its own sentence.
    with pytest.raises(StoreNotFound, match="no store"), writing("results", tmp_path):
        raise StoreNotFound("no store")
