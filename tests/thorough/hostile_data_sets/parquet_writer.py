"""Parquet files byte by byte, for files that say what no writer says."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

#: Kinds of Thrift's compact protocol.
I32, I64, BYTES, LIST, STRUCT = 5, 6, 8, 9, 12
#: Physical types, codecs and encodings of Parquet.
INT64, FLOAT, BYTE_ARRAY = 2, 4, 6
PLAIN, RLE, RLE_DICTIONARY = 0, 3, 8
REQUIRED, REPEATED = 0, 2


def varint(number: int) -> bytes:
    out = bytearray()
    while True:
        number, low = number >> 7, number & 127
        out.append(low | (128 if number else 0))
        if not number:
            return bytes(out)


def zigzag(number: int) -> bytes:
    return varint((number << 1) ^ (number >> 63))


def struct_of(*fields: tuple[int, int, object]) -> bytes:
    """A struct of (number, kind, value); lists are (kind, values), structs are bytes that are made already."""
    out, last = b"", 0
    for number, kind, value in fields:
        out += bytes([(number - last) << 4 | kind]) if 0 < number - last < 16 else bytes([kind]) + zigzag(number)
        out, last = out + _value(kind, value), number
    return out + b"\0"


def _value(kind: int, value: object) -> bytes:
    if kind in (I32, I64):
        assert isinstance(value, int)
        return zigzag(value)
    if kind == LIST:
        inner, values = value  # type: ignore[misc]
        head = bytes([len(values) << 4 | inner]) if len(values) < 15 else bytes([0xF0 | inner]) + varint(len(values))
        return head + b"".join(_value(inner, item) for item in values)
    assert isinstance(value, bytes)
    return varint(len(value)) + value if kind == BYTES else value


def run(value: int, count: int) -> bytes:
    """So many times one number below 256, as run lengths have it."""
    return varint(count << 1) + bytes([value])


def page(content: bytes, values: int, *, encoding: int = RLE_DICTIONARY) -> bytes:
    """A page of values."""
    header = struct_of(
        (1, I32, 0),
        (2, I32, len(content)),
        (3, I32, len(content)),
        (5, STRUCT, struct_of((1, I32, values), (2, I32, encoding), (3, I32, RLE), (4, I32, RLE))),
    )
    return header + content


def dictionary(content: bytes, values: int) -> bytes:
    """The page of a dictionary."""
    of = struct_of((1, I32, values), (2, I32, PLAIN))
    return struct_of((1, I32, 2), (2, I32, len(content)), (3, I32, len(content)), (7, STRUCT, of)) + content


@dataclass(frozen=True)
class Stored:
    """A column of one group of rows: its pages, and what the footer says of them.

    kind: physical type. values: in all pages. has_dictionary: the first page is one, of so many `dictionary_bytes` with
    its header. repeated: a list in each row.
    """

    name: str
    kind: int
    pages: bytes
    values: int
    has_dictionary: bool = True
    repeated: bool = False
    dictionary_bytes: int = 0


def constant(name: str, count: int, value: int = 0) -> Stored:
    """A whole number, so many times: a dictionary of one, and one run."""
    first = dictionary(struct.pack("<q", value), 1)
    return Stored(name, INT64, first + page(b"\x01" + run(0, count), count), count, dictionary_bytes=len(first))


def zeros(name: str, rows: int, each: int, *, last: int | None = None) -> Stored:
    """A list of zeros in each row; last: how many the last row has."""
    last = each if last is None else last
    total = (rows - 1) * each + last
    first = dictionary(struct.pack("<f", 0.0), 1)
    # 0 begins a list, 1 goes on with the last
    begins = b"".join(run(0, 1) + (run(1, count - 1) if count > 1 else b"") for count in [each] * (rows - 1) + [last])
    levels = struct.pack("<I", len(begins)) + begins
    defined = run(1, total)
    levels += struct.pack("<I", len(defined)) + defined
    content = levels + b"\x01" + run(0, total)
    return Stored(name, FLOAT, first + page(content, total), total, repeated=True, dictionary_bytes=len(first))


def texts(name: str, text: bytes, count: int, *, repeated: bool = False) -> Stored:
    """One text, so many times."""
    first = dictionary(struct.pack("<I", len(text)) + text, 1)
    levels = b""
    if repeated:
        for level in (run(0, count), run(1, count)):
            levels += struct.pack("<I", len(level)) + level
    pages = first + page(levels + b"\x01" + run(0, count), count)
    return Stored(name, BYTE_ARRAY, pages, count, repeated=repeated, dictionary_bytes=len(first))


def counting(name: str, count: int) -> Stored:
    """The numbers 0, 1, 2 ..."""
    content = struct.pack(f"<{count}q", *range(count))
    return Stored(name, INT64, page(content, count, encoding=PLAIN), count, has_dictionary=False)


def write_parquet(path: Path, columns: Sequence[Stored], rows: int) -> None:
    """Write a file of one group of rows."""
    body, chunks = b"PAR1", []
    elements = [struct_of((4, BYTES, b"schema"), (5, I32, len(columns)))]
    for column in columns:
        start = len(body)
        body += column.pages
        element: list[tuple[int, int, object]] = [(1, I32, column.kind)]
        element += [(3, I32, REPEATED if column.repeated else REQUIRED), (4, BYTES, column.name.encode())]
        element += [(6, I32, 0)] if column.kind == BYTE_ARRAY else []  # a text
        elements.append(struct_of(*element))
        fields: list[tuple[int, int, object]] = [
            (1, I32, column.kind),
            (2, LIST, (I32, [PLAIN, RLE, RLE_DICTIONARY])),
            (3, LIST, (BYTES, [column.name.encode()])),
            (4, I32, 0),
            (5, I64, column.values),
            (6, I64, len(column.pages)),
            (7, I64, len(column.pages)),
            (9, I64, start + column.dictionary_bytes),
        ]
        if column.has_dictionary:
            fields.append((11, I64, start))
        chunks.append(struct_of((2, I64, start), (3, STRUCT, struct_of(*fields))))
    group = struct_of((1, LIST, (STRUCT, chunks)), (2, I64, len(body)), (3, I64, rows))
    footer = struct_of((1, I32, 1), (2, LIST, (STRUCT, elements)), (3, I64, rows), (4, LIST, (STRUCT, [group])))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(body + footer + struct.pack("<I", len(footer)) + b"PAR1")
