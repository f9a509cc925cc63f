"""What is read of an open data set, a call at a time: the functions of the process that reads it (see `bounded`).

Tables and videos stay open between the calls.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.schemas.data_sets.data_set_files import DamagedDataSet, DataSetNotFound, read_table, scan_table
from vla_attention.schemas.data_sets.video import VideoFile

#: Rows of pictures that are in memory at once: with two cameras of a megabyte each, a quarter of a gigabyte.
_ROWS = 128

#: The cameras of an episode are read in turn. The decoder of a video takes up to 100 MB.
_video = lru_cache(maxsize=16)(VideoFile)
_cells = lru_cache(maxsize=1)(read_table)


def open_episode(table: Path, episode: int) -> tuple[range, list[str]]:
    """The rows of an episode, and the columns of its table. They follow one another: rows between them count."""
    rows = np.flatnonzero(_episode_numbers(table) == episode)
    return range(int(rows[0]), int(rows[-1]) + 1) if len(rows) else range(0), list(scan_table(table)[1])


@lru_cache(maxsize=2)
def _episode_numbers(table: Path) -> NDArray[np.float64]:
    numbers = _numbers(read_table(table, ["episode_index"])["episode_index"])
    if numbers is None or numbers.shape[1] != 1:
        raise DamagedDataSet(f"'{table}' has no numbers in its column 'episode_index'.")
    return numbers[:, 0]


def read_numbers(table: Path, columns: Sequence[str], rows: range) -> dict[str, NDArray[np.float64] | str]:
    """Columns as (row, number); of one that has not as many numbers in each row, its type in words."""
    found = read_table(table, columns, rows)
    numbers = {name: _numbers(found[name]) for name in columns}
    return {name: str(found[name].dtype) if values is None else values for name, values in numbers.items()}


def _numbers(series: pl.Series) -> NDArray[np.float64] | None:
    """A column as (row, number); None unless each row has as many numbers. A missing number is NaN.

    Lists of lists become one row of numbers.
    """
    rows = len(series)
    while isinstance(series.dtype, (pl.List, pl.Array)):
        series = series.arr.to_list() if isinstance(series.dtype, pl.Array) else series
        lengths = series.list.len()
        if lengths.null_count() or lengths.n_unique() > 1:
            return None
        if rows and not lengths[0]:  # an empty list would be exploded to a missing value
            return np.zeros((rows, 0))
        series = series.explode()
    if not (series.dtype.is_numeric() or series.dtype == pl.Boolean):
        return None
    return series.cast(pl.Float64).to_numpy().reshape(rows, -1) if rows else np.zeros((0, 0))


def read_pictures(
    folder: Path, table: Path, columns: tuple[str, ...], rows: range, frame: int, episode: str
) -> dict[str, NDArray[np.uint8]]:
    """The pictures of a frame that are in its table, or in files that the table names.

    folder: of the data set. rows: of the episode. episode: its number and data set in words.
    """
    begin = frame - frame % _ROWS
    cells = _cells(table, columns, rows[begin : begin + _ROWS])
    return {
        name: _picture(folder, f"A picture of '{name}' in {episode}", cells[name][frame - begin]) for name in columns
    }


def _picture(folder: Path, what: str, cell: Any) -> NDArray[np.uint8]:
    if cell is not None and not isinstance(cell, Mapping):
        raise DamagedDataSet(f"{what} is a {type(cell).__name__} in its table; expected the bytes of a picture.")
    content = None if cell is None else cell.get("bytes")
    if content is None:
        place = Path("" if cell is None else cell.get("path") or "")
        # A path that leads out of the data set is not followed.
        if place == Path() or place.is_absolute() or ".." in place.parts or not (folder / place).is_file():
            raise DataSetNotFound(f"{what} is neither in its table nor in a file of the data set ('{place}').")
        try:
            content = (folder / place).read_bytes()
        except OSError as error:
            raise DamagedDataSet(f"{what} cannot be read: {error.strerror or error}.") from error
    return decode_picture(what, content)


def decode_picture(what: str, content: bytes) -> NDArray[np.uint8]:
    """Return a picture, PNG or JPEG, as (height, width, 3) uint8 RGB. what: it is, for the error.

    Raises:
        DamagedDataSet: it is no PNG and no JPEG, is larger than pillow allows, or is damaged.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        # No other format: pillow starts Ghostscript for an EPS, whatever its file is called.
        with Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as image:
            return np.array(image.convert("RGB"))  # a copy: torch warns of arrays that cannot be written
    except UnidentifiedImageError:
        raise DamagedDataSet(f"{what} cannot be decoded: it is no PNG and no JPEG.") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DamagedDataSet(f"{what} cannot be decoded ({(str(error) or 'damaged').splitlines()[0]}).") from error


def check_video_time(video: Path, seconds: float, tolerance: float) -> None:
    """Raise `DamagedDataSet` unless a video has a picture at a time."""
    _video(video).nearest(seconds, tolerance)


def read_video_picture(video: Path, seconds: float, tolerance: float) -> NDArray[np.uint8]:
    """The picture of a video at a time; see `VideoFile.picture`."""
    return _video(video).picture(seconds, tolerance)
