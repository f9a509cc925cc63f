"""MP4 files, whose lists of samples are checked before a library builds an entry in memory for each.

Twenty bytes can say that a video has a billion samples of one size, and all samples may lie on the same bytes. Boxes
are those of ISO/IEC 14496-12; only their headers and the lists of samples are read here, no pictures.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vla_attention.schemas.limits import VIDEO_BOXES, VIDEO_FRAMES
from vla_attention.schemas.regular_files import open_regular

#: Boxes that hold boxes, as FFmpeg reads them.
_HOLD_BOXES = {
    b"moov",
    b"trak",
    b"mdia",
    b"minf",
    b"stbl",
    b"edts",
    b"dinf",
    b"udta",
    b"mvex",
    b"moof",
    b"traf",
    b"tref",
}
_HOLD_BOXES |= {b"sinf", b"schi"}
#: Lists: where the number of their entries stands in the box, and the bytes of an entry.
_LISTS = {
    b"stts": (4, 8),
    b"ctts": (4, 8),
    b"stss": (4, 4),
    b"stps": (4, 4),
    b"stsc": (4, 12),
    b"stco": (4, 4),
    b"co64": (4, 8),
    b"elst": (4, 12),
}
#: A box that is compressed, which nobody has written for decades, and lists of still pictures.
_REFUSED = {b"cmov", b"iinf", b"iprp"}
#: What may stand first in a file; anything else is a file of another kind.
_FIRST = {b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"styp", b"moof"}
_DEEPEST = 10


class Mp4Refused(ValueError):
    """A file that is no MP4, is damaged, or asks for more than it holds; the text completes "it ..."."""


def check_mp4(path: Path, most_samples: int = VIDEO_FRAMES) -> int:
    """Check the lists of samples of a file; returns its bytes.

    most_samples: pictures, and pieces of sound, that it may have.

    Raises:
        Mp4Refused: it has more, or their sizes are more than its own.
        OSError: it cannot be read, or is no regular file.
    """
    handle, size = open_regular(path)
    try:
        samples = 0
        for kind, begins, ends in _boxes(handle, size):
            if kind in _REFUSED:
                raise Mp4Refused(f"has a box '{kind.decode()}', which no video of a data set has")
            if kind in _LISTS:
                where, entry = _LISTS[kind]
                _check_list(handle, kind, begins, ends, where, entry)
            elif kind in (b"stsz", b"stz2", b"trun"):
                samples += _samples_of(handle, kind, begins, ends, size, most_samples - samples)
        return size
    finally:
        os.close(handle)


def _boxes(handle: int, size: int) -> Iterator[tuple[bytes, int, int]]:
    """Every box, also those in others: its kind, and where its content begins and ends."""
    waiting, seen = [(0, size, 0)], 0
    while waiting:
        at, end, depth = waiting.pop()
        while at + 8 <= end:
            head = os.pread(handle, 16, at)
            length, kind, begins = int.from_bytes(head[:4], "big"), head[4:8], at + 8
            if not at and kind not in _FIRST:
                raise Mp4Refused("is no MP4")
            if length == 1:
                length, begins = int.from_bytes(head[8:16], "big"), at + 16
            ends = end if not length else at + length
            if ends > end and kind == b"mdat":
                raise Mp4Refused(
                    f"is only the beginning of a file: it has {size:,} bytes, and a box that ends at {ends:,}"
                )
            if ends > end or ends < begins:
                raise Mp4Refused(f"is damaged: a box at byte {at:,} of {size:,} has {length:,} bytes")
            seen += 1
            if seen > VIDEO_BOXES or depth > _DEEPEST:
                raise Mp4Refused(f"has more than {VIDEO_BOXES:,} boxes, or more than {_DEEPEST} in one another")
            yield kind, begins, ends
            if kind in _HOLD_BOXES:
                # Of this one, there are two forms, with and without a version before its boxes.
                has_version = kind == b"meta" and os.pread(handle, 4, begins + 4) != b"hdlr"
                waiting.append((begins + 4 * has_version, ends, depth + 1))
            at = ends


def _check_list(handle: int, kind: bytes, begins: int, ends: int, where: int, entry: int) -> None:
    count = int.from_bytes(os.pread(handle, 4, begins + where), "big")
    if count * entry > ends - begins - where - 4:
        raise Mp4Refused(f"is damaged: its list '{kind.decode()}' of {count:,} entries has {ends - begins:,} bytes")


def _samples_of(handle: int, kind: bytes, begins: int, ends: int, size: int, most: int) -> int:
    """The number of samples of a list of their sizes; raises `Mp4Refused` where they cannot be in the file."""
    head = os.pread(handle, 12, begins)
    if len(head) < 12 or ends - begins < (8 if kind == b"trun" else 12):
        raise Mp4Refused(f"is damaged: its list '{kind.decode()}' has {ends - begins} bytes")
    version_and_flags, given, count = struct.unpack(">III", head)
    bits = 0  # of each sample in the list; none where all have one size
    if kind == b"trun":
        count, given = given, 0
        bits = 32 * sum(bool(version_and_flags & bit) for bit in (0x100, 0x200, 0x400, 0x800))
        head_bytes = 8 + 4 * sum(bool(version_and_flags & bit) for bit in (0x1, 0x4))
    else:
        head_bytes = 12
        if kind == b"stz2" or not given:
            bits, given = given & 255 or 32, 0
    if count > most:
        raise Mp4Refused(
            f"says that it has {count:,} pictures; expected at most {most:,}, for the frames of its data set"
        )
    if count * bits > 8 * (ends - begins - head_bytes):
        raise Mp4Refused(f"is damaged: its list '{kind.decode()}' of {count:,} samples has {ends - begins:,} bytes")
    total = given * count
    if kind == b"stsz" and not given:
        total = int(np.frombuffer(os.pread(handle, 4 * count, begins + head_bytes), ">u4").sum(dtype=np.int64))
    if total > size:
        raise Mp4Refused(f"is damaged: it has {size:,} bytes, and pictures of {total:,} bytes")
    return int(count)
