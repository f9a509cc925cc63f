"""Data sets of robots, read without LeRobot: `va.datasets.open(FOLDER or ORG/NAME)`.

    import vla_attention as va

    data = va.datasets.open("data/so101_pick")
    data.cameras, data.fps, data.tasks               # what it holds; data.features lists every column
    for frame in data.episode(3).frames(every=10):
        frame.images["observation.images.front"]     # (height, width, 3) uint8
        frame.values["observation.state"]            # (number,) float64
        frame.instruction, frame.seconds, frame.index

`capture replay` records policy calls on such frames; `ReplayPolicy` is what its `--policy FILE.py` returns.
docs/my-data-set.md describes both.
"""

from __future__ import annotations

from vla_attention.capture.replay.policy_file import ReplayPolicy
from vla_attention.schemas.data_sets.data_set_files import DataSetError
from vla_attention.schemas.data_sets.lerobot_dataset import DataSetEpisode, DataSetFrame, LeRobotDataset
from vla_attention.schemas.data_sets.lerobot_dataset import open_dataset as open

__all__ = ["DataSetEpisode", "DataSetError", "DataSetFrame", "LeRobotDataset", "ReplayPolicy", "open"]
