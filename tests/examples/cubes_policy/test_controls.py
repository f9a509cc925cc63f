"""`controls` makes every policy of the validation, and goes on where it was stopped."""

from __future__ import annotations

import argparse

import pytest

from benchmarks.validation.policies import read_policies
from examples.cubes_policy import controls, demonstrate
from examples.cubes_policy.__main__ import main


@pytest.mark.thorough
def test_every_control_and_seed_is_trained_once_and_read_by_the_validation(folder, tmp_path, monkeypatch, capsys):
    asked: list[argparse.Namespace] = []
    monkeypatch.setattr(demonstrate, "run", lambda arguments: asked.append(arguments) or 0)
    words = ["controls", str(folder), str(tmp_path / "policies"), "--steps", "1", "--seeds", "0", "--parts", "1"]
    assert main([*words, "--controls", "words", "mark"]) == 0
    assert [(made.demonstrations, made.parts) for made in asked] == [(folder, 1)]
    found = read_policies(tmp_path / "policies")
    assert [(policy.name, policy.control, policy.seed) for policy in found] == [
        ("words_0", "words", 0),
        ("mark_0", "mark", 0),
    ]
    before = (tmp_path / "policies" / "mark_0" / "model.safetensors").stat().st_mtime_ns
    capsys.readouterr()
    assert main([*words, "--controls", "mark"]) == 0
    assert "mark_0 is there" in capsys.readouterr().out
    assert (tmp_path / "policies" / "mark_0" / "model.safetensors").stat().st_mtime_ns == before
    assert (tmp_path / "policies" / controls.TRAININGS / "mark_0" / "log.csv").exists()
