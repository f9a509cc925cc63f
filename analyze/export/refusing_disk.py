"""A file for HDF5, which ends the whole process where a disk takes no more.

Its library keeps what it could not write and tries again when its objects are freed, long after the error, and then
prints tracebacks or crashes. So it is never told: this file takes everything, and remembers what the disk said first.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

Result = TypeVar("Result")


@contextmanager
def untold_file(path: Path) -> Iterator[UntoldFile]:
    """Yield an `UntoldFile`; at the end of the block the error of the disk is raised, if there was one."""
    file = UntoldFile(path)
    try:
        yield file
    except Exception:
        file.check()  # what the library makes of bytes that are not there
        raise
    finally:
        file.close()
    file.check()


class UntoldFile(io.RawIOBase):
    """A file for reading and writing, emptied first, in which a write that the system refuses is taken and forgotten.

    refused: the first error; what was written since is not in the file, which must be removed.
    """

    def __init__(self, path: Path) -> None:
        self._file = io.FileIO(path, "w+")
        self._position = 0
        self.refused: OSError | None = None

    def check(self) -> None:
        """Raise the error that the system gave, if it gave one."""
        if self.refused is not None:
            raise self.refused

    def readable(self) -> bool:
        """It is."""
        return True

    def writable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read from here on; zeros where nothing could be written."""
        wanted = memoryview(buffer).cast("B")
        self._file.seek(self._position)
        content = self._file.read(len(wanted)) or b""
        wanted[: len(content)] = content
        wanted[len(content) :] = bytes(len(wanted) - len(content))
        self._position += len(wanted)
        return len(wanted)

    def write(self, content: Any) -> int:
        """Write here."""
        rest = memoryview(content).cast("B")
        count, place = len(rest), self._position
        while rest and self.refused is None:
            self._file.seek(place)
            written = self._try(self._file.write, rest) or 0
            place, rest = place + written, rest[written:]
        self._position += count
        return count

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a position."""
        if whence == io.SEEK_END:
            self._position = self._file.seek(offset, whence)
        else:
            self._position = offset + (self._position if whence == io.SEEK_CUR else 0)
        return self._position

    def tell(self) -> int:
        """The position."""
        return self._position

    def truncate(self, size: int | None = None) -> int:
        """Give the file this length."""
        length = self._position if size is None else size
        self._try(self._file.truncate, length)
        return length

    def close(self) -> None:
        """Close it; a second call does nothing."""
        if not self.closed:
            self._try(self._file.close)
        super().close()

    def _try(self, call: Callable[..., Result], *given: Any) -> Result | None:
        try:
            return call(*given)
        except OSError as error:
            self.refused = self.refused or error
            return None
