from __future__ import annotations

import pytest

from vla_attention.analyze.show.numbers import (
    format_interval,
    format_number,
    format_percent,
    format_percent_interval,
)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "-"), (float("nan"), "-"), (float("inf"), "inf"), (float("-inf"), "-inf"), (0.0, "0"), (14.0, "14"),
        (2.3456, "2.346"), (36.571, "36.57"), (999.96, "1000"), (99.951, "100.0"), (12345.6, "12346"),
        (1e-5, "1.0e-05"), (-0.5, "-0.500"),
    ],
)  # fmt: skip
def test_numbers_are_short(value, text):
    assert format_number(value) == text


def test_intervals():
    assert format_interval(1.0, 2.5) == "[1, 2.500]"
    assert format_interval(None, 2.5) == "-"
    assert format_percent_interval(0.125, 0.5) == "[12.5, 50.0]%"
    assert format_percent_interval(0.1, None) == "-"


@pytest.mark.parametrize(
    ("share", "decimals", "text"),
    [(0.1234, 1, "12.3%"), (0.5, 0, "50%"), (None, 1, "-"), (float("nan"), 1, "-"), (1.0, 1, "100.0%")],
)
def test_percent(share, decimals, text):
    assert format_percent(share, decimals) == text
