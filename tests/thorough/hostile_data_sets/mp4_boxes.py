"""The boxes of MP4 files, made, found and exchanged."""

from __future__ import annotations

import struct
from collections.abc import Sequence

#: The boxes in which the lists of a video's samples are.
LISTS = ("moov", "trak", "mdia", "minf", "stbl")


def box(kind: str, *numbers: int, content: bytes = b"") -> bytes:
    body = struct.pack(f">{len(numbers)}I", *numbers) + content
    return struct.pack(">I", 8 + len(body)) + kind.encode() + body


def find(content: bytes, path: Sequence[str], begin: int = 0, end: int | None = None) -> tuple[int, int]:
    """Where a box begins and ends."""
    at, end = begin, len(content) if end is None else end
    while at + 8 <= end:
        length = int.from_bytes(content[at : at + 4], "big")
        if content[at + 4 : at + 8] == path[0].encode():
            return (at, at + length) if len(path) == 1 else find(content, path[1:], at + 8, at + length)
        at += length
    raise LookupError(path)


def exchange(content: bytes, path: Sequence[str], new: bytes) -> bytes:
    """Other bytes in the place of a box; those around it grow."""
    begin, end = find(content, path)
    out = bytearray(content[:begin] + new + content[end:])
    for depth in range(1, len(path)):
        at, _ = find(content, path[:depth])
        out[at : at + 4] = struct.pack(">I", int.from_bytes(content[at : at + 4], "big") + len(new) - (end - begin))
    return bytes(out)
