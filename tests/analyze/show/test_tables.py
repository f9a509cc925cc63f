"""A table is defined once: its text and its cells for the page show the same numbers, each with its unit."""

from __future__ import annotations

from vla_attention.analyze.show.tables import (
    Cell,
    estimate,
    interval,
    percent,
    signed,
)

ROWS = [
    {"name": "x", "n": 1, "share": 0.125, "share_low": 0.1, "share_high": 0.25, "text": "one two " * 20},
    {"name": "yy", "n": 10, "share": None, "share_low": None, "share_high": None, "text": ""},
]


def test_a_unit_stands_behind_every_value_of_a_text_and_in_the_header_of_the_page():
    column = percent("part", "share", "part")
    assert [column.text(row) for row in ROWS] == ["12.5%", "-"]
    assert [column.cell(row) for row in ROWS] == [Cell("12.5", 0.125), Cell("-", None)]
    assert column.page == "part %"


def test_estimates_stand_beside_their_intervals_which_sort_by_width():
    number, bounds = estimate("share", "share", "share")
    assert [number.text(row) for row in ROWS] == ["0.125", "-"]
    assert [bounds.text(row) for row in ROWS] == ["[0.100, 0.250]", "-"]
    assert bounds.page == "95% interval"
    assert [bounds.cell(row).sort_key for row in ROWS] == [0.15, None]
    assert interval("share", times=100).text(ROWS[0]) == "[10, 25]"
    assert interval("share", of=lambda row: None).text(ROWS[0]) == "-"
    assert signed("share", "share").text(ROWS[0]) == "+0.125"
