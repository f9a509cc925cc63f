"""Parquet files, whose sizes are checked before a library decodes them.

Twelve kilobytes can be a page that says one value a billion times, or four gigabytes of zeros, compressed. Everything
that a reader takes memory for is written in the footer of the file and in front of each page. Format, with the numbers
of all fields: `parquet.thrift` of github.com/apache/parquet-format.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from vla_attention.capture.foreign_files.thrift_structs import (
    BINARY,
    INTEGERS,
    LIST,
    NUMBER,
    STRUCT,
    DamagedThrift,
    Wanted,
    list_head,
    read_fields,
    skip_value,
    varint,
)
from vla_attention.schemas.limits import (
    CLAIMED_BYTES,
    TABLE_COLUMNS,
    TABLE_EXPANSION,
    TABLE_FOOTER_BYTES,
    TABLE_NESTING,
    TABLE_PAGES,
)
from vla_attention.schemas.regular_files import open_regular

_MAGIC, _END = b"PAR1", 8
#: Bytes of a value in memory by its type: of the bytes of a text or picture, a reference to them beside themselves.
_WIDTHS = {0: 1, 1: 4, 2: 8, 3: 12, 4: 4, 5: 8, 6: 16}
_BYTES, _FIXED = 6, 7
#: Bytes that a value has at least in a file: the length in front of a text.
_LEAST_BYTES = {0: 0, 6: 4}
#: Encodings in which a page cannot hold more bytes of text than it has: all but that of shared beginnings (7), with
#: which a megabyte of text is repeated by a few bytes.
_ENCODINGS = {0, 2, 3, 4, 5, 6, 8, 9}
_DATA_PAGE, _DICTIONARY_PAGE, _DATA_PAGE_2 = 0, 2, 3
#: The field of a page's header that describes its values, by its type.
_VALUES_FIELD: dict[object, int] = {_DATA_PAGE: 5, _DICTIONARY_PAGE: 7, _DATA_PAGE_2: 8}
#: Bytes in which the header of a page is expected, and in which it has to be: it may have the least and greatest value.
_HEADER_BYTES, _MOST_HEADER_BYTES = 256, 65_536


class ParquetRefused(ValueError):
    """A file that is no Parquet, is damaged, or asks for more than it holds; the text completes "it ..."."""


@dataclass(frozen=True)
class _Leaf:
    """A column as it is stored: that of a table, or a part of one (`bytes` of a picture). kind: its physical type."""

    column: str
    kind: int
    width: int


class _Chunk(NamedTuple):
    """The values of one leaf in one group of rows. start: of its first page in the file."""

    values: int
    unpacked: int
    packed: int
    start: int


class ParquetFile:
    """What a file says of itself. groups: numbers of rows of its groups. columns: their names, in order."""

    def __init__(self, path: Path) -> None:
        self.path = path
        handle, self.size = open_regular(path)
        with closing(os.fdopen(handle, "rb")) as file:
            footer = _footer_of(file, self.size)
        try:
            leaves, self._chunks, self.groups = _read_footer(footer)
        except (DamagedThrift, IndexError) as error:
            raise ParquetRefused(f"is damaged: its footer cannot be read ({_reason(error)})") from None
        self._leaves = leaves
        self.columns = tuple(dict.fromkeys(leaf.column for leaf in leaves))
        self.rows = sum(self.groups)

    def is_numeric(self, column: str) -> bool:
        """Whether a column holds numbers or truth values, or lists of them."""
        return all(leaf.kind != _BYTES for leaf in self._leaves if leaf.column == column)

    def is_text(self, column: str) -> bool:
        """Whether a column holds texts or bytes."""
        return [leaf.kind for leaf in self._leaves if leaf.column == column] == [_BYTES]

    def bytes_per_row(self, columns: Collection[str], first: int, count: int) -> float:
        """The bytes of a row in the groups of rows `first` to `first + count`, on average."""
        groups = self._groups_of(first, count)
        return sum(chunk.unpacked for _, chunk in self._chosen(columns, groups)) / max(
            1, sum(self.groups[group] for group in groups)
        )

    def rows_and_values(self, column: str, first: int, count: int) -> tuple[int, int]:
        """The rows of the groups that hold rows `first` to `first + count`, and the values of a column in them."""
        groups = self._groups_of(first, count)
        values = sum(chunk.values for _, chunk in self._chosen([column], groups))
        return sum(self.groups[group] for group in groups), values

    def check(self, columns: Collection[str], first: int = 0, count: int | None = None) -> None:
        """Check the pages of some columns in the groups of rows `first` to `first + count`; all without a count.

        Raises:
            ParquetRefused: they ask for more memory than `limits.py` allows for what is stored, or are damaged.
            OSError: the file cannot be read.
        """
        groups = self._groups_of(first, self.rows if count is None else count)
        claimed, stored, pages = dict.fromkeys(columns, 0), 0, 0
        handle, _ = open_regular(self.path)
        try:
            for leaf, chunk in self._chosen(columns, groups):
                try:
                    num_pages, unpacked = _check_pages(handle, self.size, leaf, chunk)
                except (DamagedThrift, IndexError) as error:
                    raise ParquetRefused(f"is damaged in its column '{leaf.column}' ({_reason(error)})") from None
                claimed[leaf.column] += unpacked + chunk.values * leaf.width
                stored += chunk.packed
                pages += num_pages
                if pages > TABLE_PAGES:
                    raise ParquetRefused(f"has more than {TABLE_PAGES:,} pages")
        finally:
            os.close(handle)
        total, most = sum(claimed.values()), CLAIMED_BYTES + TABLE_EXPANSION * stored
        if total > most:
            column = max(claimed, key=lambda name: claimed[name])
            raise ParquetRefused(
                f"would take {total:,} bytes of memory, most of them for its column '{column}', from {stored:,} stored "
                f"ones; expected at most {most:,}"
            )

    def _groups_of(self, first: int, count: int) -> range:
        """The groups that hold these rows."""
        begins, groups = 0, []
        for number, rows in enumerate(self.groups):
            if begins < first + count and begins + rows > first:
                groups.append(number)
            begins += rows
        return range(groups[0], groups[-1] + 1) if groups else range(0)

    def _chosen(self, columns: Collection[str], groups: range) -> Iterator[tuple[_Leaf, _Chunk]]:
        for position, leaf in enumerate(self._leaves):
            if leaf.column in columns:
                for group in groups:
                    yield leaf, self._chunks[group][position]


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, DamagedThrift) else "it ends early"


def _footer_of(file: Any, size: int) -> bytes:
    if size < len(_MAGIC) + _END:
        raise ParquetRefused(f"is no Parquet file: it has {size:,} bytes")
    file.seek(size - _END)
    end = file.read(_END)
    length = int.from_bytes(end[:4], "little")
    if end[4:] != _MAGIC or length > size - len(_MAGIC) - _END:
        raise ParquetRefused("is no Parquet file, or only its beginning")
    if length > TABLE_FOOTER_BYTES:
        raise ParquetRefused(f"has a footer of {length:,} bytes; expected at most {TABLE_FOOTER_BYTES:,}")
    file.seek(size - _END - length)
    footer: bytes = file.read(length)
    return footer


def _read_footer(data: bytes) -> tuple[list[_Leaf], list[list[_Chunk]], list[int]]:
    """The leaves, for each group of rows its chunks in the order of the leaves, and the rows of each group."""
    leaves: list[_Leaf] | None = None
    groups: list[dict[int, Any]] | None = None
    chunks: list[list[_Chunk]] = []
    rows: list[int] = []
    total = -1
    at = field = 0
    while True:
        field, kind, at = _head(data, at, field)
        if not kind:
            break
        if field == 2 and kind == LIST:
            leaves, at = _read_schema(data, at)
        elif field == 3 and kind in INTEGERS:
            total, at = _signed(data, at)
        elif field == 4 and kind == LIST and leaves is not None:
            count, of, at = list_head(data, at)
            if of != STRUCT:
                raise DamagedThrift("its groups of rows are none")
            for _ in range(count):
                stated, group, at = _read_group(data, at, leaves)
                rows.append(stated)
                chunks.append(group)
            groups = []
        else:
            at = skip_value(data, at, kind)
    if leaves is None or groups is None:
        raise DamagedThrift("it has no columns or no groups of rows")
    if total != sum(rows):
        raise DamagedThrift(f"it says {total} rows, and {sum(rows)} in its groups")
    return leaves, chunks, rows


def _head(data: bytes, at: int, field: int) -> tuple[int, int, int]:
    """The next field of a struct: its number, its kind (0 at the end), and where its value begins."""
    head = data[at]
    if not head:
        return field, 0, at + 1
    if head > 15:
        return field + (head >> 4), head & 15, at + 1
    number, at = _signed(data, at + 1)
    return number, head & 15, at


def _signed(data: bytes, at: int) -> tuple[int, int]:
    number, at = varint(data, at)
    return (number >> 1) ^ -(number & 1), at


def _read_schema(data: bytes, at: int) -> tuple[list[_Leaf], int]:
    """The leaves of the tree of columns, which is stored from its root on, each part before its own parts."""
    count, kind, at = list_head(data, at)
    if kind != STRUCT or not 1 <= count <= TABLE_COLUMNS:
        raise DamagedThrift(f"it has {count} columns and parts of columns; expected 1 to {TABLE_COLUMNS:,}")
    elements = []
    for _ in range(count):
        fields, at = read_fields(data, at, {1: NUMBER, 2: NUMBER, 4: BINARY, 5: NUMBER})
        elements.append(fields)
    leaves: list[_Leaf] = []
    open_parts: list[int] = []  # how many parts are still to come, at each level
    column = ""
    for number, element in enumerate(elements):
        if number and not open_parts:
            raise DamagedThrift("a part of a column belongs to none")
        if len(open_parts) == 1:
            column = element.get(4, b"").decode("utf-8", errors="replace")
        if open_parts:
            open_parts[-1] -= 1
        parts = element.get(5, 0)
        if parts or not number:
            if parts < 0 or len(open_parts) >= TABLE_NESTING:
                raise DamagedThrift(f"its columns are nested more than {TABLE_NESTING} deep")
            open_parts.append(parts)
        else:
            kind = element.get(1, -1)
            width = element.get(2, 0) if kind == _FIXED else _WIDTHS.get(kind, 0)
            if width < 1:
                raise DamagedThrift(f"the column '{column}' has values of type {kind} and {width} bytes")
            leaves.append(_Leaf(column, kind, width))
        while open_parts and not open_parts[-1]:
            open_parts.pop()
    if open_parts:
        raise DamagedThrift("a column lacks its parts")
    return leaves, at


def _read_group(data: bytes, at: int, leaves: list[_Leaf]) -> tuple[int, list[_Chunk], int]:
    """The rows of a group, and its chunks."""
    chunks: list[_Chunk] = []
    rows = -1
    field = 0
    while True:
        field, kind, at = _head(data, at, field)
        if not kind:
            break
        if field == 1 and kind == LIST:
            count, of, at = list_head(data, at)
            if of != STRUCT or count != len(leaves):
                raise DamagedThrift(f"a group of rows has {count} columns, and the table {len(leaves)}")
            for leaf in leaves:
                chunk, at = _read_chunk(data, at, leaf)
                chunks.append(chunk)
        elif field == 3 and kind in INTEGERS:
            rows, at = _signed(data, at)
        else:
            at = skip_value(data, at, kind)
    if rows < 0 or len(chunks) != len(leaves):
        raise DamagedThrift("a group of rows lacks its rows or columns")
    return rows, chunks, at


#: Of a chunk: its type, its codec, values, bytes, packed bytes, and the first pages of values and of a dictionary.
_CHUNK_FIELDS = dict.fromkeys((1, 4, 5, 6, 7, 9, 11), NUMBER)


def _read_chunk(data: bytes, at: int, leaf: _Leaf) -> tuple[_Chunk, int]:
    fields: dict[int, Any] = {}
    field = 0
    while True:
        field, kind, at = _head(data, at, field)
        if not kind:
            break
        if field == 1:
            raise DamagedThrift(f"the column '{leaf.column}' is in another file")
        if field == 3 and kind == STRUCT:
            fields, at = read_fields(data, at, _CHUNK_FIELDS)
        else:
            at = skip_value(data, at, kind)
    try:
        values, unpacked, packed, first = fields[5], fields[6], fields[7], fields[9]
    except KeyError:
        raise DamagedThrift(f"the column '{leaf.column}' lacks its sizes") from None
    dictionary = fields.get(11) or first  # some writers say 0 for none
    if fields.get(1) != leaf.kind or min(values, unpacked, packed, dictionary) < 0 or dictionary > first:
        raise DamagedThrift(f"the column '{leaf.column}' contradicts itself")
    return _Chunk(values, unpacked, packed, dictionary), at


def _check_pages(handle: int, size: int, leaf: _Leaf, chunk: _Chunk) -> tuple[int, int]:
    """Check the headers of all pages of a chunk; returns their number and the bytes of their content."""
    at, end = chunk.start, chunk.start + chunk.packed
    if end > size:
        raise DamagedThrift("it is said to go on behind the end of the file")
    values = unpacked = pages = 0
    while at < end:
        header, begins = _page_header(handle, at, end)
        kind, content, packed = header.get(1), header.get(2, -1), header.get(3, -1)
        what = header.get(_VALUES_FIELD.get(kind, 0))
        if what is None or min(content, packed) < 0 or begins + packed > end:
            raise DamagedThrift(f"the page at byte {at} is none, or goes on behind its column")
        if what.get(4 if kind == _DATA_PAGE_2 else 2) not in _ENCODINGS or (kind == _DICTIONARY_PAGE and pages):
            raise DamagedThrift(f"the page at byte {at} has an encoding that is not read")
        if kind == _DICTIONARY_PAGE:
            if not 0 <= what.get(1, -1) * _LEAST_BYTES.get(leaf.kind, leaf.width) <= content:
                raise DamagedThrift(f"the dictionary at byte {at} has fewer bytes than values")
        else:
            if what.get(1, -1) < 0 or what.get(5, 0) < 0 or what.get(6, 0) < 0:
                raise DamagedThrift(f"the page at byte {at} has fewer than no values")
            if kind == _DATA_PAGE_2 and what.get(5, 0) + what.get(6, 0) > min(content, packed):
                raise DamagedThrift(f"the page at byte {at} is shorter than its levels")
            values += what[1]
        unpacked += content
        pages += 1
        if values > chunk.values:
            raise DamagedThrift(f"its pages have more than the {chunk.values:,} values of the footer")
        at = begins + packed
    if values != chunk.values:
        raise DamagedThrift(f"its pages have {values:,} values, and the footer says {chunk.values:,}")
    return pages, unpacked


#: Of the header of a page: its type, bytes, packed bytes; and what its values are, by type.
_PAGE_FIELDS: Wanted = {
    **dict.fromkeys((1, 2, 3), NUMBER),
    5: dict.fromkeys((1, 2), NUMBER),
    7: dict.fromkeys((1, 2), NUMBER),
    8: dict.fromkeys((1, 4, 5, 6), NUMBER),
}


def _page_header(handle: int, at: int, end: int) -> tuple[dict[int, Any], int]:
    """The header of the page at a place, and where its content begins."""
    length = min(_HEADER_BYTES, end - at)
    try:
        fields, used = read_fields(os.pread(handle, length, at), 0, _PAGE_FIELDS)
    except IndexError:
        fields, used = read_fields(os.pread(handle, min(_MOST_HEADER_BYTES, end - at), at), 0, _PAGE_FIELDS)
    return fields, at + used
