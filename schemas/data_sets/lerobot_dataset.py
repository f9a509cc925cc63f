"""LeRobotDatasets of versions 2.0, 2.1 and 3.0, read without LeRobot. `vla_attention.datasets` has the public names."""

from __future__ import annotations

import glob
import hashlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.bounded_process import BoundedProcess
from vla_attention.schemas.data_sets.data_set_files import (
    INFO,
    META_FILES,
    DamagedDataSet,
    DataSetNotFound,
    EpisodeEntry,
    Feature,
    read_info,
)
from vla_attention.schemas.data_sets.data_set_reader import (
    check_video_time,
    open_episode,
    read_numbers,
    read_pictures,
    read_video_picture,
)
from vla_attention.schemas.errors import BadArgument, UnknownName, listing, unknown_name

#: How far the time of a picture may be from the time of its row, as a part of the time between two frames. LeRobot
#: itself refuses more than 0.1 ms.
TIME_TOLERANCE = 0.25
#: How far the usual time between two frames may be from that of the stated rate, as a share of it: clocks jitter.
RATE_TOLERANCE = 0.05

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
    """A data set: its columns, tasks and episodes. Made by `open_dataset`; its files are read in a `BoundedProcess`."""

    def __init__(
        self, folder: Path, name: str, fetch: Fetch | None = None, downloads: Mapping[str, str] | None = None
    ) -> None:
        self.folder = folder
        #: the commit of the files from the hub, for a store's provenance
        self.downloads = dict(downloads or {})
        self.name = name
        self.process = BoundedProcess(DamagedDataSet)
        self.info = self.process.call(folder / "meta", read_info, folder)
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
    def episode_numbers(self) -> list[int]:
        """The numbers of all episodes, ascending."""
        return self.info.rows["episode_index"].to_list()

    @property
    def episodes(self) -> tuple[EpisodeEntry, ...]:
        """Every episode, as the meta files describe it, in the order of their numbers."""
        return tuple(self.info.entry(row) for row in range(len(self.info.rows)))

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of version, columns, tasks and episodes: it names the data set wherever it lies."""
        info = self.info
        features = sorted((feature.name, feature.dtype, feature.shape) for feature in self.features.values())
        rows = info.rows.select("episode_index", "length", "tasks").iter_rows()
        episodes = [(index, length, tuple(tasks)) for index, length, tasks in rows]
        content = repr((info.version, info.fps, features, sorted(info.tasks.items()), episodes))
        return hashlib.sha256(content.encode()).hexdigest()

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
        numbers = self.info.rows["episode_index"]
        row = int(numbers.search_sorted(index))
        if row == len(numbers) or numbers[row] != index:
            existing = self.episode_numbers
            is_range = existing == list(range(len(existing)))
            words = f"0 to {len(existing) - 1}" if is_range and existing else listing(existing)
            raise UnknownName(f"The data set '{self.name}' has no episode {index}; its episodes are {words}.")
        return self.info.entry(row)

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
        self._what = f"episode {entry.index} of '{dataset.name}'"
        self._table = dataset.folder / entry.data
        self._rows, self._columns = dataset.process.call(self._table, open_episode, self._table, entry.index)
        if len(self._rows) != self.length or (self.column("frame_index")[:, 0] != np.arange(self.length)).any():
            raise DamagedDataSet(
                f"Episode {self.index} of '{dataset.name}' has {len(self._rows)} rows in '{self._table}'; the meta "
                f"files say frames 0 to {self.length - 1}, one after the other."
            )
        self.seconds = self.column("timestamp")[:, 0]
        self.task_indices = self.column("task_index")[:, 0].astype(np.int64)
        unknown = set(self.task_indices.tolist()) - set(dataset.tasks)
        if unknown:
            raise DamagedDataSet(f"In {self._what} is the task {min(unknown)}, which the meta files do not name.")
        apart = float(np.median(np.diff(self.seconds))) if self.length > 1 else 1 / dataset.fps
        if not abs(apart * dataset.fps - 1) <= RATE_TOLERANCE:
            rate = f" ({1 / apart:.4g} frames per second)" if apart > 0 else ""
            raise DamagedDataSet(
                f"The frames of {self._what} are {apart:.4g} s apart{rate}, and {INFO} says fps {dataset.fps:g}. "
                "Correct the one that is wrong: it says when the policy is called."
            )

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
        if feature.is_picture:
            raise BadArgument(f"The column '{name}' of '{self.dataset.name}' holds {feature.dtype}, not numbers.")
        known = self._numbers if name in self._numbers else self._read([name])
        values, stated = known[name], math.prod(feature.shape)
        if isinstance(values, str):
            raise BadArgument(f"The column '{name}' of {self._what} holds {values}, not as many numbers in each frame.")
        if values.shape[1] != stated:
            raise DamagedDataSet(
                f"The column '{name}' of {self._what} has {values.shape[1]} numbers in each frame, and {INFO} says "
                f"{stated}."
            )
        if not np.isfinite(values).all():
            raise DamagedDataSet(
                f"The column '{name}' of {self._what} has numbers that are NaN or infinite, the first at frame "
                f"{int(np.argmin(np.isfinite(values).all(axis=1)))}."
            )
        return values

    @cached_property
    def _numbers(self) -> dict[str, NDArray[np.float64] | str]:
        """All columns of numbers that the table has, read at once: each reading asks another process."""
        return self._read([n for n, it in self.dataset.features.items() if not it.is_picture and n in self._columns])

    def _read(self, columns: Sequence[str]) -> dict[str, NDArray[np.float64] | str]:
        return self.dataset.process.call(self._table, read_numbers, self._table, columns, self._rows)

    def frames(self, every: int = 1, cameras: Sequence[str] | None = None) -> Iterator[DataSetFrame]:
        """Yield frame 0, `every`, 2 · `every` ... with pictures.

        cameras: the columns whose pictures are read; None for all. Pictures of videos are exact to the frame: the one
        whose time is that of the row, within a quarter of the time between two frames.

        Raises:
            MissingDependency: PyAV is not installed, and there are videos.
            UndecodableVideo, DamagedDataSet: see `VideoFile.picture`.
        """
        if every < 1:
            raise BadArgument(f"Cannot take every {every}th frame; expected at least 1.")
        names = self.dataset.cameras if cameras is None else tuple(dict.fromkeys(cameras))
        for name in names:
            if not self.dataset.feature(name).is_camera:
                raise BadArgument(f"The column '{name}' of '{self.dataset.name}' holds no colour pictures.")
        # Texts and lists of several lengths are nothing that a policy reads as numbers.
        numbers = {name: it for name, it in self._numbers.items() if not isinstance(it, str)}
        self.dataset.fetch([self.entry.videos[name].path for name in names if name in self.entry.videos])
        self._check_ends(names)
        for frame in range(0, self.length, every):
            images = self._pictures(names, frame)
            task = int(self.task_indices[frame])
            yield DataSetFrame(
                episode=self.index,
                index=frame,
                seconds=float(self.seconds[frame]),
                task_index=task,
                instruction=self.dataset.tasks[task],
                images={name: images[name] for name in names},
                values={name: values[frame] for name, values in numbers.items()},
            )

    def _check_ends(self, names: Sequence[str]) -> None:
        """Raise `DamagedDataSet` where a video ends before the episode, whichever of its frames are read."""
        for video in (self.entry.videos[name] for name in names if name in self.entry.videos):
            path, last = self.dataset.folder / video.path, video.begins_at + float(self.seconds[-1])
            self.dataset.process.call(path, check_video_time, path, last, TIME_TOLERANCE / self.dataset.fps)

    def _pictures(self, names: Sequence[str], frame: int) -> dict[str, NDArray[np.uint8]]:
        call, folder = self.dataset.process.call, self.dataset.folder
        videos = {name: self.entry.videos[name] for name in names if name in self.entry.videos}
        stored = tuple(name for name in names if name not in videos)
        images: dict[str, NDArray[np.uint8]] = {}
        if stored:
            images = call(
                self._table, read_pictures, folder, self._table, stored, self._rows, frame, episode=self._what
            )
        for name, video in videos.items():
            path, seconds = folder / video.path, video.begins_at + float(self.seconds[frame])
            images[name] = call(path, read_video_picture, path, seconds, TIME_TOLERANCE / self.dataset.fps)
        return images


def open_dataset(name: str | Path) -> LeRobotDataset:
    """Open a LeRobotDataset: a folder, or `ORG/NAME` or `ORG/NAME@REVISION` of the Hugging Face hub.

    From the hub, only the meta files are fetched now, and the files of an episode when it is read. A copy that LeRobot
    made is used.

    Raises:
        DataSetNotFound, UnsupportedDataSet, DamagedDataSet: see `read_info`.
        MissingDependency, CheckpointUnavailable: the hub's client is missing, or the download failed.
    """
    # Imported here: a folder needs none of it.
    from vla_attention.schemas.hub import downloads, fetch_from_hub, hub_version, say_download, split_hub_name

    folder = Path(name).expanduser()
    on_hub = split_hub_name(str(name))
    if folder.is_dir() or on_hub is None:
        if not folder.exists():
            raise DataSetNotFound(f"There is no data set at '{name}'; give a folder, or ORG/NAME of the hub.")
        return LeRobotDataset(folder, folder.resolve().name)
    repository, revision = on_hub
    copy = _lerobot_home() / repository
    if revision is None and (copy / INFO).is_file():
        return LeRobotDataset(copy, repository)
    how = (
        f"fetch it where there is a network with `hf download --repo-type dataset {name}`, copy the folder here and "
        "give its path (there is no such local folder)"
    )

    folder = fetch_from_hub(repository, META_FILES, how, kind="dataset", revision=revision)
    version = hub_version(folder)
    # The files of episodes are of the same commit as the meta files, whatever is uploaded meanwhile.
    commit = revision if version is None else version.commit

    fetched: set[str] = set()

    def fetch(paths: Sequence[str]) -> None:
        if missing := [path for path in paths if path not in fetched]:
            say_download(repository, missing, "dataset", commit)
            # Paths come from the data set: a star in one would fetch every file of the repository.
            fetch_from_hub(repository, [*map(glob.escape, missing)], how, kind="dataset", revision=commit)
            fetched.update(missing)

    return LeRobotDataset(folder, repository, fetch, downloads(folder))


def _lerobot_home() -> Path:
    """Return the folder of LeRobot's own copies of data sets."""
    home = os.environ.get("HF_HOME") or Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "huggingface"
    return Path(os.environ.get("HF_LEROBOT_HOME") or Path(home) / "lerobot").expanduser()
