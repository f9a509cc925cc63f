"""The page draws with the colours and scales of the plots and overlays, which stand in Python."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib import colormaps

from vla_attention.analyze.overlay import colours
from vla_attention.analyze.show import patch_pictures, plot_colours

SOURCE = Path(__file__).parents[3] / "analyze" / "view" / "web" / "src"
GROUPS = (SOURCE / "groups" / "colours.ts").read_text(encoding="utf-8")
MAPS = (SOURCE / "page" / "colour_maps.ts").read_text(encoding="utf-8")
STATE = (SOURCE / "page" / "state.ts").read_text(encoding="utf-8")
OVERLAY = (SOURCE / "page" / "overlay.ts").read_text(encoding="utf-8")


def test_groups_have_the_colours_of_plots():
    fixed = re.findall(r'^  (\w+): "(#\w+)",$', GROUPS, re.MULTILINE)
    assert dict(fixed) == plot_colours.FIXED_COLORS
    further = re.search(r"FURTHER = \[(.*)\]", GROUPS)
    assert further is not None
    assert tuple(re.findall(r'"(#\w+)"', further[1])) == plot_colours.FURTHER_COLORS


@pytest.mark.parametrize("name", re.findall(r"^  (\w+):$", MAPS, re.MULTILINE))
def test_colour_maps_are_those_of_matplotlib(name):
    written = re.search(rf"^  {name}:\n((?:    .*\n)+)", MAPS, re.MULTILINE)
    assert written is not None
    table = bytes.fromhex("".join(re.findall(r'"(\w+)"', written[1])))
    expected = np.round(255 * colormaps[name](np.arange(256))[:, :3]).astype(np.uint8)
    np.testing.assert_array_equal(np.frombuffer(table, np.uint8).reshape(-1, 3), expected)


def test_overlays_have_the_scale_of_pictures():
    numbers = dict(re.findall(r"^const ([A-Z_]+) = ([0-9.]+);$", OVERLAY, re.MULTILINE))
    expected = {
        "COLOUR_KEPT": colours.COLOR_KEPT,
        "NO_PICTURE": patch_pictures.NO_PICTURE,
        "TOP_QUANTILE": colours._TOP_QUANTILE,
        "LEAST_TOP": colours._LEAST_TOP,
    }
    assert {name: float(numbers[name]) for name in expected} == expected
    assert f'  colours: "{colours.COLORMAP}",\n  opacity: {colours.OPACITY},\n' in STATE
