"""Tests draw where they have the mark `drawn`, PNG files of low resolution; elsewhere a file has one white pixel.

With `--thorough` all tests and fixtures draw, and those with the mark as the product does, PDF files too.
"""

from __future__ import annotations

import io
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure
from PIL import Image

from vla_attention.analyze.render import style

HERE, DRAW = Path(__file__).parent, Figure.savefig


def white_pixel(kind: str) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (1, 1), "white").save(buffer, format=kind)
    return buffer.getvalue()


#: Whole files, and what PDF files begin with.
BLANK = {"png": white_pixel("PNG"), "pdf": b"%PDF-1.4\n", "webp": white_pixel("WEBP")}


def leave_blank(_figure: Figure, file: Any, **options: Any) -> None:
    content = BLANK[options["format"]]
    if isinstance(file, io.BytesIO):
        file.write(content)
    else:
        Path(file).write_bytes(content)


def draw_quickly(figure: Figure, file: Any, **options: Any) -> None:
    """Write a PDF's header only: drawing it takes longer than drawing the PNG."""
    if options.get("format") == "pdf":
        Path(file).write_bytes(BLANK["pdf"])
    else:
        DRAW(figure, file, **options | {"dpi": 50})


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Around a test and the fixtures that it sets up; those of other folders draw as they like."""
    thorough, drawn = item.config.option.thorough, item.get_closest_marker("drawn")
    with pytest.MonkeyPatch.context() as patch:
        if item.path.is_relative_to(HERE) and not (thorough and drawn):
            draws = thorough or drawn
            patch.setattr(Figure, "savefig", draw_quickly if draws else leave_blank)
            patch.setattr(style, "find_places", style.find_places if draws else lambda _canvas, _dpi: None)
        return (yield)
