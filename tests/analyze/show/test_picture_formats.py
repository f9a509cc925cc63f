"""Commands save pictures as PNG, with --pdf as PDF too; from Python they are saved as both."""

from __future__ import annotations

import pytest

from vla_attention.analyze.__main__ import main
from vla_attention.analyze.show.picture_formats import picture_formats, pictures_saved_as
from vla_attention.testing.stores import write_store


@pytest.mark.parametrize(("words", "pdf"), [([], False), (["--pdf"], True)])
def test_the_command_line_chooses_the_formats(tmp_path, capsys, words, pdf):
    store = write_store(tmp_path / "a.zarr")
    assert main([str(store), "--output", str(tmp_path / "out"), *words]) == 0
    stems: dict[str, set[str]] = {}
    for path in (tmp_path / "out").iterdir():
        stems.setdefault(path.suffix, set()).add(path.stem)
    assert len(stems[".png"]) == 4
    assert stems.get(".pdf", set()) == (stems[".png"] if pdf else set())
    assert stems[".png"] <= stems[".csv"]
    printed = capsys.readouterr().out
    assert ("png pdf" in printed.replace(".", "")) is pdf
    assert picture_formats() == ("png", "pdf")


def test_the_formats_are_back_after_an_error():
    def fail() -> None:
        with pictures_saved_as(["png"]):
            assert picture_formats() == ("png",)
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert picture_formats() == ("png", "pdf")
