"""A result on a screen: it fits the terminal, and what does not fit is named."""

from __future__ import annotations

import polars as pl
import pytest

from vla_attention.analyze.core.result import Column, Finding, Result, Table
from vla_attention.analyze.render.terminal import screen

SENTENCE = "put both the alphabet soup and the tomato sauce in the basket"
NAMES = ("told", "did", "touched first", "at step", "share of the attention", "why", "and then")
ROWS = pl.DataFrame(
    {
        name: [f"{SENTENCE} {row}" for row in range(30)]
        if name not in ("at step", "share of the attention")
        else [0.5] * 30
        for name in NAMES
    }
)
COLUMNS = [Column(name, "number" if ROWS.schema[name] == pl.Float64 else "text", name) for name in NAMES]


@pytest.mark.parametrize(("columns", "lines"), [(20, 10), (60, 24), (80, 24), (100, 40), (300, 200)])
def test_what_is_printed_fits_the_terminal(monkeypatch, columns, lines):
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("LINES", str(lines))
    said = Result("Why?", [SENTENCE], [Finding(f"It did. {SENTENCE}.", "Why?")], [Table("rows", ROWS, COLUMNS, "Rows")])
    text = screen(said).splitlines()
    assert max(map(len, text)) <= min(max(columns, 40), 120)
    assert len(text) < min(max(lines, 24), 60)
    if columns < 120:
        # Of 30 rows and seven columns some are left out, and named.
        (left,) = [line for line in " ".join(" ".join(text).split()).split("... ")[1:] if "more rows" in line]
        assert "in rows" in left
        shown = next(line for line in text if line.startswith("told"))
        assert all((name in shown) != (name in left) for name in NAMES)
