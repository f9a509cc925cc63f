"""Head grid, layers over time, profiles of layers and denoise steps: drawn for every kind of data, and true to it."""

from __future__ import annotations

import warnings

import numpy as np
import polars as pl
import pytest

from tests.kit.made_up_steps import CUSTOM_KEYS, custom_grouping, default_grouping, make_steps, many_groups
from vla_attention.analyze.heads.denoise import denoise_table
from vla_attention.analyze.heads.head_measures import heads_table
from vla_attention.analyze.heads.layer_time import layer_time_table
from vla_attention.analyze.heads.plot_denoise_profile import plot_denoise_profile
from vla_attention.analyze.heads.plot_head_grid import plot_head_grid
from vla_attention.analyze.heads.plot_layer_time import plot_layer_time
from vla_attention.analyze.measures.aggregate import add_layers_avg, episodes_table, per_replan, tasks_table
from vla_attention.analyze.ratios.plot_layer_profile import plot_layer_profile
from vla_attention.analyze.show.plot_colours import diverging_colors
from vla_attention.analyze.show.plot_heat_map import draw_log2_map
from vla_attention.analyze.show.plot_style import new_figure
from vla_attention.schemas.groupings.grouping import Grouping

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
#: Cases that are drawn as PDF too.
AS_PDF = ("some infinite", "many groups")


def heads_of(steps: pl.DataFrame, grouping: Grouping) -> pl.DataFrame:
    """A table of heads from made-up steps: the measures of `head_frame` recomputed in polars."""
    keys = ["suite", "task_id", "episode_index", "layer", "block", "head"]
    per = steps.group_by(*keys, "replan").agg(
        pl.col("^.*_(mass|keys|lift|fraction)$").mean(), pl.col("^uniform_ratio$").first()
    )
    columns = [pl.col(f"{name}_{kind}").mean() for name in grouping.names for kind in ("fraction", "lift")]
    if grouping.ratio is not None:
        ratio = pl.col("numerator_mass") / pl.col("denominator_mass")
        log2 = ratio.log(2.0)
        per = per.with_columns(log2.alias("log2_ratio"), (log2 - pl.col("uniform_ratio").log(2.0)).alias("log2_lift"))
        finite = pl.col("log2_ratio").is_finite()
        columns += [pl.col(name).filter(finite).mean() for name in ("log2_ratio", "log2_lift")]
        columns += [pl.col(f"{side}_mass").mean() for side in ("numerator", "denominator")]
        columns += [pl.col(f"{side}_mass").mean().alias(f"{side}_fraction") for side in ("numerator", "denominator")]
        columns += [(~finite).sum().cast(pl.Int64).alias("num_nonfinite")]
    return heads_table(per.group_by(keys).agg(*columns).sort(keys), grouping)


@pytest.mark.parametrize("case", [pytest.param(case, marks=[pytest.mark.pdf] * (case in AS_PDF)) for case in CASES])
def test_every_picture_of_every_case_is_drawn_without_a_warning(case, tmp_path):
    wanted, grouping = CASES[case]
    steps = make_steps(**({"grouping": grouping} | wanted))
    replans = add_layers_avg(per_replan(steps, grouping), grouping)
    tasks = tasks_table(episodes_table(replans, grouping), grouping, num_resamples=50)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        paths = plot_head_grid(heads_of(steps, grouping), grouping, tmp_path)
        paths += plot_layer_profile(tasks, grouping, tmp_path)
        paths += plot_layer_time(replans, grouping, tmp_path)
        paths += plot_denoise_profile(denoise_table(steps, grouping), grouping, tmp_path)
    stems = ("head_grid", "layer_profile", "layer_time", "denoise_profile")
    assert [path.name for path in paths] == [f"{stem}.{kind}" for stem in stems for kind in ("png", "pdf", "csv")]
    for path in paths:
        assert path.stat().st_size > 0
        if path.suffix == ".csv":
            assert pl.read_csv(path).height > 0


def test_layers_over_time_are_means_over_episodes_of_what_each_part_of_the_time_holds():
    grouping = default_grouping()
    steps = make_steps(layers=(3, 4), num_replans=6, num_tasks=2, num_episodes=2)
    # Every replan lasts five steps, so that three parts of the time hold two replans each.
    replans = add_layers_avg(per_replan(steps.with_columns(num_steps=pl.lit(30)), grouping), grouping)
    table = layer_time_table(replans, grouping, num_bins=3)
    assert table.height == 2 * 3
    for row in table.iter_rows(named=True):
        part = replans.filter(
            pl.col("layer") == row["layer"], pl.col("replan").is_in([2 * row["bin"], 2 * row["bin"] + 1])
        )
        by_episode = part.group_by("task_id", "episode_index").agg(pl.col("ratio_lift").log(2.0).mean())
        assert row["mean"] == pytest.approx(by_episode["ratio_lift"].mean())
        assert row["low"] < row["mean"] < row["high"]
        assert row["num_episodes"] == 4


def test_colours_are_even_at_the_baseline_and_infinite_cells_say_so():
    colors = diverging_colors()
    less, even, more = colors(0.0), colors(0.5), colors(1.0)
    assert min(even[:3]) > 0.9
    assert less[0] > less[2]
    assert more[2] > more[0]
    figure = new_figure(4, 3)
    axes = figure.subplots()
    values = np.array([[np.inf, -np.inf, np.nan], [1.0, -2.0, 0.0]])
    draw_log2_map(figure, axes, values, np.ones((2, 3), dtype=bool), "times")
    assert [text.get_text() for text in axes.texts] == ["∞", "0", "2", "1/4", "1"]
    image = axes.get_images()[0]
    assert image.get_clim() == (-2.0, 2.0)
    dots = axes.collections[0].get_offsets()
    assert len(dots) == 3  # finite cells only
