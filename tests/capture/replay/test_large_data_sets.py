"""Data sets with files as large as LeRobot makes them: several hundred megabytes, and several episodes in a file."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.kit.lerobot_data_sets import (
    Encoding,
    made_up_episodes,
    numbered_picture,
    write_data_set,
    write_video,
)
from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.stores.reader import open_store

pytestmark = pytest.mark.thorough

SIZE = (480, 640)
CAMERA = "observation.images.front"
#: Reads frames and says what they show, and what memory was taken beyond that of the imports.
READ = """
import json, resource, sys
import av, numpy, polars
import vla_attention as va
from tests.kit.lerobot_data_sets import number_of
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
data = va.datasets.open(sys.argv[1])
shown = []
for episode, frame in json.loads(sys.argv[2]):
    frames = data.episode(episode).frames(every=max(frame, 1))
    picture = next(found for found in frames if found.index == frame).images["observation.images.front"]
    shown.append(number_of(picture))
print(json.dumps([shown, 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)]))
"""


def noisy(number: int) -> np.ndarray:
    """A picture that shows a number, and that no codec makes much smaller."""
    noise = np.random.default_rng(number).integers(0, 60, (*SIZE, 3), dtype=np.uint8)
    return np.minimum(numbered_picture(number, *SIZE), 195) + noise


def small(folder: Path, length: int, *, video: bool) -> Path:
    """Three episodes of so many frames in one file."""
    episodes = made_up_episodes([length] * 3, size=(8, 40))
    encoding = Encoding("libx264", {"preset": "ultrafast"}) if video else None
    return write_data_set(folder, "v3.0", episodes, video=encoding, episodes_per_file=3)


def check_pictures(folder: Path, length: int, most_bytes: int) -> None:
    """Fail unless frames show their numbers, and reading them takes little memory."""
    looked_at = [(0, 0), (1, 7), (2, 0), (2, length - 1)]
    command = [sys.executable, "-c", READ, str(folder), json.dumps(looked_at)]
    shown, taken = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert shown == [length * episode + frame for episode, frame in looked_at]
    assert taken < most_bytes


def check_replay(folder: Path, store: Path) -> None:
    options = (
        "--checkpoint",
        "untrained-tiny",
        "--camera",
        f"base_0_rgb={CAMERA}",
        "--camera",
        "left_wrist_0_rgb=none",
    )
    assert capture(["replay", str(folder), *options, "--every", "100", "--output", str(store)]) == 0
    assert len(open_store(store).episodes) == 3


def test_a_video_of_several_hundred_megabytes(tmp_path):
    length = 240
    folder = small(tmp_path / "robot", length, video=True)
    (video,) = folder.glob("videos/**/*.mp4")
    pictures = [noisy(number) for number in range(3 * length)]
    write_video(video, pictures, 10, Encoding("libx264", {"preset": "ultrafast", "qp": "3", "g": "2"}))
    assert video.stat().st_size > 250_000_000
    check_pictures(folder, length, 150_000_000)
    check_replay(folder, tmp_path / "run.zarr")
