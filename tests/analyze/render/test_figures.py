"""Figures of hard frames: no text touches another or leaves the picture, nothing that is drawn is hidden."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import polars as pl
import pytest
from matplotlib.collections import LineCollection, PathCollection

from vla_attention.analyze.core.result import Figure
from vla_attention.analyze.render.figures import draw
from vla_attention.analyze.render.style import Style, group_styles, ratio_axis

WORDS = ["put", "both", "the", "alphabet", "soup", "and", "tomato", "sauce", "cream", "cheese", "box", "butter", "in",
         "basket", "turn", "on", "stove", "moka", "pot", "pan"]  # fmt: skip
STYLES = [Style(), Style("paper"), Style(inches=5.4)]


def with_ends(value: np.ndarray, factor: np.ndarray | float) -> dict[str, np.ndarray]:
    return {"value": value, "value_low": value / factor, "value_high": value * factor}


def forest(rows: int = 10) -> Figure:
    """Tasks with long instructions; the interval of the first one is far wider than all values."""
    names = [f"{i}: {' '.join(WORDS[i % 5 : i % 5 + 4 + i])}" for i in range(rows)]
    value = np.exp(np.linspace(-1, 2, rows))
    frame = pl.DataFrame({"task": names, **with_ends(value, 1.2 + 20 * (np.arange(rows) == 0))})
    spread = np.exp(0.5 * np.random.default_rng(0).normal(size=(rows, 30))) * value[:, None]
    dots = pl.DataFrame({"task": np.repeat(names, 30), "value": spread.ravel()})
    frame = frame.with_columns(even=pl.lit(1.0), num_episodes=pl.Series(range(rows)) + 30)
    options = {"value": "value", "label": "task", "dots": dots, "log": True, "uniform": "even",
               "baseline_name": "if spread evenly", "xlabel": "visual / linguistic (logarithmic)"}  # fmt: skip
    return Figure("forest", "forest", frame, "Ratio " + " + ".join(WORDS), options=options)


def stacked(groups: list[str], layers: int = 18) -> Figure:
    shares = np.random.default_rng(0).dirichlet(np.ones(len(groups)), layers + 1)
    shares[:, 1] = 0  # nothing is drawn of it
    frame = pl.DataFrame(
        {
            "layer": np.repeat([*map(str, range(layers)), "layers_avg"], len(groups)),
            "group": groups * (layers + 1),
            **with_ends(shares.ravel(), 1.1),
        }
    )
    options = {"x": "layer", "value": "value", "color": "group", "mean": "layers_avg", "num_episodes": 500}
    return Figure("stacked", "stacked", frame, "How attention is divided", options=options)


def courses(series: int = 6) -> Figure:
    """Intervals of every other series span everything."""
    names, phases = [*WORDS[:series], "another noise seed"], np.linspace(0.05, 0.95, 10)
    value = np.exp(np.random.default_rng(0).normal(size=(len(names), 10)))
    wide = np.where(np.arange(len(names)) % 2, 1e6, 1.3)
    frame = pl.DataFrame(
        {
            "label": np.repeat(names, 10),
            "phase": np.tile(phases, len(names)),
            **with_ends(value.ravel(), np.repeat(wide, 10)),
            "num_episodes": 500,
        }
    )
    options = {"x": "phase", "value": "value", "label": "label", "reference": "another noise seed"}
    return Figure("courses", "courses", frame, "Over an episode", options=options)


def scatter(points: int = 20) -> Figure:
    """Points in a cloud, some at one place, with bars over many orders."""
    generator = np.random.default_rng(0)
    x, y = (np.exp(spread * generator.normal(size=points)) for spread in (0.3, 2))
    x[:3], y[:3] = x[0], y[0]
    frame = pl.DataFrame({"word": WORDS[:points], "x": x, **with_ends(y, np.exp(3 * generator.random(points)))})
    frame = frame.with_columns(num_episodes=pl.int_range(pl.len()) + 1)
    options = {"x": "x", "y": "value", "label": "word", "x_baseline": 1.0, "baseline": 0.5, "baseline_name": "noise"}
    return Figure("scatter", "scatter", frame, "Attention and effect", options=options)


FIGURES = [forest(), forest(3), stacked(WORDS[:13]), stacked(["visual", "linguistic", "action"], 2), courses(),
           courses(2), scatter(), scatter(3)]  # fmt: skip


def texts_of(canvas: Any) -> Iterator[Any]:
    """All texts that show; ticks beyond the ends of their axis do not."""
    (axes,) = canvas.axes
    for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        for tick in axis.get_major_ticks():
            if min(limits) <= tick.get_loc() <= max(limits):
                yield tick.label1
        yield axis.label
    legends = [*canvas.legends, *([axes.get_legend()] if axes.get_legend() else [])]
    yield from (text for legend in legends for text in (*legend.get_texts(), legend.get_title()))
    yield from (*axes.texts, *canvas.texts)


@pytest.mark.parametrize("style", STYLES, ids=["screen", "paper", "page"])
@pytest.mark.parametrize("figure", FIGURES, ids=lambda figure: f"{figure.kind}_{figure.frame.height}")
def test_no_text_touches_another_or_leaves_the_picture(figure: Figure, style: Style) -> None:
    canvas = draw(figure, style)
    with style.settings():
        canvas.canvas.draw()
    shown = [(text.get_text(), text.get_window_extent()) for text in texts_of(canvas) if text.get_text()]
    assert len(shown) > 6
    for name, box in shown:
        assert (box.min >= 0).all(), name
        assert (box.max <= canvas.bbox.max + 1).all(), name
    for (one, box), (other, beside) in combinations(shown, 2):
        assert not box.padded(-1).overlaps(beside), (one, other)  # a box is as high as the font's highest letter


@pytest.mark.parametrize("style", STYLES, ids=["screen", "paper", "page"])
def test_every_episode_shows_beside_the_interval_of_its_row(style: Style) -> None:
    canvas = draw(forest(), style)
    (axes,) = canvas.axes
    bars = [one for one in axes.collections if isinstance(one, LineCollection) and len(one.get_segments()) == 10]
    at = {round(y, 6): line for line in bars[0].get_segments() for y in line[:1, 1]}
    dots = [one for one in axes.collections if isinstance(one, PathCollection) and len(one.get_offsets()) == 30]
    pixels = canvas.dpi / 72
    half_bar, radius = bars[0].get_linewidth()[0] / 2 * pixels, np.sqrt(dots[0].get_sizes()[0]) / 2 * pixels
    middles = np.sort(axes.transData.transform([(1, y) for y in at])[:, 1])[::-1]
    assert len(dots) == len(middles) == 10
    for middle, row in zip(middles, dots, strict=True):
        of_row = axes.transData.transform(row.get_offsets())[:, 1]
        assert (np.abs(of_row[:, None] - middles) > half_bar + radius).all()
        assert (of_row < middle).all()
        assert row.get_zorder() >= bars[0].get_zorder()


@pytest.mark.parametrize("style", STYLES, ids=["screen", "paper", "page"])
def test_names_of_points_cover_no_bar_and_no_point(style: Style) -> None:
    figure = scatter()
    canvas = draw(figure, style)
    (axes,) = canvas.axes
    names = [text for text in axes.texts if text.get_text() in WORDS]
    assert 6 <= len({text.get_text() for text in names}) == len(names)
    frame = axes.get_window_extent()
    ends = [axes.transData.transform(figure.frame.select("x", y).to_numpy()) for y in ("value_low", "value_high")]
    points = axes.transData.transform(figure.frame.select("x", "value").to_numpy())
    for text in names:
        box = text.get_window_extent()
        assert (box.min >= frame.min).all()
        assert (box.max <= frame.max).all()
        for (x, low), (_, high) in zip(*ends, strict=True):
            assert not (box.x0 <= x <= box.x1 and box.y0 <= high and box.y1 >= low), text.get_text()
        assert not any(box.contains(x, y) for x, y in points)
    assert figure.frame.sort("value")["word"][-1] in {text.get_text() for text in names}


def test_bands_of_courses_share_no_place_and_the_reference_is_in_every_strip() -> None:
    figure = courses()
    (axes,) = draw(figure).axes
    strips = [line for line in axes.lines if line.get_marker() == "o" and len(line.get_xdata()) == 10]
    dashed = [line for line in axes.lines if line.get_linestyle() == "--"]
    assert [line.get_ydata().tolist() for line in strips] == [
        figure.frame.filter(label=name)["value"].to_list() for name in WORDS[:6]
    ]
    of_noise = figure.frame.filter(label="another noise seed")["value"].to_list()
    assert [line.get_ydata().tolist() for line in dashed] == [of_noise] * 6
    for one, other in zip(strips, dashed, strict=True):
        np.testing.assert_array_equal(one.get_xdata(), other.get_xdata())
    bands = [one.get_datalim(axes.transData) for one in axes.collections]
    filled = sorted({(round(band.x0, 9), round(band.x1, 9)) for band in bands})
    assert len(filled) == 6
    assert all(one[1] < other[0] for one, other in pairwise(filled))


def test_groups_are_named_as_they_are_stacked_and_the_mean_stands_apart() -> None:
    groups = ["visual", "unseen", "linguistic", "b", "c"]
    (axes,) = draw(stacked(groups)).axes
    drawn = [name for name in groups if name != "unseen"]
    assert [text.get_text().split()[0] for text in axes.get_legend().get_texts()] == drawn[::-1]
    for name, bars in zip(drawn, axes.containers, strict=True):
        colors = {tuple(bar.get_facecolor()) for bar in bars}
        (color,) = {"#" + "".join(f"{round(255 * part):02X}" for part in one[:3]) for one in colors}
        assert color == group_styles(groups)[name]["color"]  # those of groups that get nothing stay theirs
    gaps = np.diff([bar.get_x() for bar in axes.containers[0]])
    assert gaps[-1] > 1.5 * gaps[:-1].max()
    assert np.ptp(gaps[:-1]) < 1e-9


@pytest.mark.parametrize("low", [0.72, 0.05, 3.0, 1.0])
@pytest.mark.parametrize("factor", [1.0, 1.9, 4.0, 30.0, 300.0, 1e5])
@pytest.mark.parametrize("width", [3.35, 8.4])
def test_a_logarithmic_axis_has_two_numbers_that_do_not_touch(low: float, factor: float, width: float) -> None:
    style = Style()
    with style.settings():
        canvas = style.canvas(width, 2)
        axes = canvas.add_axes((0.4, 0.3, 0.5, 0.6))
        ratio_axis(axes.xaxis, [low, low * factor])
        canvas.canvas.draw()
        ticks = [tick.label1 for tick in axes.xaxis.get_major_ticks()]
    boxes = [tick.get_window_extent() for tick in ticks]
    left, right = axes.get_window_extent().intervalx
    inside = [box for box in boxes if left <= (box.x0 + box.x1) / 2 <= right]
    assert len(inside) >= 2
    assert all(one.x1 < other.x0 for one, other in pairwise(inside))
