"""A long answer is cut to a screen: first tables, then sections at the end, which are named; the file has all of it."""

from __future__ import annotations

import polars as pl
import pytest

from vla_attention.analyze.show.answer import SCREEN_LINES, Answer, Section, fitted, text_of, write_whole
from vla_attention.analyze.show.headings import WIDTH, title
from vla_attention.analyze.show.tables import Table, count, texts


def section(name: str, rows: int, texts_of_rows: bool = False) -> Section:
    columns = [count("layer", int, left=True), texts("ratio", lambda row: "1.250")]
    running = [texts("said", lambda row: "word " * 20, running=True)] if texts_of_rows else []
    return Section([Table([*columns, *running], range(rows)), "ratio: a note."], f"{name}  of every layer")


@pytest.mark.parametrize("rows", [(3, 3), (18, 3), (18, 18, 18), (18, 18, 2, 18, 3, 18), (400,)])
def test_it_fits_and_names_what_it_leaves_out(tmp_path, rows):
    names = [f"PART {i}" for i in range(len(rows))]
    sections = [Section([title("TITLE")]), *map(section, names, rows)]
    written = write_whole(tmp_path / "out", text_of(sections))
    assert written.read_text() == text_of(sections) + "\n"
    shown = fitted(sections, tmp_path / "out", [written])
    assert len(shown.splitlines()) <= SCREEN_LINES
    assert all(name in shown for name in names)
    assert str(written) in shown
    cut = [line for line in shown.splitlines() if "more rows" in line]
    for line in cut:
        assert int(line.split()[1]) + 5 in rows


def test_a_short_text_is_whole_without_its_rules(tmp_path):
    sections = [section("PART", 3)]
    lines = fitted(sections, tmp_path, []).splitlines()
    expected = [line for line in text_of(sections).splitlines() if not set(line) <= {"-", "·"}]
    assert lines[: len(expected)] == expected
    assert "more rows" not in "\n".join(lines)


def test_rows_of_several_lines_are_cut_as_rows_and_rows_of_running_text_not_at_all():
    high = Section([Table([texts("name", lambda row: f"{row}\nmore")], range(9))])
    assert high.on_screen(cut=True)[-2:] == ["more", "... 4 more rows in summary.txt"]
    assert any(line.startswith("8") for line in section("PART", 9, texts_of_rows=True).on_screen(cut=True))


@pytest.mark.parametrize(
    ("given", "name"),
    [
        (Section(["note"], "PART  of all"), "PART"),
        (Section([["all cameras"], Table([count("n", int)], [1])]), "all cameras"),
        (Section([Table([count("n", int)], [1])]), "n"),
        (Section([["only lines"], "and a sentence"]), ""),
    ],
)
def test_what_a_section_is_called_where_it_is_left_out(given, name):
    assert given.name == name


def test_an_answer_is_written_as_text_tables_and_pictures(tmp_path, capsys):
    def draw(folder):
        (folder / "one.png").touch()
        return [folder / "one.png"]

    answer = Answer([section("PART", 3)], {"numbers": pl.DataFrame({"n": [1]})}, draw, csv=True)
    assert answer.show(tmp_path, pictures=True) == 0
    files = sorted(path.name for path in tmp_path.iterdir())
    assert files == ["numbers.csv", "numbers.parquet", "one.png", "summary.txt"]
    assert max(map(len, capsys.readouterr().out.splitlines())) <= max(WIDTH, len(str(tmp_path)) + 30)
    assert answer.show(tmp_path / "b", pictures=False) == 0
    assert not (tmp_path / "b" / "one.png").exists()
