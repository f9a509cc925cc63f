"""Structs in Thrift's compact protocol, in which Parquet writes what it says of itself.

Every function takes the bytes and a place in them, and returns a value with the place behind it; bytes that end early
are an `IndexError`. Nothing is built but the fields that are asked for. Format: `thrift-compact-protocol.md` of
github.com/apache/thrift.
"""

from __future__ import annotations

from typing import Any

#: Kinds of values: whole numbers of 16, 32 and 64 bits, bytes, lists, structs.
INTEGERS, BINARY, LIST, STRUCT = (4, 5, 6), 8, 9, 12
_BOOLEANS, _BYTE, _DOUBLE, _SET = (1, 2), 3, 7, 10
#: Structs and lists in one another: Parquet has at most 6.
_NESTING = 16
#: Bits of the longest number.
_BITS = 64

#: Which fields are kept, by their numbers: a `NUMBER` (a whole one of any size), a `BINARY`, or those of a struct.
Wanted = dict[int, Any]
NUMBER = 0


class DamagedThrift(ValueError):
    """Bytes that are no struct of this format."""


def varint(data: bytes, at: int) -> tuple[int, int]:
    """A number without sign."""
    byte = data[at]
    number, shift = byte & 127, 7
    while byte > 127:
        at += 1
        byte = data[at]
        number |= (byte & 127) << shift
        shift += 7
        if shift > _BITS + 7:
            raise DamagedThrift("a number has more than 64 bits")
    return number, at + 1


def list_head(data: bytes, at: int) -> tuple[int, int, int]:
    """How many values a list has, their kind, and where they begin. A value takes at least one byte."""
    count, kind = data[at] >> 4, data[at] & 15
    at += 1
    if count == 15:
        count, at = varint(data, at)
    if count > len(data) - at:
        raise DamagedThrift(f"a list of {count:,} values ends early")
    return count, kind, at


def skip_value(data: bytes, at: int, kind: int, depth: int = 0) -> int:
    """The place behind a value that is a field of a struct."""
    if kind in _BOOLEANS:
        return at
    if kind in INTEGERS:
        while data[at] > 127:
            at += 1
        return at + 1
    if kind == BINARY:
        length, at = varint(data, at)
        return at + length
    if depth > _NESTING:
        raise DamagedThrift(f"values are nested more than {_NESTING} deep")
    if kind == STRUCT:
        while head := data[at]:
            at += 1
            if head < 16:
                _, at = varint(data, at)
            of = head & 15
            if of in INTEGERS:  # here and in lists: most of all values, without a call
                while data[at] > 127:
                    at += 1
                at += 1
            elif of not in _BOOLEANS:
                at = skip_value(data, at, of, depth + 1)
        return at + 1
    if kind in (LIST, _SET):
        count, of, at = list_head(data, at)
        if of in (*_BOOLEANS, _BYTE):
            return at + count
        for _ in range(count):
            if of in INTEGERS:
                while data[at] > 127:
                    at += 1
                at += 1
            else:
                at = skip_value(data, at, of, depth + 1)
        return at
    if kind in (_BYTE, _DOUBLE):
        return at + (1 if kind == _BYTE else 8)
    raise DamagedThrift(f"a value has the kind {kind}")


def read_fields(data: bytes, at: int, wanted: Wanted) -> tuple[dict[int, Any], int]:
    """The wanted fields of a struct: whole numbers, bytes, and structs as dictionaries. Others are skipped."""
    fields: dict[int, Any] = {}
    number = 0
    while head := data[at]:
        at += 1
        if head > 15:
            number += head >> 4
        else:
            coded, at = varint(data, at)
            number = (coded >> 1) ^ -(coded & 1)
        kind = head & 15
        of = wanted.get(number)
        if kind in INTEGERS:
            coded = data[at]
            if coded > 127:
                coded, at = varint(data, at)
            else:
                at += 1
            if of == NUMBER:
                fields[number] = (coded >> 1) ^ -(coded & 1)
        elif kind == BINARY and of == BINARY:
            length, at = varint(data, at)
            if length > len(data) - at:
                raise IndexError
            fields[number] = data[at : at + length]
            at += length
        elif kind == STRUCT and of.__class__ is dict:
            fields[number], at = read_fields(data, at, of)
        else:
            at = skip_value(data, at, kind)
    return fields, at + 1
