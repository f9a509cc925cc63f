"""Hostile pictures, in the table and in files beside it."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import polars as pl

from tests.thorough.hostile_checkpoints.hostile_files import pipe, sparse
from tests.thorough.hostile_data_sets.made import CAMERA, TABLE, Case, hostile
from tests.thorough.hostile_runs import Make

CELLS = pl.Struct({"bytes": pl.Binary, "path": pl.String})


def picture(content: Callable[[], bytes], version: str = "v2.1") -> Make:
    """These bytes as the picture of every frame."""

    def change(robot: Path) -> None:
        cell = {"bytes": content(), "path": "frame.png"}
        _exchange(robot / TABLE[version], cell)

    return hostile(change, version=version)


def file(make: Callable[[Path], object]) -> Make:
    """A file beside the table as the picture of every frame."""

    def change(robot: Path) -> None:
        (robot / "images").mkdir()
        make(robot / "images" / "frame.png")
        _exchange(robot / TABLE["v2.1"], {"bytes": None, "path": "images/frame.png"})

    return hostile(change)


def _exchange(path: Path, cell: dict[str, object]) -> None:
    rows = pl.read_parquet(path)
    rows.with_columns(pl.Series(CAMERA, [cell] * len(rows), dtype=CELLS)).write_parquet(path)


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int, height: int, *, bits: int = 1, more: bytes = b"", filled: bool = True) -> bytes:
    """A black PNG of shades of grey; filled: with all of its pixels."""
    pixels = zlib.compress(bytes(height * (1 + (width * bits + 7) // 8)) if filled else b"", 9)
    header = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header) + more + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def eps() -> bytes:
    return b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 96 64\n%%EndComments\nshowpage\n"


def text_bomb() -> bytes:
    return chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(200_000_000), 9))


PICTURES: dict[str, Case] = {
    "a PNG header of 100,000 x 100,000": Case(
        picture(lambda: png(100_000, 100_000, filled=False)), "cannot be decoded .*10000000000 pixels"
    ),
    "a PNG with few of its pixels": Case(picture(lambda: png(4000, 2000, filled=False)), "cannot be decoded"),
    "a PNG with a text of 200 MB": Case(picture(lambda: png(96, 64, more=text_bomb())), "cannot be decoded"),
    "an EPS": Case(picture(eps), "no PNG and no JPEG"),
    "a file of a terabyte": Case(
        file(lambda path: sparse(path, 2**40, png(96, 64))),
        "cannot be read with 4 GB of memory",
    ),
    "a pipe": Case(file(pipe), "neither in its table nor in a file"),
}
