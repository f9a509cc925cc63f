"""Checks of the machine, on made-up machines: each line says how it stands and what to do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from vla_attention.capture.doctor.machine import (
    find_drawing,
    find_simulator,
    something_missing,
)
from vla_attention.capture.environments.libero_installation import ASSET_SUBFOLDERS, ASSETS_VARIABLE
from vla_attention.capture.environments.suites import find_suite


@pytest.mark.parametrize(
    ("code", "output", "errors", "status", "said"),
    [
        (0, '{"renderer": "NVIDIA H100/PCIe/SSE2", "varies": true}\n', "", "ok", "draws with NVIDIA H100"),
        (0, '{"renderer": "NVIDIA H100", "varies": false}\n', "", "missing", "The picture is empty."),
        (1, "", "Traceback\nImportError: Cannot initialize EGL\n", "missing", "(ImportError: Cannot initialize EGL)"),
    ],
)
def test_drawing(monkeypatch, code: int, output: str, errors: str, status: str, said: str):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    given = []

    def run(program: str, environment: Any) -> tuple[int, str, str]:
        given.append(environment["MUJOCO_GL"])
        return code, output, errors

    found = find_drawing(run)
    assert given == ["egl"]
    assert (found.status, said in found.text) == (status, True)
    assert bool(found.to_do) is (status != "ok")


@pytest.mark.simulator
def test_a_picture_is_really_drawn():
    found = find_drawing()
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
