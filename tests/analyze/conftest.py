"""Tests draw pictures as PNG of low resolution. With `--slow`, those with the mark `pdf` draw as the product does."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

DRAW = Figure.savefig


def draw_quickly(figure: Figure, file: Any, **options: Any) -> None:
    """Write a PDF's header only: drawing it takes longer than drawing the PNG."""
    if options.get("format") == "pdf":
        Path(file).write_bytes(b"%PDF-1.4\n")
    else:
        DRAW(figure, file, **options | {"dpi": 50})


@pytest.fixture(scope="session", autouse=True)
def _pictures_are_drawn_quickly() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", draw_quickly)
        yield


@pytest.fixture(autouse=True)
def _pictures_are_drawn_as_they_are(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.config.option.slow and request.node.get_closest_marker("pdf"):
        monkeypatch.setattr(Figure, "savefig", DRAW)
