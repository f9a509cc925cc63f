"""Sequences whose members are not kept in memory: what is measured of thousands of episodes would not fit."""

from __future__ import annotations

import os
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Generic, TypeVar, overload

from numpy.typing import NDArray

from vla_attention.analyze.cache.array_bytes import arrays_from_bytes, arrays_to_bytes
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


class ArraysOnDisk:
    """Named arrays of one episode after the other in a temporary file: `self[i]` reads those of episode i.

    The file has no name, and its space is free again when this object is gone. It lies where temporary files do
    (`TMPDIR`).
    """

    def __init__(self, episodes: Iterable[Mapping[str, NDArray[Any]]]) -> None:
        """Write the arrays of every episode as soon as they are there.

        Raises:
            BadArgument: there is no room for them.
        """
        self._ends = [0]
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        for arrays in episodes:
            self._append(arrays_to_bytes(arrays))

    def _append(self, content: bytes) -> None:
        rest = memoryview(content)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise BadArgument(
                f"Cannot keep what was measured in a temporary file in {tempfile.gettempdir()}: "
                f"{error.strerror or error}; set TMPDIR to a folder with room."
            ) from None
        self._ends.append(self._ends[-1] + len(content))

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self._ends) - 1

    def __getitem__(self, episode: int) -> dict[str, NDArray[Any]]:
        """The arrays of one episode, read-only."""
        start, end = self._ends[episode], self._ends[episode + 1]
        # With its place, and not from where the last reading ended: several threads may read.
        return arrays_from_bytes(os.pread(self._file.fileno(), end - start, start))
