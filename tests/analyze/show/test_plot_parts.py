"""Colours and axes that plots share."""

from __future__ import annotations

from tests.kit.made_up_steps import many_groups
from vla_attention.analyze.show.plot_axes import label_positions, legend_above, ratio_axis, share_ticks, uniform_line
from vla_attention.analyze.show.plot_colours import FIXED_COLORS, group_styles
from vla_attention.analyze.show.plot_rows import draw_estimate, label_rows, legend_of_rows
from vla_attention.analyze.show.plot_style import new_figure


def test_groups_keep_their_colours_and_no_two_look_alike():
    grouping, _ = many_groups(30)
    styles = group_styles(grouping.names)
    assert styles["linguistic"]["color"] == FIXED_COLORS["linguistic"]
    looks = [(style["color"], style["hatch"]) for style in styles.values()]
    assert len(set(looks)) == len(looks)
    assert group_styles(("visual", "mine"))["visual"] == group_styles(("visual",))["visual"]


def test_axis_of_nearly_equal_ratios_is_not_blown_up():
    axes = new_figure(4, 3).subplots()
    ratio_axis(axes.xaxis, [10.0, 10.001])
    low, high = axes.get_xlim()
    assert high / low > 1.9


def test_labels_that_would_touch_are_left_out():
    axes = new_figure(4, 3).subplots()
    label_positions(axes.xaxis, [str(i) for i in range(10)], 4)
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0", "3", "6", "9"]
    share_ticks(axes.yaxis, 3)
    assert [label.get_text() for label in axes.get_yticklabels()] == ["0%", "50%", "100%"]


def test_the_line_of_uniform_attention_is_in_the_legend_above_the_axes():
    axes = new_figure(4, 3).subplots()
    uniform_line(axes, 2.0, label="uniform attention")
    legend_above(axes)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["uniform attention"]


def test_rows_of_estimates_have_a_bar_only_where_there_is_an_interval():
    axes = new_figure(4, 3).subplots()
    draw_estimate(axes, 0, 2.0, (1.0, 3.0))
    draw_estimate(axes, 1, 2.5, (None, None), few=False)
    bar, point, alone = axes.get_lines()
    assert [list(bar.get_xdata()), list(bar.get_ydata())] == [[1.0, 3.0], [0, 0]]
    assert point.get_markersize() > alone.get_markersize()
    label_rows(axes, ["first", "second"])
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # the first one stands at the top
    legend_of_rows(axes, 2, "mean", dots="single episode")
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["mean", "single episode"]
