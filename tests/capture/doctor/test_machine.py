"""Checks of the machine, on made-up machines: each line says how it stands and what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_attention.capture.doctor.machine import (
    find_drawing,
    find_simulator,
    something_missing,
)
from vla_attention.capture.environments.base import Suite
from vla_attention.capture.environments.libero_installation import ASSET_SUBFOLDERS, ASSETS_VARIABLE
from vla_attention.capture.environments.robosuite_installation import CannotDraw
from vla_attention.capture.environments.suites import find_suite


@pytest.mark.parametrize(
    ("renderer", "status"), [("NVIDIA H100/PCIe/SSE2", "ok"), ("llvmpipe (LLVM 15)", "note"), (None, "missing")]
)
def test_drawing(renderer: str | None, status: str):
    def draw(suite: Suite, libero_assets: Path | None) -> str:
        if renderer is None:
            raise CannotDraw("EGL_BAD_DISPLAY. Do this.")
        return renderer

    found = find_drawing(find_suite("cubes"), None, draw)
    assert (found.status, (renderer or "EGL_BAD_DISPLAY. Do this.") in found.text) == (status, True)


@pytest.mark.simulator
def test_a_picture_is_really_drawn():
    found = find_drawing(find_suite("cubes"), None)
    assert found.status in ("ok", "note"), found.describe()
    assert "draws with" in found.text


def test_assets_are_missing_only_where_the_suite_needs_them(tmp_path: Path, monkeypatch):
    monkeypatch.delenv(ASSETS_VARIABLE, raising=False)
    empty, whole = tmp_path / "empty", tmp_path / "whole"
    empty.mkdir()
    for name in ASSET_SUBFOLDERS:
        (whole / name).mkdir(parents=True)
    by_name = {finding.what: finding for finding in find_simulator(find_suite("libero_10"), empty)}
    assert by_name["LIBERO"].status == "ok"
    assert (by_name["assets"].status, "lacks scenes" in by_name["assets"].text) == ("missing", True)
    assert not something_missing(find_simulator(find_suite("libero_10"), whole))
    assert not something_missing(find_simulator(find_suite("cubes"), empty))
