"""Marks of profiles and of layers over time: whole inside their axes, no line without a value, no needless note."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tests.kit.made_up_steps import CUSTOM_KEYS, custom_grouping, default_grouping, make_steps, replans_of
from vla_attention.analyze.heads import plot_layer_time as layer_time
from vla_attention.analyze.heads.layer_time import layer_time_table
from vla_attention.analyze.measures.aggregate import episode_tables, overall_rows, task_tables
from vla_attention.analyze.measures.frames import LAYERS_AVG
from vla_attention.analyze.ratios.plot_profile_panels import draw_profile
from vla_attention.analyze.show.plot_heat_map import draw_log2_map, map_height
from vla_attention.analyze.show.plot_style import new_figure
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.schemas.groupings.grouping import Grouping


def drawn(steps: pl.DataFrame, grouping: Grouping):
    """The axes of a profile over layers, laid out."""
    replans = replans_of(steps, grouping)
    tasks = overall_rows(task_tables(episode_tables(replans, grouping), grouping, Sampling()))
    level = tasks.filter(pl.col("layer") != LAYERS_AVG)
    figure = new_figure(7, 5)
    draw_profile(figure, level, grouping, level.cells["layer"].to_list(), "layer", 0.95)
    figure.canvas.draw()
    return figure.axes, level.cells.sort("layer_number")


@pytest.mark.parametrize("layers", [(7,), (0, 1), tuple(range(18))])
@pytest.mark.parametrize("with_ratio", [True, False])
def test_every_marker_of_a_fraction_is_whole(layers, with_ratio):
    grouping = custom_grouping(with_ratio)
    for steps in (
        make_steps(grouping, CUSTOM_KEYS, layers=layers),
        make_steps(grouping, CUSTOM_KEYS, layers=layers, num_tasks=1, num_episodes=1, num_replans=1),
    ):
        axes, _ = drawn(steps, grouping)
        low, high = axes[-1].transAxes.transform([(0, 0), (1, 1)])
        for line in axes[-1].lines:
            radius = line.get_markersize() / 2 * axes[-1].figure.dpi / 72
            points = axes[-1].transData.transform(np.column_stack([line.get_xdata(), line.get_ydata()]))
            assert (points >= low + radius).all()
            assert (points <= high - radius).all()


def test_markers_of_one_position_stand_near_their_label():
    axes, _ = drawn(make_steps(layers=(7,)), default_grouping())
    places = np.concatenate([line.get_xdata() for line in axes[-1].lines])
    assert np.ptp(places) < 0.1
    assert len(set(places)) == len(places)


def test_the_line_of_ratios_breaks_where_a_layer_has_none():
    steps = make_steps(layers=(1, 2, 3, 4))
    hit = pl.col("layer") == 3
    steps = steps.with_columns(pl.when(hit).then(0.0).otherwise(pl.col("linguistic_mass")).alias("linguistic_mass"))
    axes, rows = drawn(steps, default_grouping())
    heights = np.asarray(axes[0].lines[0].get_ydata(), dtype=float)
    assert np.isnan(heights).tolist() == [False, False, True, False]
    np.testing.assert_allclose(heights[[0, 1, 3]], rows["geometric_mean"].to_numpy()[[0, 1, 3]])


def test_a_note_on_grey_cells_only_where_there_are_some(tmp_path, monkeypatch):
    titles: list[str] = []

    def keep(figure, folder: Path, stem: str, data: pl.DataFrame) -> list[Path]:
        titles.append(" ".join(figure.get_suptitle().split()))
        return []

    monkeypatch.setattr(layer_time, "save_figure", keep)
    grouping = default_grouping()
    some = make_steps(num_tasks=1, num_episodes=1)
    early = pl.col("replan") == 0
    some = some.with_columns(pl.when(early).then(0.0).otherwise(pl.col("linguistic_mass")).alias("linguistic_mass"))
    for steps in (make_steps(), make_steps(no_denominator=1.0), some):
        replans = replans_of(steps, grouping)
        layer_time.plot_layer_time(layer_time_table(replans, grouping, Sampling()), replans, grouping, tmp_path)
    assert ["Grey" in title for title in titles] == [False, False, True]


@pytest.mark.parametrize(
    ("rows", "columns", "width"), [(1, 1, 5.6), (5, 10, 6.4), (5, 12, 6.4), (3, 20, 6.4), (4, 16, 7.84)]
)
def test_numbers_in_cells_never_touch(rows, columns, width):
    figure = new_figure(width, max(2.7, 1.6 + map_height(rows, columns)))
    axes = figure.subplots()
    values = np.full((rows, columns), -np.log2(1.51))
    draw_log2_map(figure, axes, values, np.ones((rows, columns), dtype=bool), "times uniform attention")
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in axes.texts]
    cell = np.abs(axes.transData.transform((1, 1)) - axes.transData.transform((0, 0)))
    assert all(box.width < 0.98 * cell[0] and box.height < 0.7 * cell[1] for box in boxes)
    assert {text.get_text() for text in axes.texts} <= {"1/1.51"}
    assert (len(boxes) > 0) == (columns <= 12)
    # The colour bar's label stays in the picture, however low the map is.
    label = figure.axes[-1].yaxis.label.get_window_extent()
    assert label.y0 >= 0
    assert label.y1 <= figure.bbox.height
    assert label.x1 <= figure.bbox.width


def test_a_value_that_rounds_to_one_is_written_as_one():
    figure = new_figure(5, 3)
    axes = figure.subplots()
    draw_log2_map(figure, axes, np.array([[-1e-4, 1e-4, -1.0]]), np.zeros((1, 3), dtype=bool), "times")
    assert [text.get_text() for text in axes.texts] == ["1", "1", "1/2"]
