"""What a run takes without being asked."""

from __future__ import annotations

import argparse
from dataclasses import MISSING, fields
from pathlib import Path

import pytest

from tests.kit.lazy_imports import help_without_libraries
from vla_attention.capture.commands.arguments import ClusterSettings
from vla_attention.capture.effects.arguments import EffectSettings
from vla_attention.capture.engine.settings import RecordingSettings, StoreOutput
from vla_attention.capture.environments.suites import find_suite
from vla_attention.capture.interventions.arguments import InterventionSettings
from vla_attention.capture.policies.families import policy_families
from vla_attention.capture.replay.arguments import ReplayOutput, ReplaySettings
from vla_attention.capture.rerun.arguments import RerunOutput, RerunSettings
from vla_attention.capture.run import run_settings
from vla_attention.capture.run.run_settings import CaptureOutput, RunSettings
from vla_attention.schemas.options import add_options, read_options


@pytest.mark.parametrize(("cores", "expected"), [(1, 1), (3, 3), (64, 8)])
def test_there_are_as_many_simulators_as_cores_and_no_more_than_eight(cores, expected, monkeypatch):
    monkeypatch.setattr(run_settings, "available_cores", lambda: cores)
    monkeypatch.setattr(run_settings, "memory_left", lambda: 1e12)
    assert run_settings.default_num_envs(find_suite("libero_10")) == expected


@pytest.mark.parametrize(("left", "expected"), [(7e9, 2), (1e9, 1), (float("inf"), 8)])
def test_simulators_fit_into_the_memory(left, expected, monkeypatch):
    monkeypatch.setattr(run_settings, "available_cores", lambda: 64)
    monkeypatch.setattr(run_settings, "memory_left", lambda: left)
    assert run_settings.default_num_envs(find_suite("libero_10")) == expected


#: Every class of settings whose options a command line takes.
ALL_SETTINGS = [
    *(family.settings for family in policy_families()), RunSettings, CaptureOutput, RecordingSettings, EffectSettings,
    InterventionSettings, ReplaySettings, ReplayOutput, RerunSettings, RerunOutput, ClusterSettings,
]  # fmt: skip


@pytest.mark.parametrize("settings", ALL_SETTINGS)
def test_without_options_settings_are_their_defaults(settings):
    made = argparse.ArgumentParser()
    add_options(made, settings)
    needed = {one.name: None for one in fields(settings) if one.default is MISSING}
    needed |= {"items": ()} if settings is EffectSettings else {}
    assert read_options(settings, made.parse_args([]), **needed) == settings(**needed)


def test_an_output_is_a_store_or_a_folder():
    made = argparse.ArgumentParser()
    add_options(made, StoreOutput)
    for name in ("--output", "--output-dir"):  # the latter is the published scripts'
        output = read_options(StoreOutput, made.parse_args(["--output", "runs/a.zarr", name, "results"]))
        assert output == StoreOutput(Path("runs/a.zarr"), Path("results"))
    assert StoreOutput(output_dir=Path("results")).place("mine") == Path("results/mine.zarr")


@pytest.mark.parametrize("command", ["pi", "replay", "rerun"])
def test_help_imports_no_library(command):
    assert help_without_libraries("vla_attention.capture", [command, "--help-all"]).startswith("usage:")
