"""`benchmarks/make_page.py`: the tables of benchmarks/README.md are those of benchmarks/rows/*.json."""

from __future__ import annotations

import pytest

from benchmarks.make_page import PAGE, filled
from benchmarks.measurement import Table, measured, write_rows

BLOCK = "before\n<!-- table x/one -->\nold\n<!-- end of x/one -->\nafter\n"


@pytest.fixture
def rows(tmp_path):
    table = Table({"what": "what", "s": "seconds"}, [{"what": "a", "s": measured([1.0, 3.0, 1.5])}, {"what": "b"}])
    write_rows("x", {"one": table}, command="python benchmarks/x.py", folder=tmp_path)
    return tmp_path


def test_the_page_shows_the_rows_that_are_there():
    page = PAGE.read_text(encoding="utf-8")
    assert filled(page) == page, "run python benchmarks/make_page.py"


def test_a_block_is_replaced_and_the_rest_stays(rows):
    page = filled(BLOCK, rows)
    assert "| what | seconds |\n|---|---|\n| a | 1.50 (1.00, 3.00) |\n| b | - |\n" in page
    assert "`python benchmarks/x.py`, 2" in page
    assert "3 rounds" in page
    assert page.startswith("before\n")
    assert page.endswith("\nafter\n")
    assert "old" not in page
    assert filled(page, rows) == page
