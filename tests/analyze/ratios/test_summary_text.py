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


def test_untrained_weights_are_said_first():
    run = replace(RUN, policy="untrained-tiny", untrained=True)
    text = summarise(*CASES["one"](), run)
    assert text.index("WARNING: the policy has untrained") < text.index("store:")


def test_verdict_is_only_given_for_seeing_over_reading():
    text = " ".join(summarise(*CASES["custom"]()).split())
    assert "verdict" not in text
    assert "read the ratio beside it, or read the lift" in text


def test_nonfinite_ratios_are_counted_per_layer():
    text = summarise(*CASES["infinite"]())
    assert "layer 18: 36 of 36 replans; 6 of 6 episodes have no finite ratio at all" in text
    assert "undefined" in text
    assert "NOT FINITE" not in summarise(*CASES["custom"]())


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
