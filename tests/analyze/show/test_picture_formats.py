"""Commands save pictures as PNG, with --pdf as PDF too; from Python they are saved as both."""

from __future__ import annotations

import polars as pl
import pytest
from matplotlib.figure import Figure

from vla_attention.analyze.__main__ import main
from vla_attention.analyze.show.picture_formats import picture_formats, pictures_saved_as
from vla_attention.analyze.show.plot_style import new_figure, save_figure
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


@pytest.mark.parametrize("command", ["ratios", "words", "compare", "effects"])
def test_a_pdf_without_pictures_is_refused(capsys, command):
    with pytest.raises(SystemExit) as stopped:
        main([command, "a.zarr", "--no-plots", "--pdf"])
    assert stopped.value.code == 2
    assert "--pdf: not allowed with argument --no-plots" in capsys.readouterr().err


def test_the_formats_are_back_after_an_error():
    def fail() -> None:
        with pictures_saved_as(["png"]):
            assert picture_formats() == ("png",)
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert picture_formats() == ("png", "pdf")


@pytest.mark.drawn
def test_a_picture_is_drawn_once_for_a_format(tmp_path, monkeypatch):
    drawn = []
    draw = Figure.draw
    monkeypatch.setattr(Figure, "draw", lambda figure, renderer: drawn.append(renderer) or draw(figure, renderer))
    figure = new_figure(3, 2)
    figure.add_subplot().plot([1, 2])
    save_figure(figure, tmp_path, "line", pl.DataFrame({"x": [1, 2]}), ("png",))
    assert len(drawn) == 1
    assert (tmp_path / "line.png").read_bytes()[:4] == b"\x89PNG"
