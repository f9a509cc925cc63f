from __future__ import annotations

from dataclasses import replace

import polars as pl
import pytest

from tests.kit.made_up_steps import CUSTOM_KEYS, custom_grouping, default_grouping, make_steps, many_groups, replans_of
from vla_attention.analyze.measures.aggregate import episode_tables, task_tables
from vla_attention.analyze.ratios.summary_text import AnalysedRun, summary_sections
from vla_attention.analyze.ratios.verdict import verdict
from vla_attention.analyze.show.answer import text_of
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.analyze.statistics.units import Units

RUN = AnalysedRun(
    stores=["runs/pi05_libero_10.zarr"],
    policy="pi05 (pi05_libero)",
    untrained=False,
    denoise_steps=[0, 9],
    units=Units.of([0]),
    notes=["Layers 25 = block 7: numbers from 18 on are the published scripts' recorded-call numbers."],
)


def summarise(steps, grouping, run=RUN):
    episodes = episode_tables(replans_of(steps, grouping), grouping)
    return text_of(summary_sections(run, grouping, episodes, task_tables(episodes, grouping, Sampling())))


def two_suites():
    return pl.concat([make_steps(num_tasks=12), make_steps(suite="libero_spatial", seed=2)])


CASES = {
    "default": lambda: (make_steps(no_denominator=0.1), default_grouping()),
    "one": lambda: (make_steps(num_tasks=1, num_episodes=1, layers=(25,), num_replans=1), default_grouping()),
    "infinite": lambda: (make_steps(no_denominator=1.0), default_grouping()),
    "custom": lambda: (make_steps(custom_grouping(), CUSTOM_KEYS), custom_grouping()),
    "no ratio": lambda: (make_steps(custom_grouping(False), CUSTOM_KEYS), custom_grouping(False)),
    "many": lambda: (make_steps(*many_groups()), many_groups()[0]),
    "suites": lambda: (two_suites(), default_grouping()),
    "all layers": lambda: (make_steps(layers=tuple(range(18))), default_grouping()),
}


@pytest.mark.parametrize("case", CASES)
def test_never_wider_than_a_page_and_nothing_raw_shows_through(case):
    text = summarise(*CASES[case]())
    assert max(map(len, text.splitlines())) <= 100
    for raw in ("None", "nan", "null"):
        assert raw not in text.split()


def test_header_says_what_was_analysed():
    text = " ".join(summarise(*CASES["default"]()).split())
    assert "runs/pi05_libero_10.zarr" in text
    assert "pi05 (pi05_libero)" in text
    assert "6 of 2 tasks" in text
    assert "36 replans" in text
    assert "25 = block 7" in text
    assert "denoise steps 0, 9" in text
    assert "linguistic = role:instruction | role:bos" in text
    assert "recorded-call numbers" in text
    assert "WARNING" not in text


def test_untrained_weights_are_said_first():
    run = replace(RUN, policy="untrained-tiny", untrained=True)
    text = summarise(*CASES["one"](), run)
    assert text.index("WARNING: the policy has untrained") < text.index("store:")


def test_ratio_stands_beside_its_baseline_lift_and_a_sentence_about_the_verdict():
    text = " ".join(summarise(*CASES["default"]()).split())
    assert "ratio 95% interval uniform lift of means mean ± std median verdict" in text
    assert "Uniform attention alone gives ratio = 36.57" in text
    assert "that alone would be called 'visual-dominant'" in text
    assert "512 keys on one side and 14 on the other" in text
    assert "interval: of the geometric mean, about tasks like these" in text


def test_verdict_is_only_given_for_seeing_over_reading():
    text = " ".join(summarise(*CASES["custom"]()).split())
    assert "verdict" not in text
    assert "read the ratio beside it, or read the lift" in text


def test_nonfinite_ratios_are_counted_per_layer():
    text = summarise(*CASES["infinite"]())
    assert "layer 18: 36 of 36 replans; 6 of 6 episodes have no finite ratio at all" in text
    assert "undefined" in text
    assert "NOT FINITE" not in summarise(*CASES["custom"]())


def test_one_episode_has_no_interval_and_the_text_says_so():
    text = " ".join(summarise(*CASES["one"]()).split())
    assert "No interval: a single episode" in text
    assert "±" not in text.split("RATIO")[1].split("mean, std, median")[0].replace("mean ± std", "")


def test_grouping_without_a_ratio_has_fractions_and_lifts_only():
    text = summarise(*CASES["no ratio"]())
    assert "FRACTION" in text
    assert "LIFT" in text
    assert "verdict" not in text
    assert "uniform  lift" not in text


def test_every_task_and_suite_has_a_row():
    text = summarise(*CASES["suites"]())
    assert "PER SUITE" in text
    assert "PER TASK OF libero_10" in text
    assert "PER TASK OF libero_spatial" in text
    assert text.count("turn on the stove") == 4


@pytest.mark.parametrize(
    ("ratio", "word"),
    [
        (1.51, "visual-dominant"),
        (1.5, "balanced"),
        (0.67, "balanced"),
        (0.66, "linguistic-dominant"),
        (None, "undefined"),
    ],
)
def test_verdict_has_the_published_thresholds(ratio, word):
    assert verdict(ratio) == word
