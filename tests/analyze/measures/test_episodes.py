"""Means over replans: from the masses of many episodes at once as from the table of their replans, and as loops say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from polars.testing import assert_frame_equal

from tests.kit.made_up_steps import default_grouping, make_steps, measured_of
from vla_attention.analyze.measures import episodes
from vla_attention.analyze.measures.aggregate import replan_tables
from vla_attention.analyze.measures.episodes import _Parts, episode_tables, episode_tables_of
from vla_attention.analyze.measures.frames import episode_id

GROUPING = default_grouping()


@pytest.mark.parametrize(
    ("missing", "at_once", "with_ratio"),
    [(0.0, 1, False), (0.3, 1, True), (0.3, 10_000_000, True), (1.0, 10_000_000, False)],
)
def test_masses_give_what_the_table_of_replans_gives(missing, at_once, with_ratio, monkeypatch):
    monkeypatch.setattr(episodes, "_MASSES_AT_ONCE", at_once)
    grouping = GROUPING if with_ratio else replace(GROUPING, ratio=None)
    measured = measured_of(make_steps(no_denominator=missing), grouping)
    # Episodes of different lengths, in any order.
    cut = [
        replace(
            one,
            **{name: getattr(one, name)[: 1 + i % 3] for name in ("mass", "valid_mass", "row_sum")},
            **{
                name: values[: 1 + i % 3] if len(values := getattr(one, name)) > 1 else values
                for name in ("num_keys", "num_valid", "uniform_mass")
            },
        )
        for i, one in enumerate(measured)
    ]
    for given in (measured, measured[::-1]):
        table = episode_tables(replan_tables(given, grouping), grouping)
        for part in ("cells", "groups"):
            assert_frame_equal(
                getattr(episode_tables_of(given, grouping), part), getattr(table, part), rel_tol=1e-12, abs_tol=0
            )
    for one, alone in zip(cut, (episode_tables_of([one], grouping) for one in cut), strict=True):
        key = dict(zip(("suite", "task_id", "episode_index"), episode_id(one.item), strict=True))
        together = episode_tables_of(cut, grouping)
        assert_frame_equal(together.cells.filter(**key), alone.cells, rel_tol=1e-12, abs_tol=0)
        assert_frame_equal(together.groups.filter(**key), alone.groups, rel_tol=1e-12, abs_tol=0)


def test_parts_are_reduced_as_loops_do():
    values = np.random.default_rng(0).normal(size=(12, 3))
    values[2, 0] = values[5:, 1] = values[0, 2] = np.nan
    counts = np.array([1, 4, 2, 5])
    parts = _Parts(counts)
    found = {
        "mean": parts.mean(values),
        "std": parts.std(values),
        "median": parts.median(values),
        "least": parts.extreme(np.fmin, values),
        "most": parts.extreme(np.fmax, values),
    }
    ends = np.cumsum(counts)
    for i, (start, end) in enumerate(zip(ends - counts, ends, strict=True)):
        for column in range(3):
            there = sorted(value for value in values[start:end, column] if not math.isnan(value))
            if not there:
                assert all(np.isnan(array[i, column]) for array in found.values())
                continue
            mean = sum(there) / len(there)
            middle = (there[(len(there) - 1) // 2] + there[len(there) // 2]) / 2
            spread = math.sqrt(sum((value - mean) ** 2 for value in there) / len(there))
            expected = dict(zip(found, (mean, spread, middle, there[0], there[-1]), strict=True))
            for name, value in expected.items():
                assert found[name][i, column] == pytest.approx(value, rel=1e-12, abs=1e-15), name
