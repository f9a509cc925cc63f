"""Small data sets to be made hostile, and the command that replays them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.kit.lerobot_data_sets import H264, made_up_episodes, write_data_set
from tests.thorough.hostile_runs import Make

CAMERA = "observation.images.front"
#: Frames of the only episode.
FRAMES = 4
TABLE = {
    "v2.1": "data/chunk-000/episode_000000.parquet",
    "v3.0": "data/chunk-000/file-000.parquet",
}
VIDEO = f"videos/chunk-000/{CAMERA}/episode_000000.mp4"


@dataclass(frozen=True)
class Case:
    """An attack: how it is made, and what the sentence has to contain (a regular expression)."""

    make: Make
    sentence: str


def hostile(change: Callable[[Path], object], *, version: str = "v2.1", video: bool = False) -> Make:
    """A data set with one change: of its folder. What is changed is a copy of one that the first case has written."""

    def make(folder: Path) -> list[str]:
        whole, robot = folder.parent / f"{version}{' video' if video else ''}", folder / "robot"
        if not whole.exists():
            write_data_set(whole, version, made_up_episodes((FRAMES,), (CAMERA,)), video=H264 if video else None)
        shutil.copytree(whole, robot)
        change(robot)
        return command(folder)

    return make


def command(folder: Path) -> list[str]:
    cameras = ["--camera", f"base_0_rgb={CAMERA}", "--camera", "left_wrist_0_rgb=none"]
    store = ["--every", "1", "--output", str(folder / "store.zarr")]
    return ["replay", str(folder / "robot"), "--checkpoint", "untrained-tiny", *cameras, *store]


def good(version: str, *, video: bool) -> Make:
    """A data set that is replayed, to compare with."""
    return hostile(lambda robot: None, version=version, video=video)


def info(change: Callable[[dict[str, Any]], object], version: str = "v2.1") -> Make:
    """A data set with a change of its info.json."""

    def edit(robot: Path) -> None:
        path = robot / "meta" / "info.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return hostile(edit, version=version)


def written(name: str, content: bytes, version: str = "v2.1", *, video: bool = False) -> Make:
    """A data set with other bytes in a file."""
    return hostile(lambda robot: (robot / name).write_bytes(content), version=version, video=video)
