"""LeRobotDatasets of versions 2.0, 2.1 and 3.0, read without LeRobot. `vla_attention.datasets` has the public names."""

from __future__ import annotations

import glob
import hashlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.capture.foreign_files.pictures import PictureRefused, decode_picture
from vla_attention.capture.replay.data_set_errors import DamagedDataSet, DataSetNotFound
from vla_attention.capture.replay.data_set_files import (
    INFO,
    META_FILES,
    DataSetInfo,
    EpisodeEntry,
    Feature,
    read_info,
    read_table,
)
from vla_attention.capture.replay.video import VideoFile
from vla_attention.schemas.errors import BadArgument, UnknownName, listing, unknown_name

#: How far the time of a picture may be from the time of its row, as a part of the time between two frames. LeRobot
#: itself refuses more than 0.1 ms.
TIME_TOLERANCE = 0.25
#: Rows whose PNG pictures are read at once.
_ROWS_AT_ONCE = 32

#: Makes sure that files of a data set, by their paths inside of it, are on this machine.
Fetch = Callable[[Sequence[str]], None]


@dataclass(frozen=True)
class DataSetFrame:
    """One frame of an episode.

    index: from 0 in the episode. seconds: since its beginning. images: camera -> (height, width, 3) uint8 RGB, in the
    orientation of the data set. values: every other column of numbers -> (number,) float64.
    """

    episode: int
    index: int
    seconds: float
    task_index: int
    instruction: str
    images: Mapping[str, NDArray[np.uint8]]
    values: Mapping[str, NDArray[np.float64]]


class LeRobotDataset:
    """A data set: its columns, tasks and episodes. Made by `open_dataset`."""

    def __init__(
        self,
        folder: Path,
        name: str,
        info: DataSetInfo,
        fetch: Fetch | None = None,
        downloads: Mapping[str, str] | None = None,
    ) -> None:
        self.folder = folder
        #: the commit of the files from the hub, for a store's provenance
        self.downloads = dict(downloads or {})
        self.name = name
        self.info = info
        self._fetch = fetch

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.info.fps

    @property
    def features(self) -> Mapping[str, Feature]:
        """The columns by their names."""
        return self.info.features

    @property
    def cameras(self) -> tuple[str, ...]:
        """The columns of colour pictures."""
        return tuple(name for name, feature in self.features.items() if feature.is_camera)

    @property
    def tasks(self) -> Mapping[int, str]:
        """The instruction of each task, by its number."""
        return self.info.tasks

    @property
    def episodes(self) -> tuple[EpisodeEntry, ...]:
        """Every episode, as the meta files describe it, in the order of their numbers."""
        return tuple(self.info.episodes.values())

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of version, columns, tasks and episodes: it names the data set wherever it lies."""
        info = self.info
        episodes = [(entry.index, entry.length, entry.tasks) for entry in self.episodes]
        features = [(feature.name, feature.dtype, feature.shape) for feature in self.features.values()]
        content = (info.version, info.fps, sorted(features), sorted(info.tasks.items()), episodes)
        return hashlib.sha256(repr(content).encode()).hexdigest()

    def feature(self, name: str) -> Feature:
        """Return the column of that name; `UnknownName` lists those that exist."""
        if name not in self.features:
            raise unknown_name("column of the data set", name, self.features)
        return self.features[name]

    def episode(self, index: int) -> DataSetEpisode:
        """Return one episode with its table; its pictures are read when they are asked for.

        Raises:
            UnknownName: there is no such episode.
            DataSetNotFound: a file of it is missing.
            DamagedDataSet: its table cannot be read, or contradicts the meta files.
        """
        entry = self.entry(index)
        self.fetch([entry.data])
        return DataSetEpisode(self, entry)

    def fetch(self, paths: Sequence[str]) -> None:
        """Fetch files of a data set of the hub, by their paths inside of it; nothing for one that is a folder."""
        if self._fetch is not None:
            self._fetch(paths)

    def entry(self, index: int) -> EpisodeEntry:
        """Return what the meta files say of one episode; `UnknownName` says which exist."""
        if index not in self.info.episodes:
            numbers = list(self.info.episodes)
            is_range = numbers == list(range(len(numbers)))
            existing = f"0 to {len(numbers) - 1}" if is_range and numbers else listing(numbers)
            raise UnknownName(f"The data set '{self.name}' has no episode {index}; its episodes are {existing}.")
        return self.info.episodes[index]

    def check_files(self, episodes: Iterable[int], cameras: Sequence[str]) -> None:
        """Raise `DataSetNotFound` unless the files of episodes are there; files on the hub are fetched first."""
        entries = [self.entry(index) for index in episodes]
        wanted = {entry.data for entry in entries}
        wanted |= {entry.videos[camera].path for entry in entries for camera in cameras if camera in entry.videos}
        self.fetch(sorted(wanted))
        missing = sorted(path for path in wanted if not (self.folder / path).is_file())
        if missing:
            raise DataSetNotFound(
                f"The data set '{self.folder}' lacks {len(missing)} of the files that its meta files name: "
                f"{listing(missing, 3)}."
            )


class DataSetEpisode:
    """One episode of a data set.

    length: frames. seconds: (frame,) float64, since the beginning. task_indices: (frame,) the task of each frame.
    """

    def __init__(self, dataset: LeRobotDataset, entry: EpisodeEntry) -> None:
        self.dataset = dataset
        self.entry = entry
        self.index = entry.index
        self.length = entry.length
        features = dataset.features.values()
        self._pictures = [feature.name for feature in features if feature.dtype == "image"]
        self._table = self._read_table()
        self.seconds = self._finite("timestamp")[:, 0]
        self.task_indices = self._numbers("task_index")[:, 0].astype(np.int64)
        unknown = sorted({int(task) for task in self.task_indices} - set(dataset.tasks))
        if unknown:
            raise DamagedDataSet(
                f"Episode {self.index} of '{dataset.name}' has the task {unknown[0]}, which the meta files do not name."
            )

    def _read_table(self) -> pl.DataFrame:
        path = self.dataset.folder / self.entry.data
        try:
            stored = pl.scan_parquet(path, glob=False).collect_schema() if path.is_file() else {}
        except (pl.exceptions.PolarsError, OSError) as error:
            raise DamagedDataSet(f"'{path}' cannot be read ({str(error).splitlines()[0]}).") from error
        named = [name for name, feature in self.dataset.features.items() if feature.dtype not in ("image", "video")]
        missing = [name for name in ("episode_index", "frame_index", "timestamp", "task_index") if name not in stored]
        if stored and missing:
            raise DamagedDataSet(f"'{path}' has no column {listing(missing)}; it has {listing(stored)}.")
        self._columns = [name for name in named if name in stored]
        wanted = list(dict.fromkeys(["episode_index", "frame_index", "timestamp", "task_index", *self._columns]))
        table = read_table(path, wanted).filter(pl.col("episode_index") == self.index).sort("frame_index")
        frames = table["frame_index"].to_list()
        if len(frames) != self.length or frames != list(range(self.length)):
            raise DamagedDataSet(
                f"Episode {self.index} of '{self.dataset.name}' has {len(frames)} rows in '{path}'; the meta files say "
                f"frames 0 to {self.length - 1}."
            )
        return table

    @property
    def instructions(self) -> tuple[str, ...]:
        """The instruction of each frame."""
        return tuple(self.dataset.tasks[int(task)] for task in self.task_indices)

    def column(self, name: str) -> NDArray[np.float64]:
        """Return a column of numbers, (frame, number) float64.

        Raises:
            UnknownName: the data set has no such column.
            BadArgument: it does not hold numbers.
            DamagedDataSet: a number is missing or not finite, or there are not as many as the meta files say.
        """
        feature = self.dataset.feature(name)
        if name not in self._columns:
            raise BadArgument(f"The column '{name}' of '{self.dataset.name}' holds {feature.dtype}, not numbers.")
        values = self._finite(name)
        stated = math.prod(feature.shape)
        if values.shape[1] != stated:
            raise DamagedDataSet(
                f"The column '{name}' of episode {self.index} of '{self.dataset.name}' has {values.shape[1]} numbers "
                f"in each frame, and {INFO} says {stated}."
            )
        return values

    def _finite(self, name: str) -> NDArray[np.float64]:
        values = self._numbers(name)
        if not np.isfinite(values).all():
            raise DamagedDataSet(
                f"The column '{name}' of episode {self.index} of '{self.dataset.name}' has numbers that are NaN or "
                f"infinite, the first at frame {int(np.argmin(np.isfinite(values).all(axis=1)))}."
            )
        return values

    def _numbers(self, name: str) -> NDArray[np.float64]:
        series = self._table[name]
        try:
            values = np.array(series.to_list(), dtype=np.float64)
        except (TypeError, ValueError):
            raise BadArgument(
                f"The column '{name}' of '{self.dataset.name}' holds {series.dtype}, not as many numbers in each frame."
            ) from None
        return values.reshape(len(series), -1)

    def frames(self, every: int = 1, cameras: Sequence[str] | None = None) -> Iterator[DataSetFrame]:
        """Yield frame 0, `every`, 2 · `every` ... with pictures.

        cameras: the columns whose pictures are read; None for all. Pictures of videos are exact to the frame: the one
        whose time is that of the row, within a quarter of the time between two frames.

        Raises:
            MissingDependency: PyAV, or pillow for pictures that are no video, is not installed.
            UndecodableVideo, DamagedDataSet: see `VideoFile.picture`.
        """
        if every < 1:
            raise BadArgument(f"Cannot take every {every}th frame; expected at least 1.")
        names = self.dataset.cameras if cameras is None else tuple(dict.fromkeys(cameras))
        for name in names:
            if not self.dataset.feature(name).is_camera:
                raise BadArgument(f"The column '{name}' of '{self.dataset.name}' holds no colour pictures.")
        numbers = self._values()
        self.dataset.fetch([self.entry.videos[name].path for name in names if name in self.entry.videos])
        with ExitStack() as opened:
            videos = {
                name: opened.enter_context(VideoFile(self.dataset.folder / self.entry.videos[name].path))
                for name in names
                if name in self.entry.videos
            }
            stored = [name for name in names if name not in videos]
            wanted = range(0, self.length, every)
            for first in range(0, len(wanted), _ROWS_AT_ONCE):
                block = list(wanted[first : first + _ROWS_AT_ONCE])
                pictures = self._stored_pictures(stored, block)
                for row, frame in enumerate(block):
                    images = {name: pictures[name][row] for name in stored}
                    images |= {name: self._of_video(name, video, frame) for name, video in videos.items()}
                    yield self._frame(frame, {name: images[name] for name in names}, numbers)

    def _values(self) -> dict[str, NDArray[np.float64]]:
        numeric = {}
        for name in self._columns:
            if self._table[name].dtype != pl.String:
                try:
                    numeric[name] = self._numbers(name)
                except BadArgument:
                    continue  # text, or lists of several lengths: nothing that a policy reads as numbers
        return numeric

    def _frame(
        self, frame: int, images: Mapping[str, NDArray[np.uint8]], numbers: Mapping[str, NDArray[np.float64]]
    ) -> DataSetFrame:
        task = int(self.task_indices[frame])
        return DataSetFrame(
            episode=self.index,
            index=frame,
            seconds=float(self.seconds[frame]),
            task_index=task,
            instruction=self.dataset.tasks[task],
            images=images,
            values={name: values[frame] for name, values in numbers.items()},
        )

    def _of_video(self, name: str, video: VideoFile, frame: int) -> NDArray[np.uint8]:
        seconds = self.entry.videos[name].begins_at + float(self.seconds[frame])
        return video.picture(seconds, TIME_TOLERANCE / self.dataset.fps)

    def _stored_pictures(self, names: Sequence[str], frames: Sequence[int]) -> dict[str, list[NDArray[np.uint8]]]:
        """Read PNG pictures that are in the table: name -> one for each of the frames, which are in order."""
        if not names:
            return {}
        path = self.dataset.folder / self.entry.data
        here = (pl.col("episode_index") == self.index) & pl.col("frame_index").is_in(list(frames))
        try:
            rows = (
                pl.scan_parquet(path, glob=False).select("episode_index", "frame_index", *names).filter(here).collect()
            )
        except (pl.exceptions.PolarsError, OSError) as error:
            raise DamagedDataSet(f"'{path}' cannot be read ({str(error).splitlines()[0]}).") from error
        rows = rows.sort("frame_index")
        return {name: [self._decoded(name, cell) for cell in rows[name]] for name in names}

    def _decoded(self, name: str, cell: Any) -> NDArray[np.uint8]:
        what = f"A picture of '{name}' in episode {self.index} of '{self.dataset.name}'"
        if cell is not None and not isinstance(cell, Mapping):
            raise DamagedDataSet(f"{what} is a {type(cell).__name__} in its table; expected the bytes of a picture.")
        content = None if cell is None else cell.get("bytes")
        try:
            if content is None:
                place = Path("" if cell is None else cell.get("path") or "")
                file = self.dataset.folder / place
                # A path that leads out of the data set is not followed.
                if place == Path() or place.is_absolute() or ".." in place.parts or not file.is_file():
                    raise DataSetNotFound(f"{what} is neither in its table nor in a file of the data set ('{place}').")
                content = file.read_bytes()
            return decode_picture(content)
        except (OSError, PictureRefused) as error:
            if isinstance(error, DataSetNotFound):
                raise
            raise DamagedDataSet(f"{what} {error}.") from error


def open_dataset(name: str | Path) -> LeRobotDataset:
    """Open a LeRobotDataset: a folder, or `ORG/NAME` or `ORG/NAME@REVISION` of the Hugging Face hub.

    From the hub, only the meta files are fetched now, and the files of an episode when it is read. A copy that LeRobot
    made is used.

    Raises:
        DataSetNotFound, UnsupportedDataSet, DamagedDataSet: see `read_info`.
        MissingDependency, CheckpointUnavailable: the hub's client is missing, or the download failed.
    """
    # Imported here: a folder needs none of it.
    from vla_attention.capture.policies.hub import downloads, fetch_from_hub, hub_version, split_hub_name

    folder = Path(name).expanduser()
    on_hub = split_hub_name(str(name))
    if folder.is_dir() or on_hub is None:
        if not folder.exists():
            raise DataSetNotFound(f"There is no data set at '{name}'; give a folder, or ORG/NAME of the hub.")
        return LeRobotDataset(folder, folder.resolve().name, read_info(folder))
    repository, revision = on_hub
    copy = _lerobot_home() / repository
    if revision is None and (copy / INFO).is_file():
        return LeRobotDataset(copy, repository, read_info(copy))
    how = (
        f"fetch it where there is a network with `hf download --repo-type dataset {name}`, copy the folder here and "
        "give its path (there is no such local folder)"
    )

    folder = fetch_from_hub(repository, META_FILES, how, kind="dataset", revision=revision)
    version = hub_version(folder)
    # The files of episodes are of the same commit as the meta files, whatever is uploaded meanwhile.
    commit = revision if version is None else version.commit

    def fetch(paths: Sequence[str]) -> None:
        if paths:
            # Paths come from the data set: a star in one would fetch every file of the repository.
            fetch_from_hub(repository, [*map(glob.escape, paths)], how, kind="dataset", revision=commit)

    return LeRobotDataset(folder, repository, read_info(folder), fetch, downloads(folder))


def _lerobot_home() -> Path:
    """Return the folder of LeRobot's own copies of data sets."""
    home = os.environ.get("HF_HOME") or Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "huggingface"
    return Path(os.environ.get("HF_LEROBOT_HOME") or Path(home) / "lerobot").expanduser()
