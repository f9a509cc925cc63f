"""The meta files of a LeRobotDataset: columns, tasks and episodes, and in which file each episode is.

Versions 2.0 and 2.1 have a line of JSON for each episode, and one data file and one video per episode; version 3.0 has
tables, and several episodes in a file. Both become one table. Format: `src/lerobot/datasets/` of LeRobot.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import polars as pl

from vla_attention.schemas.checked_files import read_object
from vla_attention.schemas.errors import UserError, listing
from vla_attention.schemas.jsonable import decode_json
from vla_attention.schemas.safe_text import check_inner_path


class DataSetError(UserError, ValueError):
    """A data set that cannot be used as it is."""


class DataSetNotFound(DataSetError, FileNotFoundError):
    """There is no data set, or a file of it is missing."""


class DamagedDataSet(DataSetError):
    """A file of a data set that cannot be read, or that contradicts the others."""


class UnsupportedDataSet(DataSetError):
    """A data set of another kind or version."""


INFO = "meta/info.json"
VERSIONS = ("v2.0", "v2.1", "v3.0")
#: Columns that every data set has, and that are numbers of its own.
INDEX_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
#: What is read before the episodes are known.
META_FILES = ("meta/*.json", "meta/*.jsonl", "meta/*.parquet", "meta/episodes/**")
#: The columns of tasks and of episodes, with their types.
_TASKS = {"task_index": pl.Int64(), "task": pl.String()}
_EPISODES = {"episode_index": pl.Int64(), "length": pl.Int64(), "tasks": pl.List(pl.String())}
#: What a value of a type is, for sentences.
_IN_WORDS: Mapping[type[pl.DataType], str] = {
    pl.Int64: "a whole number",
    pl.Float64: "a finite number",
    pl.String: "a text",
    pl.List: "a list of texts",
}


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
    def is_picture(self) -> bool:
        """Whether the values are pictures, of colours or distances."""
        return self.dtype in ("video", "image")

    @property
    def is_camera(self) -> bool:
        """Whether the values are colour pictures."""
        return self.is_picture and not self.depth


@dataclass(frozen=True)
class VideoPlace:
    """Where the pictures of one camera of one episode are: a file, and the second at which the episode begins."""

    path: str
    begins_at: float


@dataclass(frozen=True)
class EpisodeEntry:
    """One episode as the meta files describe it: number of frames, tasks, and its files inside of the data set.

    tasks: empty where the meta files do not name them; the rows do in any case.
    """

    index: int
    length: int
    tasks: tuple[str, ...]
    data: str
    videos: Mapping[str, VideoPlace]


@dataclass(frozen=True)
class DataSetInfo:
    """The content of `meta/`.

    tasks: by their numbers. rows: the episodes, in the order of their numbers; there may be a million. data_path,
    video_path: templates of the files' paths. per_chunk: episodes of a folder, where each has files of its own.
    """

    version: str
    fps: float
    robot_type: str
    features: Mapping[str, Feature]
    tasks: Mapping[int, str]
    rows: pl.DataFrame
    data_path: str
    video_path: str | None
    per_chunk: int

    def entry(self, row: int) -> EpisodeEntry:
        """Return the episode of a row.

        Raises:
            DamagedDataSet: a template cannot be filled, or leads out of the data set.
        """
        stored = self.rows.row(row, named=True)
        videos = {
            name: VideoPlace(
                self._filled(self.video_path, stored, f"videos/{name}", video_key=name),
                stored.get(f"videos/{name}/from_timestamp", 0.0),
            )
            for name, feature in self.features.items()
            if feature.dtype == "video"
        }
        data = self._filled(self.data_path, stored, "data")
        return EpisodeEntry(stored["episode_index"], stored["length"], tuple(stored["tasks"]), data, videos)

    def _filled(self, template: str | None, stored: Mapping[str, Any], what: str, **names: str) -> str:
        index = stored["episode_index"]
        numbers = {name: stored.get(f"{what}/{name}") for name in ("chunk_index", "file_index")}
        try:
            path = str(template).format(episode_index=index, episode_chunk=index // self.per_chunk, **numbers, **names)
            check_inner_path(path)
        except (KeyError, ValueError, IndexError, AttributeError, TypeError) as error:
            raise DamagedDataSet(
                f"{INFO} has the path template {template!r}, which cannot be filled for episode {index} ({error})."
            ) from None
        return path


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
    content = read_object(path, DamagedDataSet)
    version = content.get("codebase_version")
    if version not in VERSIONS:
        raise UnsupportedDataSet(
            f"The data set '{folder}' has version {version!r}; this program reads {listing(VERSIONS)}: convert it with "
            "LeRobot's own script, or download it in one of these versions."
        )
    try:
        features = {name: _feature(name, stated) for name, stated in content["features"].items()}
        fps, per_chunk, data_path = float(content["fps"]), int(content.get("chunks_size") or 1000), content["data_path"]
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DamagedDataSet(f"'{path}' lacks what a data set of {version} says ({error!r}).") from error
    if not (math.isfinite(fps) and fps > 0 and per_chunk > 0):
        raise DamagedDataSet(f"'{path}' has fps {fps} and chunks_size {per_chunk}; expected numbers above 0.")
    videos = [name for name, feature in features.items() if feature.dtype == "video"]
    tasks, rows = _tables(folder, videos, fps) if version == "v3.0" else _lines(folder)
    wrong = rows.filter((pl.col("episode_index") < 0) | (pl.col("length") < 1))
    if len(wrong):
        number, length = wrong.row(0)[:2]
        raise DamagedDataSet(f"'{folder}' has an episode {number} of {length} frames; expected at least one frame.")
    # The last of several with one number counts.
    rows = rows.unique("episode_index", keep="last").sort("episode_index")
    if version == "v3.0":
        for name in videos:
            _check_times(folder, rows, f"videos/{name}", fps)
    info = DataSetInfo(
        version=version,
        fps=fps,
        robot_type=str(content.get("robot_type") or "unknown"),
        features=features,
        tasks=dict(zip(tasks["task_index"].to_list(), tasks["task"].to_list(), strict=True)),
        rows=rows,
        data_path=data_path,
        video_path=content.get("video_path"),
        per_chunk=per_chunk,
    )
    if len(rows):
        info.entry(0)  # a template that cannot be filled is said now
    return info


def _feature(name: str, stated: Mapping[str, Any]) -> Feature:
    names = stated.get("names")
    if isinstance(names, Mapping):  # as {"motors": [...]}
        names = next((value for value in names.values() if isinstance(value, list)), [])
    info = stated.get("info") or stated.get("video_info") or {}
    depth = bool(info.get("is_depth_map") or info.get("video.is_depth_map"))
    shape = tuple(int(size) for size in stated["shape"])
    return Feature(name, str(stated["dtype"]), shape, tuple(str(part) for part in names or ()), depth)


def _lines(folder: Path) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Tasks and episodes of versions 2.0 and 2.1: files with a JSON object in each line."""
    tables = []
    for name, types in (("tasks", _TASKS), ("episodes", _EPISODES)):
        path = folder / "meta" / f"{name}.jsonl"
        if not path.is_file():
            raise DataSetNotFound(f"There is no '{path}', which a data set of this version needs.")
        try:
            lines = decode_json(
                b"[" + b",".join(line for line in path.read_bytes().split(b"\n") if line.strip()) + b"]"
            )
            columns = {key: [line.get(key) for line in lines] for key in types}
            # Whole numbers may be written as 3.0 here and there.
            table = pl.DataFrame(
                pl.Series(key, columns[key], strict=False) if kind.is_numeric() else pl.Series(key, columns[key], kind)
                for key, kind in types.items()
            )
        except (ValueError, TypeError, AttributeError, OverflowError, pl.exceptions.PolarsError) as error:
            raise DamagedDataSet(f"'{path}' is not one JSON object per line ({error}).") from error
        tables.append(_typed(path, table, types))
    return tables[0], tables[1]


def _check_times(folder: Path, rows: pl.DataFrame, video: str, fps: float) -> None:
    """Raise `DamagedDataSet` where an episode's part of a file is of another length, or begins in another's.

    A merge that shifts the times of a part wrongly leaves such a table, and pictures of another episode.
    """
    file = [f"{video}/chunk_index", f"{video}/file_index"]
    times = rows.select(
        *file, "episode_index", "length", begins=f"{video}/from_timestamp", ends=f"{video}/to_timestamp"
    ).sort(*file, "begins")
    times = times.with_columns(
        before=pl.col("episode_index").shift(1).over(file), ended=pl.col("ends").shift(1).over(file)
    )
    half = 0.5 / fps
    for contradiction, is_wrong in (
        ("has {length} frames", (pl.col("ends") - pl.col("begins") - pl.col("length") / fps).abs() > half),
        ("begins before the end of episode {before} at {ended:.4g} s", pl.col("begins") < pl.col("ended") - half),
    ):
        wrong = times.filter(is_wrong)
        if len(wrong):
            one = wrong.row(0, named=True)
            raise DamagedDataSet(
                f"In '{folder / 'meta' / 'episodes'}', episode {one['episode_index']} is from {one['begins']:.4g} to "
                f"{one['ends']:.4g} s of a file of '{video}' and {contradiction.format(**one)} ({len(wrong)} such "
                "episodes): it would show pictures of another. Correct from_timestamp and to_timestamp, or merge the "
                "data sets again."
            )


def _tables(folder: Path, videos: Sequence[str], fps: float) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Tasks and episodes of version 3.0."""
    path = folder / "meta" / "tasks.parquet"
    types = scan_table(path)[1]
    # pandas wrote it with the tasks as its index, whose column has a name of its own or none.
    texts = [name for name, kind in types.items() if kind == pl.String]
    column = "task" if "task" in texts else texts[0] if len(texts) == 1 else None
    if column is None or "task_index" not in types:
        raise DamagedDataSet(f"'{path}' should have the columns task and task_index, but has {listing(types)}.")
    tasks = _typed(path, read_table(path, ["task_index", column]).rename({column: "task"}), _TASKS)
    files = sorted((folder / "meta" / "episodes").glob("*/*.parquet"))
    if not files:
        raise DataSetNotFound(f"The data set '{folder}' has no Parquet file in meta/episodes, which v3.0 needs.")
    whats = ["data", *(f"videos/{name}" for name in videos)]
    wanted = _EPISODES | {f"{what}/{number}": pl.Int64() for what in whats for number in ("chunk_index", "file_index")}
    wanted |= {f"videos/{name}/{end}_timestamp": pl.Float64() for name in videos for end in ("from", "to")}
    tables = []
    for path in files:
        untold = {"tasks"} - set(scan_table(path)[1])  # as in lerobot/libero: the rows name them
        # Most columns are statistics of the episodes.
        table = read_table(path, [name for name in wanted if name not in untold])
        none = pl.lit([], wanted["tasks"]).alias("tasks")
        tables.append(_typed(path, table.with_columns(none) if untold else table, wanted))
    return tasks, pl.concat(tables)


def _typed(path: Path, table: pl.DataFrame, types: Mapping[str, pl.DataType]) -> pl.DataFrame:
    """The columns of a table in these types, without a missing value; some writers store whole numbers as floats."""
    columns = []
    for name, kind in types.items():
        column = table[name]
        if kind == pl.List(pl.String):
            column = column.fill_null([]) if column.dtype == kind else column
            flat = column.filter(column.list.len() > 0).explode() if column.dtype == kind else None
            is_right = flat is not None and not flat.null_count()
        elif kind.is_numeric() and column.dtype.is_numeric():
            typed = column.cast(kind, strict=False)
            is_right = bool((typed == column).fill_null(False).all() and (kind == pl.Int64 or typed.is_finite().all()))
            column = typed
        else:
            is_right = column.dtype == kind and not column.null_count()
        if not is_right and len(column):
            raise DamagedDataSet(
                f"'{path}' has rows without {_IN_WORDS[type(kind)]} in the column '{name}'; get the file again."
            )
        columns.append(column.cast(kind).alias(name))
    return pl.DataFrame(columns)


@lru_cache(maxsize=2)
def scan_table(path: Path) -> tuple[pl.LazyFrame, Mapping[str, pl.DataType]]:
    """A Parquet file of a data set, and the types of its columns. The footer is read once.

    Raises:
        DataSetNotFound: there is no such file.
        DamagedDataSet: it is no Parquet file, or damaged.
    """
    if not path.is_file():
        raise DataSetNotFound(f"There is no '{path}', which the data set names.")
    with _refusing(path):
        scan = pl.scan_parquet(path, glob=False)  # a name with brackets or a star is a name, not a pattern
        return scan, scan.collect_schema()


def read_table(path: Path, columns: Sequence[str], rows: range | None = None) -> pl.DataFrame:
    """Read columns of a table, in all rows or in some that follow one another; only these are decoded.

    Raises:
        DataSetNotFound: there is no such file.
        DamagedDataSet: there is no such column, or it cannot be decoded.
    """
    scan, types = scan_table(path)
    missing = [name for name in columns if name not in types]
    if missing:
        raise DamagedDataSet(f"'{path}' has no column {listing(missing)}; it has {listing(types)}.")
    with _refusing(path):
        chosen = scan.select(columns)
        return (chosen if rows is None else chosen.slice(rows.start, len(rows))).collect()


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    try:
        yield
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
        raise DamagedDataSet(f"'{path}' cannot be read ({str(error).splitlines()[0]}).") from error
