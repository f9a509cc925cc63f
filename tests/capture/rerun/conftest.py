"""Stores of untrained policies, captured without a simulator."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.kit.still_scene import capture_without_simulator
from vla_attention.capture.__main__ import main


def capture(path: Path, family: str, *arguments: str) -> Path:
    """Two tasks, two episodes each, three policy calls an episode (Cosmos: two)."""
    words = ["--checkpoint", "untrained-tiny", "--task-suite", "robosuite", "--task-id", "0", "1"]
    words += ["--num-episodes", "2", "--max-steps"]
    with pytest.MonkeyPatch.context() as patch:
        capture_without_simulator(patch)
        steps = "12" if family == "pi" else "20"
        assert main([family, *words, steps, "--output", str(path), *arguments]) == 0
    return path


@pytest.fixture(scope="session")
def pi_store(tmp_path_factory):
    return capture(tmp_path_factory.mktemp("rerun") / "pi.zarr", "pi")


@pytest.fixture(scope="session")
def cosmos_store(tmp_path_factory):
    return capture(tmp_path_factory.mktemp("rerun") / "cosmos.zarr", "cosmos", "--query-frame", "curr_last")
