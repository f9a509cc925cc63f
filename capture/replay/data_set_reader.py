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

from vla_attention.capture.replay.data_tables import DamagedDataSet, DataSetNotFound, DataTable, stacked
from vla_attention.capture.replay.video import VideoFile

#: Rows of pictures that are in memory at once: with two cameras of a megabyte each, a quarter of a gigabyte.
_ROWS = 128
#: Pixels of a picture: a little more than 4K. A kilobyte can say that it has a billion.
_MOST_PIXELS = 10_000_000
#: How a PNG and a JPEG begin.
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"

#: The episodes of one file follow one another.
_table = lru_cache(maxsize=2)(DataTable)
#: The cameras of an episode are read in turn. The decoder of a video takes up to 100 MB.
_video = lru_cache(maxsize=16)(VideoFile)


def rows_of_episode(table: Path, episode: int) -> range:
    """The rows of an episode; see `DataTable.rows_of`."""
    return _table(table).rows_of(episode)


def numeric_columns(table: Path) -> list[str]:
    """The columns of a table that hold numbers, or lists of them."""
    return _table(table).numeric_columns()


def read_numbers(table: Path, columns: Sequence[str], rows: range) -> dict[str, NDArray[np.generic] | str]:
    """Columns as (row, number); of one that has not as many numbers in each row, its type in words."""
    found = _table(table).read(columns, rows.start, len(rows))
    numbers = {name: stacked(found[name]) for name in columns}
    return {name: str(found[name].dtype) if values is None else values for name, values in numbers.items()}


@lru_cache(maxsize=1)
def _cells(table: Path, columns: tuple[str, ...], rows: range) -> pl.DataFrame:
    return _table(table).read(columns, rows.start, len(rows))


def read_pictures(
    folder: Path, table: Path, columns: tuple[str, ...], rows: range, frame: int, episode: str
) -> dict[str, NDArray[np.uint8]]:
    """The pictures of a frame that are in its table, or in files that the table names.

    folder: of the data set. rows: of the episode. episode: its number and data set in words.
    """
    begin = frame - frame % _ROWS
    cells = _cells(table, columns, rows[begin : begin + _ROWS])
    return {
        name: _decoded(folder, f"A picture of '{name}' in {episode}", cells[name][frame - begin]) for name in columns
    }


def _decoded(folder: Path, what: str, cell: Any) -> NDArray[np.uint8]:
    if cell is not None and not isinstance(cell, Mapping):
        raise DamagedDataSet(f"{what} is a {type(cell).__name__} in its table; expected the bytes of a picture.")
    content = None if cell is None else cell.get("bytes")
    try:
        if content is None:
            place = Path("" if cell is None else cell.get("path") or "")
            # A path that leads out of the data set is not followed.
            if place == Path() or place.is_absolute() or ".." in place.parts or not (folder / place).is_file():
                raise DataSetNotFound(f"{what} is neither in its table nor in a file of the data set ('{place}').")
            content = (folder / place).read_bytes()
        return decode_picture(content)
    except PictureRefused as error:
        raise DamagedDataSet(f"{what} {error}.") from error
    except OSError as error:
        if isinstance(error, DataSetNotFound):
            raise
        raise DamagedDataSet(f"{what} cannot be read: {error.strerror or error}.") from error


class PictureRefused(ValueError):
    """Bytes that are no picture of these formats, or a damaged one; the text completes "it ..."."""


def decode_picture(content: bytes) -> NDArray[np.uint8]:
    """Return a picture, PNG or JPEG, as (height, width, 3) uint8 RGB, in an array of its own.

    No other format: pillow starts Ghostscript for an EPS, whatever its file is called.

    Raises:
        PictureRefused: it is no PNG and no JPEG, is larger than a picture is, or is damaged.
    """
    from PIL import JpegImagePlugin, PngImagePlugin

    if not content.startswith((_PNG, _JPEG)):
        raise PictureRefused("cannot be decoded: it is no PNG and no JPEG")
    # Not by `Image.open`, which warns of large pictures before their size is known here.
    kind = PngImagePlugin.PngImageFile if content.startswith(_PNG) else JpegImagePlugin.JpegImageFile
    try:
        with kind(io.BytesIO(content)) as image:
            width, height = image.size
            if width * height > _MOST_PIXELS:
                raise PictureRefused(f"has {width:,} x {height:,} pixels; expected at most {_MOST_PIXELS:,} in all")
            return np.array(image.convert("RGB"))  # a copy: torch warns of arrays that cannot be written
    except (OSError, SyntaxError, ValueError) as error:
        if isinstance(error, PictureRefused):
            raise
        raise PictureRefused(f"cannot be decoded ({(str(error) or type(error).__name__).splitlines()[0]})") from error


def read_video_picture(video: Path, seconds: float, tolerance: float) -> NDArray[np.uint8]:
    """The picture of a video at a time; see `VideoFile.picture`."""
    return _video(video).picture(seconds, tolerance)
