"""LIBERO episodes through the real command line: the same when captured in order, resumed or by another job."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import zarr

pytest.importorskip("libero")
pytest.importorskip("robosuite")

from vla_attention.capture.__main__ import main as capture

EPISODE = "episodes/task000_episode002"
#: The rack, the cabinet and the stove of this task have no joint: every reset places them.
SHORT = ("pi", "--checkpoint", "untrained-tiny", "--task-suite", "libero_goal", "--task-id", "0", "--max-steps", "4")


@pytest.mark.thorough
@pytest.mark.simulator
@pytest.mark.libero
def test_a_resumed_episode_is_the_one_of_a_run_in_order(tmp_path: Path, libero_assets: Path, capfd) -> None:
    def run(store: Path, *arguments: str) -> str:
        given = [*SHORT, "--libero-assets", str(libero_assets), "--output", str(store), "--num-envs", "1", *arguments]
        assert capture(given) == 0
        return capfd.readouterr().out

    in_order, resumed = tmp_path / "in_order.zarr", tmp_path / "resumed.zarr"
    assert "resets" not in run(in_order, "--num-episodes", "3")
    shutil.copytree(in_order, resumed)
    shutil.rmtree(resumed / EPISODE)
    said = run(resumed, "--num-episodes", "3", "--resume")
    assert re.search("task000_episode002: .* 2 first", said)
    ours, theirs = (zarr.open_group(store / EPISODE, mode="r") for store in (resumed, in_order))
    for name in (
        "frames/base_0_rgb",
        "frames/left_wrist_0_rgb",
        "objects/base_0_rgb",
        "joint/rows",
        "actions",
        "state",
    ):
        np.testing.assert_array_equal(ours[name][:], theirs[name][:])
