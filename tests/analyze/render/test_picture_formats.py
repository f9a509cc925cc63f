"""Commands save pictures as PNG, with --pdf as PDF too; from Python they are saved as both."""

from __future__ import annotations

import re

import pytest

from tests.kit.stores import write_store
from vla_attention.analyze.__main__ import main


@pytest.mark.parametrize(("words", "pdf"), [([], False), (["--pdf"], True)])
def test_the_command_line_chooses_the_formats(tmp_path, capsys, words, pdf):
    store = write_store(tmp_path / "a.zarr")
    assert main([str(store), "--output", str(tmp_path / "out"), *words]) == 0
    stems: dict[str, set[str]] = {}
    for path in (tmp_path / "out").iterdir():
        stems.setdefault(path.suffix, set()).add(path.stem)
    assert len(stems[".png"]) == 4
    assert stems.get(".pdf", set()) == (stems[".png"] if pdf else set())
    assert ("*.pdf" in capsys.readouterr().out) is pdf


@pytest.mark.parametrize("command", ["analyze", "words", "compare", "effects"])
def test_a_pdf_without_pictures_is_refused(capsys, command):
    with pytest.raises(SystemExit) as stopped:
        main([command, "a.zarr", "--no-plots", "--pdf"])
    assert stopped.value.code == 2
    assert re.search("--pdf.*--no-plots", capsys.readouterr().err)
