"""Tests draw where they have the mark `drawn`, PNG files of low resolution; elsewhere a file has one white pixel, and
figures of tables are not even laid out.

With `--thorough` all tests and fixtures draw, and those with the mark as the product does, PDF files too.
"""

from __future__ import annotations

import io
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from vla_attention.analyze.render.style import Style

HERE, DRAW = Path(__file__).parent, Style.content


def blank(_style: Style, _canvas: Any, kind: str) -> bytes:
    """A whole file of one white pixel, and what PDF files begin with."""
    if kind == "pdf":
        return b"%PDF-1.4\n"
    buffer = io.BytesIO()
    Image.new("RGB", (1, 1), "white").save(buffer, format=kind)
    return buffer.getvalue()


def blank_figure(_figure: Any, style: Style, kinds: Sequence[str]) -> tuple[list[bytes], float]:
    return [blank(style, None, kind) for kind in kinds], style.width(wide=False)


def draw_quickly(style: Style, canvas: Any, kind: str) -> bytes:
    """A PDF's header only: drawing it takes longer than drawing the PNG."""
    canvas.set_dpi(50)
    return blank(style, canvas, kind) if kind == "pdf" else DRAW(style, canvas, kind)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Around a test and the fixtures that it sets up; those of other folders draw as they like."""
    thorough, drawn = item.config.option.thorough, item.get_closest_marker("drawn")
    with pytest.MonkeyPatch.context() as patch:
        if item.path.is_relative_to(HERE) and not (thorough and drawn):
            patch.setattr(Style, "content", draw_quickly if thorough or drawn else blank)
            if not (thorough or drawn):
                for module in ("figures", "page"):
                    patch.setattr(f"vla_attention.analyze.render.{module}.content", blank_figure)
        return (yield)
