"""The meta files of a LeRobotDataset: what it holds, and in which file and at which second each episode is.

Versions 2.0 and 2.1 have one data file and one video per episode; version 3.0 puts several episodes into a file. Paths
come from the templates of `meta/info.json`. Format: `src/lerobot/datasets/` of LeRobot.
"""

from __future__ import annotations

import json
import math
import re
import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import polars as pl

from vla_attention.capture.foreign_files.json_objects import read_object
from vla_attention.capture.replay.data_set_errors import (
    DamagedDataSet,
    DataSetError,
    DataSetNotFound,
    UnsupportedDataSet,
)
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.safe_text import check_inner_path

INFO = "meta/info.json"
#: Versions with one file per episode, and those with several episodes per file.
FILE_PER_EPISODE, FILE_OF_MANY = ("v2.0", "v2.1"), ("v3.0",)
VERSIONS = (*FILE_PER_EPISODE, *FILE_OF_MANY)
#: Columns that every data set has, and that are numbers of its own.
INDEX_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
#: How a template may write a number or a name; any other way is not LeRobot's, and could write a path of any length.
_PLAIN_FORMAT = re.compile(r"(0?\d{1,2}d?)?")
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
class VideoPlace:
    """Where the pictures of one camera of one episode are: a file, and the second at which the episode begins."""

    path: str
    begins_at: float


@dataclass(frozen=True)
class EpisodeEntry:
    """One episode as the meta files describe it: number of frames, tasks, and its files inside of the data set."""

    index: int
    length: int
    tasks: tuple[str, ...]
    data: str
    videos: Mapping[str, VideoPlace] = field(default_factory=dict)


@dataclass(frozen=True)
class DataSetInfo:
    """The content of `meta/`: version, frames per second, columns, tasks by their numbers, episodes by theirs."""

    version: str
    fps: float
    robot_type: str
    features: Mapping[str, Feature]
    tasks: Mapping[int, str]
    episodes: Mapping[int, EpisodeEntry]


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
        paths = _Paths(folder, content, videos)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        if isinstance(error, DataSetError):
            raise
        raise DamagedDataSet(f"'{path}' lacks what a data set of {version} says ({error!r}).") from error
    if not (math.isfinite(fps) and fps > 0):
        raise DamagedDataSet(f"'{path}' has {fps} frames per second; expected a number above 0.")
    if version in FILE_OF_MANY:
        tasks, episodes = _tasks_of_table(folder), _episodes_of_tables(folder, paths)
    else:
        tasks, episodes = _tasks_of_lines(folder), _episodes_of_lines(folder, paths)
    return DataSetInfo(
        version=version,
        fps=fps,
        robot_type=str(content.get("robot_type") or "unknown"),
        features=features,
        tasks=tasks,
        episodes=dict(sorted(episodes.items())),
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


class _Paths:
    """Paths of data files and videos, from the templates of `info.json`."""

    def __init__(self, folder: Path, content: Mapping[str, Any], videos: Sequence[str]) -> None:
        self._where = f"'{folder / INFO}'"
        self._data = content["data_path"]
        self._video = content.get("video_path")
        self._per_chunk = int(content.get("chunks_size") or 1000)
        self.videos = tuple(videos)
        if self._per_chunk < 1:
            raise DamagedDataSet(f"{self._where} has the chunks_size {self._per_chunk}; expected at least 1.")
        if videos and not self._video:
            raise DamagedDataSet(f"{self._where} has the videos {listing(videos)} and no video_path.")

    def of_episode(self, index: int) -> tuple[str, dict[str, VideoPlace]]:
        """Return the files of an episode that has its own."""
        numbers = {"episode_index": index, "episode_chunk": index // self._per_chunk}
        videos = {name: VideoPlace(self._filled(self._video, video_key=name, **numbers), 0.0) for name in self.videos}
        return self._filled(self._data, **numbers), videos

    def of_row(self, row: Mapping[str, Any]) -> tuple[str, dict[str, VideoPlace]]:
        """Return the files of an episode by its row in the tables of version 3.0."""
        videos = {}
        for name in self.videos:
            numbers = {what: int(row[f"videos/{name}/{what}"]) for what in ("chunk_index", "file_index")}
            begins_at = float(row[f"videos/{name}/from_timestamp"])
            videos[name] = VideoPlace(self._filled(self._video, video_key=name, **numbers), begins_at)
        numbers = {what: int(row[f"data/{what}"]) for what in ("chunk_index", "file_index")}
        return self._filled(self._data, **numbers), videos

    def _filled(self, template: object, **values: Any) -> str:
        try:
            if not isinstance(template, str):
                raise ValueError("it is no text")
            # A plain name in braces only: anything more would reach into the values.
            parts = [(name, form) for _, name, form, _ in string.Formatter().parse(template) if name is not None]
            if any(name not in values for name, _ in parts):
                raise KeyError(listing(name for name, _ in parts))
            if any(not _PLAIN_FORMAT.fullmatch(form or "") for _, form in parts):
                raise ValueError("expected numbers as in {episode_index:06d}")
            path = template.format(**values)
            check_inner_path(path)
        except (KeyError, ValueError, IndexError) as error:
            raise DamagedDataSet(
                f"{self._where} has the path template {template!r}, which cannot be filled with {listing(values)} "
                f"({error})."
            ) from None
        return path


def _json_object(path: Path) -> dict[str, Any]:
    try:
        return read_object(path, DamagedDataSet)
    except FileNotFoundError:
        raise DamagedDataSet(f"There is no '{path}', which the data set needs.") from None


def _lines(folder: Path, name: str) -> list[dict[str, Any]]:
    path = folder / name
    if not path.is_file():
        raise DataSetNotFound(f"The data set '{folder}' has no {name}, which its version needs.")
    try:
        return [dict(json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    except (ValueError, TypeError, OSError, RecursionError) as error:
        raise DamagedDataSet(f"'{path}' is not one JSON object per line ({error}).") from error


def _tasks_of_lines(folder: Path) -> dict[int, str]:
    name = "meta/tasks.jsonl"
    try:
        return {int(line["task_index"]): str(line["task"]) for line in _lines(folder, name)}
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        if isinstance(error, DataSetError):
            raise
        raise DamagedDataSet(f"'{folder / name}' has a line without task_index and task.") from error


def _episodes_of_lines(folder: Path, paths: _Paths) -> dict[int, EpisodeEntry]:
    name, episodes = "meta/episodes.jsonl", {}
    for line in _lines(folder, name):
        try:
            index, length = int(line["episode_index"]), int(line["length"])
            tasks = tuple(str(task) for task in line.get("tasks") or ())
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise DamagedDataSet(f"'{folder / name}' has a line without episode_index and length.") from error
        _check_episode(folder / name, index, length)
        data, videos = paths.of_episode(index)
        episodes[index] = EpisodeEntry(index, length, tasks, data, videos)
    return episodes


def read_table(path: Path, columns: Sequence[str] | None = None) -> pl.DataFrame:
    """Read a Parquet file; errors name it."""
    if not path.is_file():
        raise DataSetNotFound(f"There is no '{path}', which the data set names.")
    try:
        # A name with brackets or a star is a name, not a pattern.
        return pl.read_parquet(path, glob=False, columns=None if columns is None else list(columns))
    except (pl.exceptions.PolarsError, OSError) as error:
        raise DamagedDataSet(f"'{path}' cannot be read ({str(error).splitlines()[0]}).") from error


def _tasks_of_table(folder: Path) -> dict[int, str]:
    path = folder / "meta" / "tasks.parquet"
    table = read_table(path)
    # pandas wrote it with the tasks as its index, whose column has a name of its own or none.
    texts = [name for name, kind in table.schema.items() if kind == pl.String]
    column = "task" if "task" in texts else texts[0] if len(texts) == 1 else None
    if column is None or "task_index" not in table.columns:
        raise DamagedDataSet(f"'{path}' should have the columns task and task_index, but has {listing(table.columns)}.")
    return {int(index): str(task) for index, task in zip(table["task_index"], table[column], strict=True)}


def _episodes_of_tables(folder: Path, paths: _Paths) -> dict[int, EpisodeEntry]:
    files = sorted((folder / "meta" / "episodes").glob("*/*.parquet"))
    if not files:
        raise DataSetNotFound(f"The data set '{folder}' has no Parquet file in meta/episodes, which v3.0 needs.")
    wanted = ["episode_index", "length", "tasks", "data/chunk_index", "data/file_index"]
    for name in paths.videos:
        wanted += [f"videos/{name}/{what}" for what in ("chunk_index", "file_index", "from_timestamp")]
    episodes = {}
    for path in files:
        # Most columns are statistics of the episodes.
        for row in read_table(path, wanted).iter_rows(named=True):
            try:
                data, videos = paths.of_row(row)
                index, length = int(row["episode_index"]), int(row["length"])
            except (TypeError, ValueError, OverflowError) as error:
                if isinstance(error, (DataSetError, BadArgument)):
                    raise
                raise DamagedDataSet(f"'{path}' has an episode without the numbers of its files.") from error
            _check_episode(path, index, length)
            episodes[index] = EpisodeEntry(index, length, tuple(row["tasks"] or ()), data, videos)
    return episodes


def _check_episode(path: Path, index: int, length: int) -> None:
    if index < 0 or length < 1:
        raise DamagedDataSet(f"'{path}' has an episode {index} of {length} frames; expected at least one frame.")
