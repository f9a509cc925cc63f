from __future__ import annotations

from vla_attention.analyze.show.findings import findings


def test_what_is_named_shares_the_level_between_sentences():
    names, q_values = ["a", "b", "c"], [0.03, 0.01, None]
    assert findings(q_values, names, "task", "a difference") == (
        "Of the 2 of 3 tasks that can be tested, 2 show a difference (q <= 0.05): a, b."
    )
    assert findings(q_values, names, "task", "a difference", 2) == (
        "Of the 2 of 3 tasks that can be tested, 1 shows a difference (q <= 0.025: 0.05 shared by 2 sentences): b."
    )


def test_nothing_found_and_nothing_tested_are_told_apart():
    assert findings([0.4], ["a"], "quantity", "a change") == "Of 1 quantity, none shows a change (q <= 0.05)."
    assert findings([None, None], ["a", "b"], "quantity", "a change") == "None of 2 quantities can be tested."
