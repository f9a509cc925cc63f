"""A long text is cut to a screen: first tables, then blocks at the end, which are named; the file has all of it."""

from __future__ import annotations

import pytest

from vla_attention.analyze.show.headings import WIDTH, heading
from vla_attention.analyze.show.screen import SCREEN_LINES, fitted, write_whole
from vla_attention.analyze.show.text_table import text_table


def section(name: str, rows: int) -> str:
    table = text_table(["layer", "ratio"], [[str(i), "1.250"] for i in range(rows)], left=(0,))
    return "\n".join([heading(f"{name}  of every layer"), table, "ratio: a note."])


@pytest.mark.parametrize("rows", [(3, 3), (18, 3), (18, 18, 18), (18, 18, 2, 18, 3, 18), (400,)])
def test_it_fits_and_names_what_it_leaves_out(tmp_path, rows):
    names = [f"PART {i}" for i in range(len(rows))]
    text = "\n\n".join(["\n".join(["TITLE", "=" * WIDTH]), *map(section, names, rows)])
    written = write_whole(tmp_path / "out", text)
    assert written.read_text() == text + "\n"
    shown = fitted(text, tmp_path / "out", [written])
    assert len(shown.splitlines()) <= SCREEN_LINES
    assert all(name in shown for name in names)
    assert str(written) in shown
    cut = [line for line in shown.splitlines() if "more rows" in line]
    for line in cut:
        assert int(line.split()[1]) + 5 in rows


def test_a_short_text_is_whole_without_its_rules(tmp_path):
    text = section("PART", 3)
    lines = fitted(text, tmp_path, []).splitlines()
    expected = [line for line in text.splitlines() if not set(line) <= {"-", "·"}]
    assert lines[: len(expected)] == expected
    assert "more rows" not in "\n".join(lines)
