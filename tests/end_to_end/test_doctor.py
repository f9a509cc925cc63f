"""`vla-attention capture doctor` on this machine: what it finds, what it misses, and which policies it accepts."""

from __future__ import annotations

import re

import pytest

from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.environments.libero_installation import ASSETS_VARIABLE

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
        assert f"The LIBERO asset folder '{lacking}' (--libero-assets) does not exist" in capfd.readouterr().err
        assert list(tmp_path.iterdir()) == []


def test_what_a_run_needs_and_lacks_is_exit_code_1(tmp_path, capfd, monkeypatch):
    monkeypatch.delenv(ASSETS_VARIABLE, raising=False)
    lacking = ["--libero-assets", str(tmp_path), "--output", str(tmp_path / "a.zarr")]
    assert capture(["doctor", "--no-trial", "--task-suite", "libero_10", *lacking]) == 1
    said = capfd.readouterr().out
    found = lines_of(said)
    assert found["assets"][0] == "MISSING"
    assert "lacks scenes" in found["assets"][1]

    assert said.endswith("The run cannot be made as described: assets.\n")
    nowhere = ["--checkpoint", str(tmp_path / "nowhere"), "--output", str(tmp_path / "a.zarr")]
    assert capture(["doctor", *nowhere]) == 1
    found = lines_of(capfd.readouterr().out)
    assert found["checkpoint"] == ("MISSING", f"There is no checkpoint folder at '{tmp_path / 'nowhere'}'.")
    assert "size" not in found


@pytest.mark.thorough
def test_the_policy_that_comes_along_is_accepted(tmp_path, capfd):
    store = tmp_path / "kept.zarr"
    assert capture(["doctor", "--accept", "pi05_cubes", "--output", str(store), "--layers", "3", "--no-frames"]) == 0
    said = capfd.readouterr().out
    assert re.search(r"^Solved (9|10) of 10 episodes of cubes", said, re.MULTILINE)
    assert "Published: 99.1% of 850 episodes (98.2% to 99.6%), docs/cubes.md." in said
    assert "Accepted: " in said
    assert len([path for path in (store / "episodes").iterdir() if path.is_dir()]) == 10


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--accept", "my/own"], "No success rate of the checkpoint 'my/own' is known; there are rates of pi05_cubes"),
        (["--accept", "pi05_cubes", "--num-episodes", "0"], "Cannot use --num-episodes 0; expected at least 1."),
    ],
)
def test_mistakes_are_one_sentence(words: list[str], said: str, capfd):
    assert capture(["doctor", *words]) == 2
    printed = capfd.readouterr().err
    assert printed.startswith(f"vla-capture: {said}")
    assert printed.count("\n") == 1
