"""The meta files of a LeRobotDataset: what `meta/info.json` says, with its tasks and episodes.

Paths come from the templates of `info.json`. Format: `src/lerobot/datasets/` of LeRobot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vla_attention.capture.foreign_files.checked_files import read_object
from vla_attention.capture.replay.data_set_episodes import (
    Episodes,
    Paths,
    episodes_of_lines,
    episodes_of_tables,
    tasks_of_lines,
    tasks_of_table,
)
from vla_attention.capture.replay.data_tables import DamagedDataSet, DataSetError, DataSetNotFound
from vla_attention.schemas.errors import listing


class UnsupportedDataSet(DataSetError):
    """A data set of another kind or version."""


class UndecodableVideo(DataSetError):
    """A video whose pictures cannot be decoded."""


INFO = "meta/info.json"
#: Versions with one file per episode, and those with several episodes per file.
FILE_PER_EPISODE, FILE_OF_MANY = ("v2.0", "v2.1"), ("v3.0",)
VERSIONS = (*FILE_PER_EPISODE, *FILE_OF_MANY)
#: Columns that every data set has, and that are numbers of its own.
INDEX_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
#: What is read before the episodes are known.
META_FILES = ("meta/*.json", "meta/*.jsonl", "meta/*.parquet", "meta/episodes/**")


@dataclass(frozen=True)
class Feature:
    """One column of a data set: its type, the shape of one value, and the names of its numbers, if it has any.

    dtype: `video` and `image` are pictures; anything else is a type of numbers or text. depth: pictures of distances.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] = ()
    depth: bool = False

    @property
    def is_camera(self) -> bool:
        """Whether the values are colour pictures."""
        return self.dtype in ("video", "image") and not self.depth


@dataclass(frozen=True)
class DataSetInfo:
    """The content of `meta/`: version, frames per second, columns, tasks by their numbers, episodes by theirs."""

    version: str
    fps: float
    robot_type: str
    features: Mapping[str, Feature]
    tasks: Mapping[int, str]
    episodes: Episodes


def read_info(folder: Path) -> DataSetInfo:
    """Read the meta files of a data set.

    Raises:
        DataSetNotFound: the folder has no `meta/info.json`, or lacks another of its files.
        UnsupportedDataSet: the version is not one of `VERSIONS`.
        DamagedDataSet: a file cannot be read or lacks what it should say.
    """
    path = folder / INFO
    if not path.is_file():
        if not folder.is_dir():
            raise DataSetNotFound(f"'{folder}' is no LeRobotDataset, but a file; give the folder that holds {INFO}.")
        names = sorted(entry.name for entry in folder.iterdir())
        held = listing(names) if names else "nothing"
        raise DataSetNotFound(f"'{folder}' is no LeRobotDataset: it has no {INFO} and holds {held}.")
    content = _json_object(path)
    version = content.get("codebase_version")
    if version not in VERSIONS:
        raise UnsupportedDataSet(
            f"The data set '{folder}' has version {version!r}; this program reads {listing(VERSIONS)}: convert it with "
            "LeRobot's own script, or download it in one of these versions."
        )
    try:
        features = {name: _feature(name, stated) for name, stated in content["features"].items()}
        fps = float(content["fps"])
        videos = [name for name, feature in features.items() if feature.dtype == "video"]
        paths = Paths(f"'{path}'", content, videos, int(content.get("chunks_size") or 1000))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        if isinstance(error, DataSetError):
            raise
        raise DamagedDataSet(f"'{path}' lacks what a data set of {version} says ({error!r}).") from error
    if not (math.isfinite(fps) and fps > 0):
        raise DamagedDataSet(f"'{path}' has {fps} frames per second; expected a number above 0.")
    if version in FILE_OF_MANY:
        tasks, episodes = tasks_of_table(folder), episodes_of_tables(folder, paths)
    else:
        tasks, episodes = tasks_of_lines(folder), episodes_of_lines(folder, paths)
    next(iter(episodes.values()), None)  # a template that cannot be filled is said now
    return DataSetInfo(
        version=version,
        fps=fps,
        robot_type=str(content.get("robot_type") or "unknown"),
        features=features,
        tasks=tasks,
        episodes=episodes,
    )


def _feature(name: str, stated: Mapping[str, Any]) -> Feature:
    names = stated.get("names")
    if isinstance(names, Mapping):  # as {"motors": [...]}
        names = next((value for value in names.values() if isinstance(value, list)), [])
    info = stated.get("info") or stated.get("video_info") or {}
    depth = bool(info.get("is_depth_map") or info.get("video.is_depth_map"))
    shape = tuple(int(size) for size in stated["shape"])
    if any(size < 0 for size in shape):
        raise ValueError(f"the column '{name}' has the shape {shape}")
    return Feature(name, str(stated["dtype"]), shape, tuple(str(part) for part in names or ()), depth)


def _json_object(path: Path) -> dict[str, Any]:
    try:
        return read_object(path, DamagedDataSet)
    except FileNotFoundError:
        raise DamagedDataSet(f"There is no '{path}', which the data set needs.") from None
