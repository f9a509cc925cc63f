"""The picture of attention and effect: names can be read, and hide nothing but bars and lines below them."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.kit.reruns import PlantedRerun, knockout, write_base, write_rerun, write_series
from vla_attention.analyze.effects import plot_attention_and_effect as module
from vla_attention.analyze.effects.effect_study import study_effects
from vla_attention.analyze.measures.question_settings import AnalysisSettings

WORDS = ("the", "bowl", "put", "drawer", "stove", "plate", "turn", "open")


@pytest.fixture(scope="module")
def figure(tmp_path_factory) -> Figure:
    """The picture of many groups, some of long bars, as it is before it is saved."""
    folder = tmp_path_factory.mktemp("picture")
    base = write_base(folder)
    write_series(folder / "series", base, ("noise", "without_visual", "without_linguistic", "without_state"))
    for i, word in enumerate(WORDS):
        planted = PlantedRerun(knockout(f"without_word_{word}", f"word:{word}"), 0.1 + 0.13 * i)
        write_rerun(folder / "series" / f"without_word_{word}.zarr", base, planted)
    study = study_effects(base, [folder / "series"], AnalysisSettings())
    found: list[Figure] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "save_figure", lambda figure, *_: found.append(figure) or [])
        module.plot_attention_and_effect(study, folder)
    found[0].canvas.draw()
    return found[0]


def names_of(axes):
    return [(text, text.get_window_extent()) for text in axes.texts]


def test_every_group_has_a_name_and_no_name_hides_another_or_a_point(figure):
    for axes in figure.axes:
        names = names_of(axes)
        assert len(names) >= 9  # of eleven groups, as close points may leave no room
        for (_, one), (_, other) in combinations(names, 2):
            assert not one.overlaps(other)
        points = [line for line in axes.lines if line.get_marker() == "o"]
        assert len(points) == len(WORDS) + 3
        for point in points:
            x, y = axes.transData.transform(point.get_xydata()[0])
            assert not any(box.contains(x, y) for _, box in names)


def test_no_bar_runs_through_a_name(figure):
    for axes in figure.axes:
        bars = [line for line in axes.lines if line.get_marker() == "None" and line.get_linestyle() == "-"]
        assert len(bars) > len(WORDS)
        for text, box in names_of(axes):
            # Where a bar cannot be avoided, the name's white ground is over it.
            assert text.get_bbox_patch().get_facecolor()[:3] == (1.0, 1.0, 1.0)
            assert all(text.get_zorder() > bar.get_zorder() for bar in bars)
            own = [bar for bar in bars if crosses(axes.transData.transform(bar.get_xydata()), box)]
            assert len(own) <= 1, text.get_text()


def crosses(ends: np.ndarray, box) -> bool:
    low, high = ends.min(axis=0), ends.max(axis=0)
    return bool(low[0] <= box.x1 and high[0] >= box.x0 and low[1] <= box.y1 and high[1] >= box.y0)


def test_the_legend_stands_outside_of_the_panel(figure):
    legend = figure.axes[0].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["another noise seed"]
    assert legend.get_window_extent().y0 >= figure.axes[0].get_window_extent().y1
