from __future__ import annotations

import warnings

import polars as pl
import pytest

from tests.kit.made_up_steps import CUSTOM_KEYS, custom_grouping, default_grouping, make_steps, many_groups, replans_of
from tests.kit.thorough import thorough_except
from vla_attention.analyze.measures.aggregate import episode_tables, task_tables
from vla_attention.analyze.ratios.plot_attention_fractions import plot_attention_fractions
from vla_attention.analyze.ratios.plot_ratio_distribution import plot_ratio_distribution
from vla_attention.analyze.ratios.plot_ratio_evolution import evolution_stem, plot_all_evolutions, plot_ratio_evolution
from vla_attention.analyze.ratios.plot_ratio_per_task import plot_ratio_per_task
from vla_attention.analyze.statistics.episode_intervals import Sampling


def only_zero_ratios():
    zero = [pl.lit(0.0).alias(name) for name in ("visual_mass", "numerator_mass")]
    return make_steps().with_columns(zero)


def mixed_layers():
    """One layer is infinite throughout, the others are not."""
    hit = pl.col("layer") == 25
    names = ("linguistic_mass", "denominator_mass")
    return make_steps().with_columns(pl.when(hit).then(0.0).otherwise(pl.col(name)).alias(name) for name in names)


CASES = {
    "one of everything": lambda: (
        make_steps(num_tasks=1, num_episodes=1, layers=(25,), num_replans=1),
        default_grouping(),
    ),
    "some infinite": lambda: (make_steps(layers=tuple(range(6)), no_denominator=0.2), default_grouping()),
    "all infinite": lambda: (make_steps(no_denominator=1.0), default_grouping()),
    "all zero": lambda: (only_zero_ratios(), default_grouping()),
    "a layer infinite": lambda: (mixed_layers(), default_grouping()),
    "custom": lambda: (make_steps(custom_grouping(), CUSTOM_KEYS), custom_grouping()),
    "no ratio": lambda: (make_steps(custom_grouping(False), CUSTOM_KEYS), custom_grouping(False)),
    "many groups": lambda: (make_steps(*many_groups(22), num_tasks=1, layers=(3,)), many_groups(22)[0]),
    "two suites": lambda: (pl.concat([make_steps(), make_steps(suite="libero_goal")]), default_grouping()),
    "ninety tasks": lambda: (
        make_steps(num_tasks=90, num_episodes=2, layers=(3,), num_replans=2),
        default_grouping(),
    ),
}
#: Cases that the fast part of the suite draws.
FAST = ("some infinite",)


@pytest.mark.drawn
@pytest.mark.parametrize("case", thorough_except(FAST, CASES))
def test_every_picture_of_every_case_is_drawn_without_a_warning(case, tmp_path):
    steps, grouping = CASES[case]()
    replans = replans_of(steps, grouping)
    episodes = episode_tables(replans, grouping)
    tasks = task_tables(episodes, grouping, Sampling())
    with warnings.catch_warnings():
        # Layout that does not fit, missing glyphs and empty limits are warnings of matplotlib.
        warnings.simplefilter("error")
        paths = plot_ratio_distribution(replans.cells, grouping, tmp_path)
        paths += plot_ratio_per_task(episodes.cells, tasks.cells, grouping, tmp_path)
        paths += plot_attention_fractions(tasks, grouping, tmp_path)
        first = replans.cells.row(0, named=True)
        one = replans.filter(*(pl.col(name) == first[name] for name in ("suite", "task_id", "episode_index", "layer")))
        paths += plot_ratio_evolution(one, grouping, tmp_path)
    stems = ["ratio_distribution", "ratio_per_task", "attention_fractions"]
    stems.append(evolution_stem(0, first["instruction"], 0, first["layer"]))
    names = [f"{stem}.{kind}" for stem in stems for kind in ("png", "pdf", "csv")]
    assert [path.name for path in paths] == [*names, f"{stems[-1]}_groups.csv"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in paths)
    for path in paths:
        start = path.read_bytes()[:5]
        assert {".png": start == b"\x89PNG\r", ".pdf": start == b"%PDF-", ".csv": True}[path.suffix]
        if path.suffix == ".csv":
            assert pl.read_csv(path).height > 0


def test_data_beside_the_picture_are_those_of_the_picture(tmp_path):
    grouping = default_grouping()
    replans = replans_of(make_steps(), grouping).cells
    plot_ratio_distribution(replans, grouping, tmp_path)
    data = pl.read_csv(tmp_path / "ratio_distribution.csv")
    assert data.height == replans.height
    assert data["ratio"].to_list() == pytest.approx(replans["ratio"].to_list())


@pytest.mark.thorough
def test_all_evolutions_keep_suites_apart(tmp_path):
    grouping = default_grouping()
    small = {"num_tasks": 1, "num_episodes": 1, "layers": (3, 4), "num_replans": 2}
    steps = pl.concat([make_steps(**small), make_steps(**small, suite="libero_goal")])
    replans = replans_of(steps, grouping)
    done = []
    paths = plot_all_evolutions(replans, grouping, tmp_path, formats=("png",), progress=done.append)
    assert len(done) == 2 * 3
    assert len(set(paths)) == len(paths) == 2 * 3 * 3
    assert {path.parent.name for path in paths} == {"libero_10", "libero_goal"}
