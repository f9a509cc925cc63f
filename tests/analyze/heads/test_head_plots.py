"""Head grid, layers over time, profiles of layers and of steps: drawn for all kinds of data."""

from __future__ import annotations

import warnings

import polars as pl
import pytest

from tests.kit.made_up_steps import (
    CUSTOM_KEYS,
    custom_grouping,
    default_grouping,
    make_steps,
    many_groups,
    measured_of,
    replans_of,
)
from tests.kit.thorough import thorough_except
from vla_attention.analyze.heads.head_measures import episode_heads, heads_tables
from vla_attention.analyze.heads.head_study import denoise_tables
from vla_attention.analyze.heads.layer_time import layer_time_table
from vla_attention.analyze.heads.plot_denoise_profile import plot_denoise_profile
from vla_attention.analyze.heads.plot_head_grid import plot_head_grid
from vla_attention.analyze.heads.plot_layer_time import plot_layer_time
from vla_attention.analyze.measures.aggregate import episode_tables, task_tables
from vla_attention.analyze.measures.frames import concat_tables
from vla_attention.analyze.ratios.plot_layer_profile import plot_layer_profile
from vla_attention.analyze.statistics.episode_intervals import Sampling

CASES = {
    "one of everything": (
        {"num_tasks": 1, "num_episodes": 1, "layers": (25,), "num_replans": 1, "denoise_steps": (9,), "heads": (3,)},
        default_grouping(),
    ),
    "usual": ({"layers": tuple(range(18)), "heads": tuple(range(8)), "num_replans": 25}, default_grouping()),
    "some infinite": ({"no_denominator": 0.3, "heads": (0, 1)}, default_grouping()),
    "all infinite": ({"no_denominator": 1.0, "heads": (0, 1)}, default_grouping()),
    "no ratio": ({"grouping": custom_grouping(False), "keys": CUSTOM_KEYS, "heads": (0, 5)}, custom_grouping(False)),
    "many groups": (
        {"grouping": many_groups(22)[0], "keys": many_groups(22)[1], "layers": (3,), "heads": (0,)},
        many_groups(22)[0],
    ),
    "many of everything": (
        {"layers": tuple(range(40)), "heads": tuple(range(32)), "num_tasks": 1, "num_episodes": 2, "num_replans": 2},
        default_grouping(),
    ),
    "ten steps": ({"denoise_steps": tuple(range(10)), "layers": (1, 2), "heads": (0, 1)}, default_grouping()),
}
#: Cases that the fast part of the suite draws.
FAST = ("some infinite",)


@pytest.mark.drawn
@pytest.mark.parametrize("case", thorough_except(FAST, CASES))
def test_every_picture_of_every_case_is_drawn_without_a_warning(case, tmp_path):
    wanted, grouping = CASES[case]
    steps = make_steps(**({"grouping": grouping} | wanted))
    measured, replans = measured_of(steps, grouping), replans_of(steps, grouping)
    heads = concat_tables([episode_heads(episode, grouping) for episode in measured])
    tasks = task_tables(episode_tables(replans, grouping), grouping, Sampling())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        paths = plot_head_grid(heads_tables(heads, grouping, Sampling()), grouping, tmp_path)
        paths += plot_layer_profile(tasks, grouping, tmp_path)
        paths += plot_layer_time(layer_time_table(replans, grouping, Sampling()), replans, grouping, tmp_path)
        paths += plot_denoise_profile(denoise_tables(measured, grouping, Sampling()), grouping, tmp_path)
    # Layers over time are one table; each of the others is one of cells and one of groups.
    stems = ("head_grid", "layer_profile", "layer_time", "denoise_profile")
    expected = [f"{stem}{end}" for stem in stems for end in (".png", ".pdf", ".csv", "_groups.csv")]
    expected.remove("layer_time_groups.csv")
    assert [path.name for path in paths] == expected
    for path in paths:
        assert path.stat().st_size > 0
        if path.suffix == ".csv":
            assert pl.read_csv(path).height > 0
