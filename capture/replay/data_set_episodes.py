"""The episodes and tasks of a LeRobotDataset: numbers, lengths, and in which file and at which second each episode is.

Versions 2.0 and 2.1 have a line of JSON for each, and one data file and one video per episode; version 3.0 has tables,
and several episodes in a file. A data set may have a million episodes: they are kept as arrays.
"""

from __future__ import annotations

import os
import re
import string
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.capture.replay.data_tables import DamagedDataSet, DataSetError, DataSetNotFound, DataTable
from vla_attention.schemas.documents import decode_json
from vla_attention.schemas.errors import listing
from vla_attention.schemas.limit_checks import TooLarge, check_at_most
from vla_attention.schemas.limits import (
    DATA_SET_EPISODES,
    DATA_SET_TASKS,
    DATA_SET_TEXT_BYTES,
    DOCUMENT_BYTES,
    LINE_CHARACTERS,
    TEXT_CHARACTERS,
    WHOLE_NUMBER,
)
from vla_attention.schemas.regular_files import NotRegular, open_regular
from vla_attention.schemas.safe_text import check_inner_path

#: How a template may write a number or a name; any other way is not LeRobot's, and could write a path of any length.
_PLAIN_FORMAT = re.compile(r"(0?\d{1,2}d?)?")
#: Bytes of lines that are decoded at once.
_BLOCK_BYTES = 1_000_000


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


#: The files of an episode, by its place among the episodes as they were read: of its table, and of each video.
FilesOf = Callable[[int], tuple[str, dict[str, VideoPlace]]]


class Episodes(Mapping[int, EpisodeEntry]):
    """Episodes by their numbers, in the order of these; an entry is made when it is asked for.

    Args:
        indices: (episode,) int64, numbers of the episodes. The last of several with one number counts.
        lengths: (episode,) int64, frames.
        tasks: of each episode.
        files_of: place among `indices` -> the files of the episode.
    """

    def __init__(
        self,
        indices: NDArray[np.int64],
        lengths: NDArray[np.int64],
        tasks: Sequence[tuple[str, ...]],
        files_of: FilesOf,
    ) -> None:
        self._indices, backwards = np.unique(indices[::-1], return_index=True)
        self._places = len(indices) - 1 - backwards
        self._lengths, self._tasks, self._files_of = lengths, tasks, files_of

    def __len__(self) -> int:
        return len(self._indices)

    def __iter__(self) -> Iterator[int]:
        return iter(self._indices.tolist())

    def __contains__(self, index: object) -> bool:
        return isinstance(index, int) and self._rank(index) is not None

    def __getitem__(self, index: int) -> EpisodeEntry:
        rank = self._rank(index)
        if rank is None:
            raise KeyError(index)
        place = int(self._places[rank])
        data, videos = self._files_of(place)
        return EpisodeEntry(index, int(self._lengths[place]), self._tasks[place], data, videos)

    def _rank(self, index: int) -> int | None:
        rank = int(np.searchsorted(self._indices, index)) if 0 <= index < WHOLE_NUMBER else len(self)
        return rank if rank < len(self) and self._indices[rank] == index else None

    @property
    def num_frames(self) -> int:
        """Frames of all episodes."""
        return sum(self._lengths[self._places].tolist())

    def lengths_and_tasks(self) -> Iterator[tuple[int, int, tuple[str, ...]]]:
        """Number, frames and tasks of each episode."""
        for index, place in zip(self._indices.tolist(), self._places.tolist(), strict=True):
            yield index, int(self._lengths[place]), self._tasks[place]


class Paths:
    """Paths of data files and videos, from the templates of `info.json`. where: that file, for sentences."""

    def __init__(self, where: str, content: Mapping[str, Any], videos: Sequence[str], per_chunk: int) -> None:
        self._where = where
        self._data = content["data_path"]
        self._video = content.get("video_path")
        self._per_chunk = per_chunk
        self.videos = tuple(videos)
        if videos and not self._video:
            raise DamagedDataSet(f"{where} has the videos {listing(videos)} and no video_path.")

    def of_episode(self, index: int) -> tuple[str, dict[str, VideoPlace]]:
        """Return the files of an episode that has its own."""
        numbers = {"episode_index": index, "episode_chunk": index // self._per_chunk}
        videos = {name: VideoPlace(self._filled(self._video, video_key=name, **numbers), 0.0) for name in self.videos}
        return self._filled(self._data, **numbers), videos

    def of_file(self, chunk: int, file: int, video: str | None = None) -> str:
        """Return the path of a file of several episodes: of a video, or of a table."""
        numbers = {"chunk_index": chunk, "file_index": file}
        return (
            self._filled(self._data, **numbers)
            if video is None
            else self._filled(self._video, video_key=video, **numbers)
        )

    def _filled(self, template: object, **values: Any) -> str:
        try:
            if not isinstance(template, str):
                raise ValueError("it is no text")
            if len(template) > LINE_CHARACTERS:
                raise ValueError(f"it has {len(template):,} characters; expected at most {LINE_CHARACTERS:,}")
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


def limited(what: str, given: int, most: int, least: int = 0) -> None:
    """Raise `DamagedDataSet` unless a number is in its range; see `check_at_most`."""
    try:
        check_at_most(what, given, most, least)
    except TooLarge as error:
        raise DamagedDataSet(str(error)) from None


class _Tasks:
    """The tasks of episodes: the same names, and the same tuples of them, are kept once."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._names: dict[str, str] = {}
        self._tuples: dict[tuple[str, ...], tuple[str, ...]] = {}
        self._count = 0
        self.of_episodes: list[tuple[str, ...]] = []

    def add(self, names: Sequence[str]) -> None:
        key = tuple(names)
        known = self._tuples.get(key)
        if known is None:
            known = tuple(self._names.setdefault(name, name) for name in key)
            self._tuples[known] = known
        self.of_episodes.append(known)
        self._count += len(known)
        if self._count > DATA_SET_TASKS:
            limited(f"The number of names of tasks in '{self._path}'", self._count, DATA_SET_TASKS)


def _checked(path: Path, indices: NDArray[np.int64], lengths: NDArray[np.int64]) -> None:
    """Raise `DamagedDataSet` for numbers that no episode has."""
    limited(f"The number of episodes in '{path}'", len(indices), DATA_SET_EPISODES)
    wrong = (indices < 0) | (lengths < 1)
    if wrong.any():
        first = int(wrong.argmax())
        raise DamagedDataSet(
            f"'{path}' has an episode {indices[first]} of {lengths[first]} frames; expected at least one frame."
        )


def _checked_tasks(path: Path, tasks: dict[int, str]) -> dict[int, str]:
    for index, task in tasks.items():
        if len(task) > TEXT_CHARACTERS:
            limited(f"The number of characters of task {index} in '{path}'", len(task), TEXT_CHARACTERS)
    return tasks


# Versions 2.0 and 2.1.


def tasks_of_lines(folder: Path) -> dict[int, str]:
    """Return the tasks by their numbers.

    Raises:
        DataSetNotFound, DamagedDataSet: the file is missing, or cannot be read.
    """
    path = folder / "meta" / "tasks.jsonl"
    tasks: dict[int, str] = {}
    for objects in _blocks_of_lines(path, DATA_SET_TASKS):
        try:
            tasks.update((_whole(line["task_index"]), str(line["task"])) for line in objects)
        except (KeyError, ValueError) as error:
            raise DamagedDataSet(f"'{path}' has a line without task_index and task ({error}).") from error
    return _checked_tasks(path, tasks)


def episodes_of_lines(folder: Path, paths: Paths) -> Episodes:
    """Return the episodes; raises what `tasks_of_lines` raises."""
    path = folder / "meta" / "episodes.jsonl"
    indices, lengths, tasks = array("q"), array("q"), _Tasks(path)
    for objects in _blocks_of_lines(path, DATA_SET_EPISODES):
        try:
            indices.extend([_whole(line["episode_index"]) for line in objects])
            lengths.extend([_whole(line["length"]) for line in objects])
        except (KeyError, ValueError) as error:
            raise DamagedDataSet(f"'{path}' has a line without episode_index and length ({error}).") from error
        for line in objects:
            names = line.get("tasks") or ()
            if not isinstance(names, (list, tuple)) or any(not isinstance(name, str) for name in names):
                raise DamagedDataSet(f"'{path}' has a line whose tasks are no list of texts.")
            tasks.add(names)
    numbers, frames = np.array(indices, dtype=np.int64), np.array(lengths, dtype=np.int64)
    _checked(path, numbers, frames)
    return Episodes(numbers, frames, tasks.of_episodes, lambda place: paths.of_episode(indices[place]))


def _blocks_of_lines(path: Path, most: int) -> Iterator[list[dict[str, Any]]]:
    """The objects of a file that has one in each line, many at a time. most: lines that it may have."""
    if not path.is_file():
        raise DataSetNotFound(f"There is no '{path}', which a data set of this version needs.")
    try:
        handle, size = open_regular(path)
        with os.fdopen(handle, "rb") as file:
            limited(f"The number of bytes of '{path}'", size, DATA_SET_TEXT_BYTES)
            limited(f"The number of lines of '{path}'", sum(block.count(b"\n") for block in _whole_lines(file)), most)
            file.seek(0)
            for block in _whole_lines(file):
                lines = [line for line in block.split(b"\n") if line and not line.isspace()]
                objects = decode_json(b"[" + b",".join(lines) + b"]")
                if len(objects) != len(lines) or not all(isinstance(value, dict) for value in objects):
                    raise ValueError("a line holds something else")
                yield objects
    except NotRegular as error:
        raise DamagedDataSet(f"'{path}' cannot be read: {error.strerror}.") from None
    except (ValueError, OSError) as error:
        if isinstance(error, DataSetError):
            raise
        raise DamagedDataSet(f"'{path}' is not one JSON object per line ({error}).") from error


def _whole_lines(file: IO[bytes]) -> Iterator[bytes]:
    """The content of a file in pieces that end with a line."""
    rest = b""
    while block := file.read(_BLOCK_BYTES):
        rest += block
        end = rest.rfind(b"\n") + 1
        if end:
            yield rest[:end]
            rest = rest[end:]
        elif len(rest) > DOCUMENT_BYTES:
            raise ValueError(f"it has a line of more than {DOCUMENT_BYTES:,} bytes")
    if rest:
        yield rest


def _whole(value: object) -> int:
    """A whole number that 64 bits hold, also one that is written as 3.0; `ValueError` for anything else."""
    if type(value) is int and -WHOLE_NUMBER <= value < WHOLE_NUMBER:
        return value
    if isinstance(value, (int, float)) and -WHOLE_NUMBER <= value < WHOLE_NUMBER and value == int(value):
        return int(value)
    raise ValueError(f"{str(value)[:40]!r} is no whole number")


# Version 3.0.


def tasks_of_table(folder: Path) -> dict[int, str]:
    """Return the tasks by their numbers.

    Raises:
        DataSetNotFound, DamagedDataSet: the table is missing, or cannot be read.
    """
    path = folder / "meta" / "tasks.parquet"
    table = DataTable(path)
    # pandas wrote it with the tasks as its index, whose column has a name of its own or none.
    texts = [name for name in table.columns if table.file.is_text(name)]
    column = "task" if "task" in texts else texts[0] if len(texts) == 1 else None
    if column is None or "task_index" not in table.columns:
        raise DamagedDataSet(f"'{path}' should have the columns task and task_index, but has {listing(table.columns)}.")
    limited(f"The number of tasks in '{path}'", table.file.rows, DATA_SET_TASKS)
    rows = table.read(["task_index", column])
    numbers = _whole_numbers(path, rows["task_index"])
    return _checked_tasks(path, dict(zip(numbers.tolist(), _texts(path, rows[column]), strict=True)))


def episodes_of_tables(folder: Path, paths: Paths) -> Episodes:
    """Return the episodes; raises what `tasks_of_table` raises."""
    videos = paths.videos
    files = sorted((folder / "meta" / "episodes").glob("*/*.parquet"))
    if not files:
        raise DataSetNotFound(f"The data set '{folder}' has no Parquet file in meta/episodes, which v3.0 needs.")
    wanted = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    for name in videos:
        wanted += [f"videos/{name}/{what}" for what in ("chunk_index", "file_index")]
    begins = [f"videos/{name}/from_timestamp" for name in videos]
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in (*wanted, *begins)}
    tasks, total = _Tasks(folder / "meta" / "episodes"), 0
    for path in files:
        table = DataTable(path)
        total += table.file.rows
        limited(f"The number of episodes in '{path.parent.parent}'", total, DATA_SET_EPISODES)
        # Most columns are statistics of the episodes.
        rows = table.read([*wanted, *begins, "tasks"])
        for name in wanted:
            parts[name].append(_whole_numbers(path, rows[name]))
        for name in begins:
            parts[name].append(_seconds(path, rows[name]))
        _checked(path, parts["episode_index"][-1], parts["length"][-1])
        for names in _lists_of_texts(path, rows["tasks"]):
            tasks.add(names)
    numbers = {name: np.concatenate(arrays) for name, arrays in parts.items()}

    def files_of(place: int) -> tuple[str, dict[str, VideoPlace]]:
        def path_of(what: str, video: str | None) -> str:
            return paths.of_file(
                int(numbers[f"{what}/chunk_index"][place]), int(numbers[f"{what}/file_index"][place]), video
            )

        return path_of("data", None), {
            name: VideoPlace(path_of(f"videos/{name}", name), float(numbers[f"videos/{name}/from_timestamp"][place]))
            for name in videos
        }

    return Episodes(numbers["episode_index"], numbers["length"], tasks.of_episodes, files_of)


def _whole_numbers(path: Path, series: pl.Series) -> NDArray[np.int64]:
    """A column of whole numbers, (row,); some writers store them as floats."""
    if series.dtype.is_integer() and not series.null_count():
        with np.errstate(invalid="ignore"):
            return series.to_numpy().astype(np.int64)
    values = _seconds(path, series)
    if not ((np.abs(values) < WHOLE_NUMBER) & (values == np.floor(values))).all():
        raise DamagedDataSet(f"'{path}' has numbers in its column '{series.name}' that are no whole ones.")
    return values.astype(np.int64)


def _seconds(path: Path, series: pl.Series) -> NDArray[np.float64]:
    """A column of numbers, (row,) float64."""
    values = series.cast(pl.Float64).to_numpy() if series.dtype.is_numeric() else np.full(len(series), np.nan)
    if not np.isfinite(values).all():
        raise DamagedDataSet(f"'{path}' has rows without a number in the column '{series.name}'.")
    return values


def _texts(path: Path, series: pl.Series) -> list[str]:
    """A column of texts; each is repeated in Python's memory as often as it stands there."""
    if series.dtype != pl.String or series.null_count():
        raise DamagedDataSet(f"'{path}' has rows without a text in the column '{series.name}'.")
    stored = int(series.str.len_bytes().sum())
    limited(f"The number of bytes of all texts in the column '{series.name}' of '{path}'", stored, DATA_SET_TEXT_BYTES)
    return series.to_list()


def _lists_of_texts(path: Path, series: pl.Series) -> Iterator[Sequence[str]]:
    """The texts of each row of a column of lists; none where a list is missing."""
    if not isinstance(series.dtype, pl.List) or series.dtype.inner != pl.String:
        raise DamagedDataSet(f"'{path}' has no lists of texts in the column '{series.name}'.")
    lengths = series.list.len().fill_null(0).to_list()
    texts = iter(_texts(path, series.filter(series.list.len() > 0).explode()))
    for length in lengths:
        yield list(islice(texts, length))
