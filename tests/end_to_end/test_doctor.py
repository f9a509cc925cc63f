"""`vla-attention capture doctor` on this machine: what it finds and what it misses."""

from __future__ import annotations

import re

import pytest

from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.environments.libero_assets import ASSETS_VARIABLE

pytestmark = pytest.mark.simulator


def lines_of(said: str) -> dict[str, tuple[str, str]]:
    """What was looked at -> (status, the rest of the line)."""
    found = re.findall(r"^(ok|note|MISSING) +(\w+) +(.*)$", said, re.MULTILINE)
    return {what: (status, text) for status, what, text in found}


def test_missing_assets_are_said_before_anything_is_written(tmp_path, capfd, monkeypatch):
    monkeypatch.delenv(ASSETS_VARIABLE, raising=False)
    run = ["pi", "--checkpoint", "untrained-tiny", "--task-suite", "libero_10", "--output", str(tmp_path / "a.zarr")]
    lacking = tmp_path / "assets"
    for _ in range(2):
        assert capture([*run, "--libero-assets", str(lacking)]) == 2
        assert f"'{lacking}' (--libero-assets)" in capfd.readouterr().err
        assert list(tmp_path.iterdir()) == []


def test_what_a_run_needs_and_lacks_is_exit_code_1(tmp_path, capfd, monkeypatch):
    monkeypatch.delenv(ASSETS_VARIABLE, raising=False)
    lacking = ["--libero-assets", str(tmp_path), "--output", str(tmp_path / "a.zarr")]
    assert capture(["doctor", "--task-suite", "libero_10", *lacking]) == 1
    said = capfd.readouterr().out
    found = lines_of(said)
    assert found["LIBERO"][0] == "ok"
    assert found["assets"][0] == "MISSING"
    assert "scenes" in found["assets"][1]

    assert said.endswith(": assets.\n")
    nowhere = ["--checkpoint", str(tmp_path / "nowhere"), "--output", str(tmp_path / "a.zarr")]
    assert capture(["doctor", *nowhere]) == 1
    found = lines_of(capfd.readouterr().out)
    assert (found["checkpoint"][0], str(tmp_path / "nowhere") in found["checkpoint"][1]) == ("MISSING", True)


def test_the_policy_that_comes_along_lacks_nothing(tmp_path, capfd):
    assert capture(["doctor", "--output", str(tmp_path / "a.zarr")]) == 0
    found = lines_of(capfd.readouterr().out)
    assert list(found) == ["memory", "robosuite", "drawing", "disk", "GPU", "checkpoint"]
    assert found["checkpoint"][0] == "ok"
    assert list(tmp_path.iterdir()) == []


def test_mistakes_are_named_in_one_line(capfd):
    assert capture(["doctor", "--num-episodes", "0"]) == 2
    assert re.fullmatch("vla-attention capture: .*--num-episodes 0; .* 1.*\n", capfd.readouterr().err)
