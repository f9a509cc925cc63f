"""Rates of a store, and Wilson's interval against scipy."""

from __future__ import annotations

import pytest
from scipy import stats

from examples.cubes_policy.__main__ import main
from examples.cubes_policy.rates import wilson_interval
from tests.kit.stores import write_store
from vla_attention.capture.__main__ import main as capture


@pytest.mark.parametrize(("successes", "count"), [(0, 1), (1, 1), (3, 7), (598, 600), (600, 600)])
def test_the_interval_is_that_of_scipy(successes, count) -> None:
    expected = stats.binomtest(successes, count).proportion_ci(0.95, method="wilson")
    assert wilson_interval(successes, count) == pytest.approx((expected.low, expected.high), abs=1e-6)


@pytest.mark.simulator
def test_the_rates_of_a_capture(tmp_path, capsys) -> None:
    store = str(tmp_path / "cubes.zarr")
    where = ["--task-suite", "cubes", "--task-id", "0", "12", "--num-episodes", "1", "--max-steps", "2"]
    assert capture(["pi", "--checkpoint", "untrained-tiny", *where, "--num-envs", "1", "--output", store]) == 0
    capsys.readouterr()
    assert main(["rates", store]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert [row[1:3] for row in rows] == [["1", "0.0%"], ["1", "0.0%"], ["2", "0.0%"]]


def test_a_store_of_another_suite_has_none(tmp_path, capsys) -> None:
    assert main(["rates", str(write_store(tmp_path / "a.zarr"))]) == 2
    assert "cubes" in capsys.readouterr().err
