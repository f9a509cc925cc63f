"""The guide's word for a ratio never stands without its word for uniform attention."""

from __future__ import annotations

from dataclasses import replace

from tests.kit.made_up_steps import default_grouping
from vla_attention.analyze.ratios.verdict import verdict_sentence


def test_the_verdict_stands_beside_that_of_uniform_attention() -> None:
    grouping = default_grouping()
    assert "uniform attention the same" in verdict_sentence(grouping, 30.0, 40.0)
    other = verdict_sentence(grouping, 0.5, 40.0)
    assert "'linguistic-dominant'" in other
    assert "'visual-dominant'" in other
    assert verdict_sentence(grouping, None, 40.0) == ""
    assert verdict_sentence(replace(grouping, ratio=None), 3.0, 40.0) == ""
