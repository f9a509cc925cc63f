"""Pictures of tests are drawn as PNG. As PDF, which takes longer, only in tests with the mark `pdf`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure


@pytest.fixture(autouse=True)
def _pdf_files_are_headers_only(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.node.get_closest_marker("pdf"):
        return
    draw = Figure.savefig

    def save(figure: Figure, file: Any, **options: Any) -> None:
        if options.get("format") == "pdf":
            Path(file).write_bytes(b"%PDF-1.4\n")
        else:
            draw(figure, file, **options)

    monkeypatch.setattr(Figure, "savefig", save)
