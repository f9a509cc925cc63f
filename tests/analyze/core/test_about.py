"""Numbers that several answers print."""

from __future__ import annotations

from vla_attention.analyze.core.about import inverse, with_interval, would_show
from vla_attention.analyze.core.result import Column
from vla_attention.analyze.render.numbers import cell


def test_an_inverse_has_the_ends_of_its_interval_in_order():
    assert inverse(4.0, 2.0, 8.0) == [0.25, 0.125, 0.5]
    assert inverse(4.0, None, None) == [0.25, None, None]


def test_an_interval_whose_ends_are_worlds_apart_is_not_printed():
    wide, narrow = {"x": 34.1, "x_low": 0.052, "x_high": 22546.0}, {"x": 34.1, "x_low": 4.0, "x_high": 290.0}
    assert "22546" not in with_interval(wide, "x") + cell(wide, Column("x", "factor"))
    assert with_interval(narrow, "x") == "34.1 [4, 290]"
    assert cell(narrow, Column("x", "factor")) == "34.10 [4, 290]"
    # A difference, and a share, may lie on both sides of nothing.
    assert cell({"x": 0.1, "x_low": -5.0, "x_high": 5.2}, Column("x", "signed")) == "+0.100 [-5, +5.200]"
    assert cell({"x": 0.1, "x_low": 0.0005, "x_high": 0.96}, Column("x", "percent")) == "10.0% [0.1, 96.0]"


def test_what_a_run_would_show_is_said_in_both_directions():
    assert "2 times" in would_show(2.0)
    assert "0.5 times" in would_show(2.0)
    assert would_show(None) == would_show(float("inf")) == ""
