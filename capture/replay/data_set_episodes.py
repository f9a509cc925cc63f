"""The episodes and tasks of a LeRobotDataset: numbers, lengths, and in which file and at which second each episode is.

Versions 2.0 and 2.1 have a line of JSON for each, and one data file and one video per episode; version 3.0 has tables,
and several episodes in a file. A data set may have a million episodes: they are kept as arrays.
"""

from __future__ import annotations

import re
import string
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.capture.replay.data_tables import DamagedDataSet, DataSetNotFound, DataTable
from vla_attention.schemas.errors import listing
from vla_attention.schemas.jsonable import decode_json
from vla_attention.schemas.safe_text import check_inner_path

#: How a template may write a number or a name; any other way is not LeRobot's, and could write a path of any length.
_PLAIN_FORMAT = re.compile(r"(0?\d{1,2}d?)?")


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


class Episodes(Mapping[int, EpisodeEntry]):
    """Episodes by their numbers, in the order of these; an entry is made when it is asked for.

    Args:
        indices: (episode,) int64, numbers of the episodes. The last of several with one number counts.
        lengths: (episode,) int64, frames.
        tasks: of each episode.
        paths: of their files.
        places: column of the meta files -> (episode,), where each episode is in files of several; None for files of
            one.
    """

    def __init__(
        self,
        indices: NDArray[np.int64],
        lengths: NDArray[np.int64],
        tasks: Sequence[tuple[str, ...]],
        paths: Paths,
        places: Mapping[str, NDArray[Any]] | None = None,
    ) -> None:
        self._indices, backwards = np.unique(indices[::-1], return_index=True)
        self._rows = len(indices) - 1 - backwards
        self._lengths, self._tasks, self._paths, self._places = lengths, tasks, paths, places

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
        row = int(self._rows[rank])
        if self._places is None:
            data, videos = self._paths.of_episode(index)
        else:
            data, videos = self._paths.of_part({name: values[row] for name, values in self._places.items()})
        return EpisodeEntry(index, int(self._lengths[row]), self._tasks[row], data, videos)

    def _rank(self, index: int) -> int | None:
        rank = int(np.searchsorted(self._indices, index)) if 0 <= index < 2**63 else len(self)
        return rank if rank < len(self) and self._indices[rank] == index else None

    def lengths_and_tasks(self) -> Iterator[tuple[int, int, tuple[str, ...]]]:
        """Number, frames and tasks of each episode."""
        for index, row in zip(self._indices.tolist(), self._rows.tolist(), strict=True):
            yield index, int(self._lengths[row]), self._tasks[row]


class Paths:
    """Paths of data files and videos, from the templates of `info.json`. where: that file, for sentences."""

    def __init__(self, where: str, content: Mapping[str, Any], videos: Sequence[str], per_chunk: int) -> None:
        self._where = where
        self._data = content["data_path"]
        self._video = content.get("video_path")
        self._per_chunk = per_chunk
        self.videos = tuple(videos)
        if per_chunk < 1:
            raise DamagedDataSet(f"{where} has the chunks_size {per_chunk}; expected at least 1.")
        if videos and not self._video:
            raise DamagedDataSet(f"{where} has the videos {listing(videos)} and no video_path.")

    def of_episode(self, index: int) -> tuple[str, dict[str, VideoPlace]]:
        """Return the files of an episode that has its own."""
        numbers = {"episode_index": index, "episode_chunk": index // self._per_chunk}
        videos = {name: VideoPlace(self._filled(self._video, video_key=name, **numbers), 0.0) for name in self.videos}
        return self._filled(self._data, **numbers), videos

    def of_part(self, place: Mapping[str, Any]) -> tuple[str, dict[str, VideoPlace]]:
        """Return the files of an episode that is a part of each. place: columns of the meta files -> its numbers."""

        def numbers(what: str) -> dict[str, int]:
            return {name: int(place[f"{what}/{name}"]) for name in ("chunk_index", "file_index")}

        videos = {
            name: VideoPlace(
                self._filled(self._video, video_key=name, **numbers(f"videos/{name}")),
                float(place[f"videos/{name}/from_timestamp"]),
            )
            for name in self.videos
        }
        return self._filled(self._data, **numbers("data")), videos

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


def _once(names_of_episodes: Iterable[Iterable[str]]) -> list[tuple[str, ...]]:
    """The tasks of episodes; the same tasks are kept once."""
    known: dict[tuple[str, ...], tuple[str, ...]] = {}
    return [known.setdefault(key, key) for key in map(tuple, names_of_episodes)]


def _checked(path: Path, indices: NDArray[np.int64], lengths: NDArray[np.int64]) -> None:
    """Raise `DamagedDataSet` for numbers that no episode has."""
    wrong = (indices < 0) | (lengths < 1)
    if wrong.any():
        first = int(wrong.argmax())
        raise DamagedDataSet(
            f"'{path}' has an episode {indices[first]} of {lengths[first]} frames; expected at least one frame."
        )


# Versions 2.0 and 2.1.


def tasks_of_lines(folder: Path) -> dict[int, str]:
    """Return the tasks by their numbers.

    Raises:
        DataSetNotFound, DamagedDataSet: the file is missing, or cannot be read.
    """
    path = folder / "meta" / "tasks.jsonl"
    with _lines(path) as lines:
        return {_whole(line["task_index"]): str(line["task"]) for line in lines}


def episodes_of_lines(folder: Path, paths: Paths) -> Episodes:
    """Return the episodes; raises what `tasks_of_lines` raises."""
    path = folder / "meta" / "episodes.jsonl"
    with _lines(path) as lines:
        indices = np.array([_whole(line["episode_index"]) for line in lines], dtype=np.int64)
        lengths = np.array([_whole(line["length"]) for line in lines], dtype=np.int64)
        tasks = _once([_texts(line.get("tasks") or []) for line in lines])
    _checked(path, indices, lengths)
    return Episodes(indices, lengths, tasks, paths)


@contextmanager
def _lines(path: Path) -> Iterator[list[dict[str, Any]]]:
    """The objects of a file that has one in each line; what their values raise is said of the file."""
    if not path.is_file():
        raise DataSetNotFound(f"There is no '{path}', which a data set of this version needs.")
    try:
        lines = [line for line in path.read_bytes().split(b"\n") if line.strip()]
        yield decode_json(b"[" + b",".join(lines) + b"]")
    except KeyError as error:
        raise DamagedDataSet(f"'{path}' has a line without {error}.") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise DamagedDataSet(f"'{path}' is not one JSON object per line ({error}).") from error


def _whole(value: object) -> int:
    """A whole number that 64 bits hold, also one that is written as 3.0; `ValueError` for anything else."""
    if isinstance(value, (int, float)) and -(2**63) <= value < 2**63 and value == int(value):
        return int(value)
    raise ValueError(f"{str(value)[:40]!r} is no whole number")


def _texts(values: Any) -> list[str]:
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise ValueError(f"{str(values)[:40]!r} is no list of texts")
    return values


# Version 3.0.


def tasks_of_table(folder: Path) -> dict[int, str]:
    """Return the tasks by their numbers.

    Raises:
        DataSetNotFound, DamagedDataSet: the table is missing, or cannot be read.
    """
    path = folder / "meta" / "tasks.parquet"
    table = DataTable(path)
    # pandas wrote it with the tasks as its index, whose column has a name of its own or none.
    texts = [name for name, kind in table.types.items() if kind == pl.String]
    column = "task" if "task" in texts else texts[0] if len(texts) == 1 else None
    if column is None or "task_index" not in table.types:
        raise DamagedDataSet(f"'{path}' should have the columns task and task_index, but has {listing(table.types)}.")
    rows = table.read(["task_index", column])
    if rows[column].null_count():
        raise DamagedDataSet(f"'{path}' has rows without a text in the column '{column}'.")
    return dict(zip(_whole_numbers(path, rows["task_index"]).to_list(), rows[column].to_list(), strict=True))


def episodes_of_tables(folder: Path, paths: Paths) -> Episodes:
    """Return the episodes; raises what `tasks_of_table` raises."""
    meta = folder / "meta" / "episodes"
    files = sorted(meta.glob("*/*.parquet"))
    if not files:
        raise DataSetNotFound(f"The data set '{folder}' has no Parquet file in meta/episodes, which v3.0 needs.")
    wholes = ["episode_index", "length"]
    wholes += [f"{what}/chunk_index" for what in ("data", *(f"videos/{name}" for name in paths.videos))]
    wholes += [f"{what}/file_index" for what in ("data", *(f"videos/{name}" for name in paths.videos))]
    begins = [f"videos/{name}/from_timestamp" for name in paths.videos]
    # Most columns are statistics of the episodes.
    rows = pl.concat([_typed(path, DataTable(path).read([*wholes, *begins, "tasks"]), begins) for path in files])
    numbers = {name: rows[name].to_numpy() for name in (*wholes, *begins)}
    _checked(meta, numbers["episode_index"], numbers["length"])
    return Episodes(numbers["episode_index"], numbers["length"], _once(rows["tasks"].to_list()), paths, numbers)


def _typed(path: Path, rows: pl.DataFrame, seconds: Sequence[str]) -> pl.DataFrame:
    """The rows of one file, with columns of int64, of float64 (`seconds`), and of lists of texts (`tasks`)."""
    tasks = rows["tasks"]
    if tasks.dtype != pl.List(pl.String) or tasks.list.eval(pl.element().is_null()).list.any().any():
        raise DamagedDataSet(f"'{path}' has no lists of texts in the column 'tasks'.")
    for name in seconds:
        if not rows[name].dtype.is_numeric() or not rows[name].cast(pl.Float64).is_finite().fill_null(False).all():
            raise DamagedDataSet(f"'{path}' has rows without a number in the column '{name}'.")
    return rows.select(
        *(_whole_numbers(path, rows[name]) for name in rows.columns if name not in (*seconds, "tasks")),
        *(rows[name].cast(pl.Float64) for name in seconds),
        tasks.fill_null([]),
    )


def _whole_numbers(path: Path, series: pl.Series) -> pl.Series:
    """A column of whole numbers as int64; some writers store them as floats."""
    if series.dtype.is_numeric():
        whole = series.cast(pl.Int64, strict=False)
        if not whole.null_count() and (whole == series).all():
            return whole
    raise DamagedDataSet(f"'{path}' has numbers in its column '{series.name}' that are no whole ones.")
