"""Sequences whose members are not kept in memory: what is measured of thousands of episodes would not fit."""

from __future__ import annotations

import os
import pickle
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Generic, TypeVar, overload

from vla_attention.schemas.errors import BadArgument

Member = TypeVar("Member")


class MadeWhenAsked(Sequence[Member], Generic[Member]):
    """A sequence whose members are made at every access."""

    def __init__(self, make: Callable[[int], Member], positions: Sequence[int]) -> None:
        """Member i is what `make` returns for position i of `positions`."""
        self._make = make
        self._positions = positions

    def __len__(self) -> int:
        """Number of members."""
        return len(self._positions)

    @overload
    def __getitem__(self, index: int) -> Member: ...

    @overload
    def __getitem__(self, index: slice) -> MadeWhenAsked[Member]: ...

    def __getitem__(self, index: int | slice) -> Member | MadeWhenAsked[Member]:
        """One member, made now, or a part of the sequence."""
        if isinstance(index, slice):
            return MadeWhenAsked(self._make, self._positions[index])
        return self._make(self._positions[index])

    def __iter__(self) -> Iterator[Member]:
        """The members, one after the other."""
        return map(self._make, self._positions)


class OnDisk(Sequence[Member], Generic[Member]):
    """A sequence whose members are written to a temporary file when they are appended, and read at every access.

    The file has no name, and its space is free again when this object is gone. It lies where temporary files do
    (`TMPDIR`).
    """

    def __init__(self, members: Iterable[Member] = ()) -> None:
        """Append the members, each as soon as it is there."""
        self._ends = [0]
        try:
            self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        except OSError as error:
            raise _no_room(error) from None
        weakref.finalize(self, self._file.close)
        for member in members:
            self.append(member)

    def append(self, member: Member) -> None:
        """Write one more member.

        Raises:
            BadArgument: there is no room for it.
        """
        content = pickle.dumps(member, protocol=pickle.HIGHEST_PROTOCOL)
        rest = memoryview(content)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise _no_room(error) from None
        self._ends.append(self._ends[-1] + len(content))

    def __len__(self) -> int:
        """Number of members."""
        return len(self._ends) - 1

    @overload
    def __getitem__(self, index: int) -> Member: ...

    @overload
    def __getitem__(self, index: slice) -> MadeWhenAsked[Member]: ...

    def __getitem__(self, index: int | slice) -> Member | MadeWhenAsked[Member]:
        """One member, read now, or a part of the sequence."""
        positions = range(len(self))[index]
        return self._read(positions) if isinstance(positions, int) else MadeWhenAsked(self._read, positions)

    def __iter__(self) -> Iterator[Member]:
        """The members, one after the other."""
        return map(self._read, range(len(self)))

    def _read(self, position: int) -> Member:
        start, end = self._ends[position], self._ends[position + 1]
        # With its place, and not from where the last reading ended: several threads may read.
        member: Member = pickle.loads(os.pread(self._file.fileno(), end - start, start))  # noqa: S301 - this process wrote it
        return member


def _no_room(error: OSError) -> BadArgument:
    try:
        where = f" in {tempfile.gettempdir()}"
    except OSError:
        where = ""
    return BadArgument(
        f"Cannot keep what was measured in a temporary file{where}: {error.strerror or error}; set TMPDIR to a folder "
        "with room."
    )
