"""What a run takes without being asked."""

from __future__ import annotations

import pytest

from vla_attention.capture.run import run_settings


@pytest.mark.parametrize(("cores", "expected"), [(1, 1), (3, 3), (64, 8)])
def test_there_are_as_many_simulators_as_cores_and_no_more_than_eight(cores, expected, monkeypatch):
    monkeypatch.setattr(run_settings, "available_cores", lambda: cores)
    monkeypatch.setattr(run_settings, "memory_left", lambda: 1e12)
    assert run_settings.default_num_envs() == expected


@pytest.mark.parametrize(("left", "expected"), [(7e9, 3), (1e9, 1), (float("inf"), 8)])
def test_simulators_fit_into_the_memory(left, expected, monkeypatch):
    monkeypatch.setattr(run_settings, "available_cores", lambda: 64)
    monkeypatch.setattr(run_settings, "memory_left", lambda: left)
    assert run_settings.default_num_envs() == expected
