"""The files of an episode in one zip file without compression, read in place.

A store packed by `vla-attention store copy --packed` has a zip an episode. The small files and all metadata are at the
zip's end, just before its directory, so that one request for the tail opens an episode that is elsewhere. A zip's
directory is not believed more than any other bytes: it says where a file begins, and what is found there has to be what
the episode's seal lists.
"""

from __future__ import annotations

import hashlib
import io
import stat
import struct
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from vla_attention.schemas.limits import EPISODE_FILES, WHOLE_FILE_BYTES
from vla_attention.schemas.stores.byte_source import ByteSource, Memory, copy_into, split

#: Bytes of a local header before the file's name.
LOCAL_HEADER_BYTES = 30
_ENCRYPTED, _DESCRIPTOR = 0x1, 0x8
#: Bytes between files that are read at once; zips of ours have some hundred.
_BYTES_AT_ONCE = 16_000_000
#: What every entry of a zip's directory begins with.
_ENTRY = b"PK\x01\x02"


class DamagedZip(OSError):
    """A zip file that this program did not write, or that was changed since."""


@dataclass(frozen=True)
class ZipMembers:
    """The files in a zip file.

    Attributes:
        source: where the zip is.
        file: its path there.
        length: how many bytes it has.
        tail: the offset from which on it is read at once: small files, metadata and the directory.
        frame: what `frame_digest` gives of an undamaged zip; empty if it is not known.
    """

    source: ByteSource
    file: str
    length: int
    tail: int
    frame: str = ""

    @property
    def remembers(self) -> bool:
        """See `ByteSource`."""
        return self.source.remembers

    def whole(self, file: str, *, most: int = WHOLE_FILE_BYTES, fresh: bool = False) -> bytes:
        """See `ByteSource`."""
        size = self.size(file)
        if size > most:
            raise DamagedZip(f"its {file} has {size:,} bytes; expected at most {most:,}")
        return self.parts(file, 0, (size,), fresh=fresh)[0]

    def parts(self, file: str, offset: int, lengths: Sequence[int], *, fresh: bool = False) -> list[bytes]:
        """See `ByteSource`."""
        first, size = self._member(file, fresh=fresh)
        ends, at = [], offset
        for length in lengths:
            at = min(at + length, max(size, offset))
            ends.append(at)
        lengths = [end - start for start, end in pairwise([offset, *ends])]
        tail = self._opened()[1]
        if first + offset >= self.tail:
            start = first + offset - self.tail
            return split(tail[start : start + sum(lengths)], lengths)
        return self.source.parts(self.file, first + offset, lengths, fresh=fresh)

    def read_into(self, memory: Memory, file: str, offset: int, *, fresh: bool = False) -> int:
        """See `ByteSource`."""
        first, size = self._member(file, fresh=fresh)
        if first + offset >= self.tail:
            return copy_into(memory, self.parts(file, offset, (len(memory),), fresh=fresh)[0])
        room = memory[: max(0, size - offset)]
        return self.source.read_into(room, self.file, first + offset, fresh=fresh)

    def size(self, file: str) -> int:
        """See `ByteSource`."""
        return self._member(file)[1]

    def bound_to(self, digest: str) -> ZipMembers:
        """See `ByteSource`; the index of the store has bound the zip already."""
        return self

    def names(self) -> list[str]:
        """The files in the zip."""
        return list(self._opened()[0])

    def frame_digest(self) -> str:
        """sha256 of all bytes of the zip that are in none of its files: the headers before them, and the directory."""
        members, tail = self._opened()
        digest, at = hashlib.sha256(), 0
        for first, size in [*sorted(members.values()), (self.length, 0)]:
            for start in range(at, min(first, self.tail), _BYTES_AT_ONCE):
                length = min(_BYTES_AT_ONCE, min(first, self.tail) - start)
                digest.update(self.source.parts(self.file, start, (length,))[0])
            if first > self.tail:
                digest.update(tail[max(at, self.tail) - self.tail : first - self.tail])
            at = first + size
        return digest.hexdigest()

    def _member(self, file: str, *, fresh: bool = False) -> tuple[int, int]:
        try:
            return self._opened(fresh=fresh)[0][file]
        except KeyError:
            raise FileNotFoundError(2, "No such file in its zip", file) from None

    def _opened(self, *, fresh: bool = False) -> tuple[dict[str, tuple[int, int]], bytes]:
        """Offset and size of the content of each file, and the bytes of the tail."""
        kept: dict[str, Any] = self.__dict__
        if "_kept" not in kept or fresh:
            kept["_kept"] = self._open(fresh)
        return kept["_kept"]  # type: ignore[no-any-return]

    def __getstate__(self) -> dict[str, Any]:
        """Without the bytes of the tail: another process reads them itself."""
        return {name: value for name, value in self.__dict__.items() if name != "_kept"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)

    def _open(self, fresh: bool) -> tuple[dict[str, tuple[int, int]], bytes]:
        try:
            return self._directory(fresh)
        except DamagedZip:
            if fresh or not self.remembers:
                raise
            return self._directory(True)

    def _directory(self, fresh: bool) -> tuple[dict[str, tuple[int, int]], bytes]:
        wanted = self.length - self.tail
        if not 0 < wanted <= self.length:
            raise DamagedZip(f"the index says that its zip has {self.length} bytes, the last ones from {self.tail} on")
        # One byte more: a file that has grown is not the one in the index.
        tail, more = self.source.parts(self.file, self.tail, (wanted, 0 if self.remembers else 1), fresh=fresh)
        if len(tail) != wanted or more:
            raise DamagedZip(f"its zip {self.file} has not the {self.length} bytes that the index says")
        if tail.count(_ENTRY) > EPISODE_FILES:  # before an object is made of each
            raise DamagedZip(f"its zip {self.file} has more than {EPISODE_FILES:,} files")
        try:
            with zipfile.ZipFile(_Tail(tail, self.tail)) as opened:
                members, end = opened.infolist(), opened.start_dir
        except (zipfile.BadZipFile, struct.error, ValueError, NotImplementedError, OverflowError, EOFError) as error:
            raise DamagedZip(f"its zip {self.file} cannot be read: {error}") from None
        return dict(self._places(members, end)), tail

    def _places(self, members: Sequence[zipfile.ZipInfo], end: int) -> Iterator[tuple[str, tuple[int, int]]]:
        """Where the content of each file is: it ends where the next file's header, or the directory, begins."""
        ordered = sorted(members, key=lambda member: member.header_offset)
        names = {member.filename for member in ordered}
        if len(names) != len(ordered):
            raise DamagedZip(f"its zip {self.file} names a file twice")
        for member, until in zip(ordered, [*(later.header_offset for later in ordered[1:]), end], strict=True):
            first = until - member.file_size
            header = member.header_offset + LOCAL_HEADER_BYTES + len(member.orig_filename.encode())
            stored = member.compress_type == zipfile.ZIP_STORED and member.file_size == member.compress_size
            plain = stored and not stat.S_ISLNK(member.external_attr >> 16)  # what unpacks it would make a link
            if not plain or member.flag_bits & (_ENCRYPTED | _DESCRIPTOR) or first < header or until > self.length:
                raise DamagedZip(
                    f"its zip {self.file} holds {member.filename!r} in another way than vla-attention store copy "
                    "--packed writes it; pack the store again"
                )
            yield member.filename, (first, member.file_size)


class _Tail(io.RawIOBase):
    """The end of a file, for `zipfile`: positions are those of the whole file."""

    def __init__(self, content: bytes, offset: int) -> None:
        super().__init__()
        self._content, self._offset, self._at = content, offset, 0

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = 0) -> int:
        size = self._offset + len(self._content)
        self._at = max(0, {0: 0, 1: self._at, 2: size}[whence] + offset)
        return self._at

    def read(self, size: int = -1) -> bytes:
        start = self._at - self._offset
        if start < 0:
            raise EOFError("its directory is not where the index says")
        content = self._content[start:] if size < 0 else self._content[start : start + size]
        self._at += len(content)
        return content
