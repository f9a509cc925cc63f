"""Which published rate a checkpoint is held against, and when it is accepted; nothing is simulated."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vla_attention.capture.doctor.acceptance import (
    at_most,
    exact_interval,
    find_published_rate,
    judge,
    most_that_is_too_few,
    rate_found_in_nine_of_ten,
    share_of_tasks,
)
from vla_attention.capture.environments.suites import SUITES, find_suite
from vla_attention.capture.policies.families import default_family, policy_families
from vla_attention.capture.policies.family import PublishedRate
from vla_attention.schemas.errors import BadArgument

OPENPI = "gs://openpi-assets/checkpoints/pi05_libero"


@pytest.mark.parametrize(
    ("checkpoint", "suite", "expected"),
    [
        (OPENPI, None, ("libero_spatial", 494, 500)),
        (OPENPI, "libero_10", ("libero_10", 462, 500)),
        ("/scratch/me/pi05_libero/", "libero_goal", ("libero_goal", 490, 500)),
        ("lerobot/pi05_libero_finetuned", "libero_object", ("libero_object", 99, 100)),
        ("pi05_cubes", None, ("cubes", 842, 850)),
    ],
)
def test_a_checkpoint_is_known_by_its_name_or_that_of_its_folder(checkpoint, suite, expected):
    rate = find_published_rate(checkpoint, suite, default_family())
    assert (rate.suite, rate.solved, rate.episodes) == expected


def test_cosmos_has_its_own_rates():
    (family,) = (family for family in policy_families() if family.name == "cosmos")
    rate = find_published_rate("nvidia/Cosmos-Policy-LIBERO-Predict2-2B", "libero_object", family)
    assert (rate.solved, rate.episodes) == (500, 500)


def test_every_rate_is_of_a_suite_that_exists():
    for family in policy_families():
        for rate in family.published_rates:
            assert find_suite(rate.suite)
            assert 0 < rate.solved <= rate.episodes
            assert rate.source


def test_the_rate_of_the_policy_that_comes_along_is_the_measured_one():
    """docs/cubes.md has its table: the twelve tasks, two with sides, three with a fourth cube."""
    rate = find_published_rate("pi05_cubes", "cubes", default_family())
    assert (rate.solved, rate.episodes) == (598 + 48 + 46 + 150, 600 + 50 + 50 + 150)


def test_what_is_not_known_is_listed():
    with pytest.raises(BadArgument, match=r"there are rates of pi05_cubes, gs://openpi-assets.*Give --published-rate"):
        find_published_rate("my/own", None, default_family())
    with pytest.raises(
        BadArgument, match=r"of pi05_libero in the suite 'cubes' is known; it has one in libero_spatial"
    ):
        find_published_rate(OPENPI, "cubes", default_family())
    own = find_published_rate("my/own", "libero_10", default_family(), 0.9)
    assert (own.suite, own.solved, own.episodes) == ("libero_10", 450, 500)
    for share in (0.0, 1.5, -1.0, float("nan")):
        with pytest.raises(BadArgument, match="Cannot use --published-rate"):
            find_published_rate("my/own", "libero_10", default_family(), share)


@pytest.mark.parametrize("suite", SUITES, ids=lambda suite: suite.name)
def test_ten_episodes_in_every_suite(suite):
    tasks, episodes = share_of_tasks(suite.num_tasks)
    assert tasks * episodes == 10
    assert tasks <= suite.num_tasks


def test_a_policy_is_accepted_where_the_intervals_overlap():
    published = PublishedRate("a", "cubes", 842, 850, "docs/cubes.md")
    verdicts = [judge(solved, 10, published) for solved in range(11)]
    low = stats.binomtest(842, 850).proportion_ci(method="exact").low
    for solved, verdict in enumerate(verdicts):
        assert verdict.accepted is (stats.binomtest(solved, 10).proportion_ci(method="exact").high >= low), solved
    assert [verdict.accepted for verdict in verdicts] == [False] * 9 + [True] * 2
    # A policy as good as published is refused in less than one of two hundred runs.
    assert stats.binom.cdf(8, 10, 842 / 850) < 0.005


def test_the_text_says_what_was_compared_and_what_ten_episodes_can_tell():
    published = PublishedRate("a", "cubes", 842, 850, "docs/cubes.md")
    good = judge(10, 10, published).lines
    assert good[0] == "Solved 10 of 10 episodes of cubes: 100% (95 % interval 69.2% to 100.0%)."
    assert good[1] == "Published: 99.1% of 850 episodes (98.2% to 99.6%), docs/cubes.md."
    assert good[2].startswith("Accepted: the two intervals overlap")
    assert good[3].startswith("What 10 episodes can tell: 8 solved or fewer are too few; a policy that solves 66% is")
    bad = judge(3, 10, published, ["task 0 episode 0"]).lines
    assert bad[2] == "Not solved: task 0 episode 0."
    assert bad[3].startswith("NOT accepted: the interval is below the published one.")
    weak = judge(0, 10, PublishedRate("a", "cubes", 30, 100, "somewhere")).lines
    assert weak[-1] == "What 10 episodes can tell: nothing; to solve none would agree with the published rate."


@given(count=st.integers(1, 600), share=st.floats(0, 1), rate=st.floats(0, 1))
def test_the_probability_of_few_successes_is_the_binomial_one(count, share, rate):
    successes = round(share * count)
    assert at_most(successes, count, rate) == pytest.approx(stats.binom.cdf(successes, count, rate), abs=1e-9)


@given(count=st.integers(1, 600), share=st.floats(0, 1))
def test_intervals_are_those_of_clopper_and_pearson(count, share):
    successes = round(share * count)
    expected = stats.binomtest(successes, count).proportion_ci(0.95, method="exact")
    assert exact_interval(successes, count) == pytest.approx((expected.low, expected.high), abs=1e-9)


@given(count=st.integers(1, 40), rate=st.floats(0.05, 1))
def test_too_few_is_what_lies_below(count, rate):
    too_few = most_that_is_too_few(count, rate)
    assert too_few < 0 or exact_interval(too_few, count)[1] < rate
    assert too_few + 1 == count or exact_interval(too_few + 1, count)[1] >= rate
    if too_few >= 0:
        found = rate_found_in_nine_of_ten(count, too_few)
        assert stats.binom.cdf(too_few, count, found) == pytest.approx(0.9, abs=1e-6)
        assert found < rate
    else:
        assert rate_found_in_nine_of_ten(count, too_few) == 0


@pytest.mark.parametrize(("successes", "count"), [(-1, 10), (11, 10), (0, 0)])
def test_no_number_of_successes(successes, count):
    with pytest.raises(ValueError, match="is no number of successes"):
        exact_interval(successes, count)
