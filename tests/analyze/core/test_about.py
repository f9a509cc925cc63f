"""Numbers that several answers print."""

from __future__ import annotations

from vla_attention.analyze.core.about import inverse


def test_an_inverse_has_the_ends_of_its_interval_in_order():
    assert inverse(4.0, 2.0, 8.0) == [0.25, 0.125, 0.5]
    assert inverse(4.0, None, None) == [0.25, None, None]
