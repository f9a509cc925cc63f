"""`benchmarks/make_page.py`: the tables of docs/benchmarks.md are those of docs/benchmarks/*.json."""

from __future__ import annotations

import pytest

from benchmarks.make_page import PAGE, PageError, cell, filled, number
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
    assert "Medians of 3 rounds (lowest, highest)." in page
    assert page.startswith("before\n")
    assert page.endswith("\nafter\n")
    assert "old" not in page
    assert filled(page, rows) == page


@pytest.mark.parametrize(
    ("page", "sentence"),
    [
        (BLOCK.replace("x/one", "y/one"), "names the table y/one; the files of rows hold x/one"),
        (BLOCK.replace("end of x/one", "end of x/two"), "has no end"),
        ("no blocks", "No block of the page shows x/one"),
    ],
)
def test_page_and_rows_that_do_not_fit(rows, page, sentence):
    with pytest.raises(PageError, match=sentence):
        filled(page, rows)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.0, "1.00"),
        (1.049, "1.05"),
        (0.01234, "0.0123"),
        (12.34, "12.3"),
        (123.4, "123"),
        (1234.5, "1,234"),
        (7, "7"),
        (0.0, "0"),
        (4.3e-6, "4.3e-06"),
    ],
)
def test_numbers_have_three_digits(value, text):
    assert number(value) == text


def test_cells():
    assert [cell(value) for value in (None, "a|b", True, 2)] == ["-", "a\\|b", "yes", "2"]
