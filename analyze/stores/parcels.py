"""An episode's work as bytes: what another process needs to do it, and what it gives back.

A function with the item that it is called with travels as a pickle in which stores and episodes are made anew from
their places: neither open files nor what was read already travels, nor the other episodes of a store. What comes back
refers to them, and to the item and its parts, by their numbers, and they are the sender's own objects again.
"""

from __future__ import annotations

import io
import pickle
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

from numcodecs.zstd import Zstd

from vla_attention.analyze.stores.blas import one_blas_thread
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import StoreError

#: Made anew at the other end, from the values of their fields.
_MADE_ANEW = (StoredEpisode, Store)
#: The weights of groups are mostly zeros and ones.
_CODEC = Zstd(level=1)


class VersionsDiffer(UserError, RuntimeError):
    """A worker has another version of this package than the process that asks."""


@dataclass(frozen=True)
class Parcel:
    """A function and its item as bytes.

    Attributes:
        content: what `work` takes in any process.
        sent: the stores and episodes in it, the item, and its parts where it is a tuple, by their numbers.
        name: of its episode, for messages.
    """

    content: bytes
    sent: tuple[object, ...]
    name: str

    @classmethod
    def of(cls, function: Callable[[Any], Any], item: object) -> Parcel:
        """Pack a function and what it is called with."""
        sent: list[object] = []
        content = _CODEC.encode(_packed((function, item), sent, item if isinstance(item, tuple) else (item,)))
        name = next((one.name for one in sent if isinstance(one, StoredEpisode)), str(item))
        return cls(bytes(content), tuple(sent), name)

    def result(self, answer: bytes) -> Any:
        """What `work` gave: the function's result, or the `UserError` that it raised, which is raised here."""
        value = _unpacked(_CODEC.decode(answer), list(self.sent))
        if isinstance(value, UserError):
            raise value
        return value


def work(content: bytes, sender: str) -> bytes:
    """Call the function of a parcel in this process; matrix products take one thread, as everywhere.

    sender: the version of this package there.

    Raises:
        VersionsDiffer: this process has another one.
        Exception: what the function raises and is no `UserError`: a defect.
    """
    if sender != package_version():
        raise VersionsDiffer(
            f"The worker has vla-attention {package_version()} and this process {sender}: install the same on both."
        )
    got: list[object] = []
    try:
        function, item = _unpacked(_CODEC.decode(content), got)
        for store in got:
            if isinstance(store, Store):
                _check_visible(store.path)
        with one_blas_thread():
            answer = function(item)
    except UserError as error:
        answer = error
    return bytes(_CODEC.encode(_packed(answer, got)))


@cache
def package_version() -> str:
    """The version of the installed package."""
    return version("vla-attention")


@cache
def _check_visible(path: Path) -> None:
    if isinstance(path, Path) and not path.exists():
        raise StoreError(
            f"The worker on {platform.node()} does not see {path}; stores must be in a folder that all workers have "
            "under the same name."
        )


def _packed(value: object, known: list[object], numbered: Sequence[object] = ()) -> bytes:
    file = io.BytesIO()
    _Packer(file, known, numbered).dump(value)
    return file.getvalue()


def _unpacked(content: bytes, known: list[object]) -> Any:
    return _Unpacker(io.BytesIO(content), known).load()


class _Packer(pickle.Pickler):
    """`known`: objects that the other end has, by their numbers; grows by those that are packed.

    `numbered`: dataclasses that get a number beside stores and episodes.
    """

    def __init__(self, file: io.BytesIO, known: list[object], numbered: Sequence[object]) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self._known = known
        self._numbered = {id(one) for one in numbered if is_dataclass(one)}
        self._numbers = {id(one): number for number, one in enumerate(known)}

    def persistent_id(self, value: object) -> object:
        number = self._numbers.get(id(value))
        if number is not None:
            return number
        if not isinstance(value, _MADE_ANEW) and id(value) not in self._numbered:
            return None
        self._numbers[id(value)] = number = len(self._known)
        self._known.append(value)
        # The other episodes of a store are not needed, and there may be thousands of them.
        shown = replace(value, episodes=()) if isinstance(value, Store) else value
        values = [_from_anywhere(getattr(shown, one.name)) for one in fields(cast(Any, shown)) if one.init]
        return number, type(value), values

    def reducer_override(self, value: object) -> Any:
        # Without its cause, which may be anything, and not in the way that dask registers for all exceptions: that one
        # cannot make errors anew which are two builtins at once.
        return value.__reduce__() if isinstance(value, UserError) else NotImplemented


class _Unpacker(pickle.Unpickler):
    """`known`: as of the packer."""

    def __init__(self, file: io.BytesIO, known: list[object]) -> None:
        super().__init__(file)
        self._known = known

    def persistent_load(self, given: Any) -> object:
        if isinstance(given, int):
            return self._known[given]
        number, kind, values = given
        self._known += [None] * (number + 1 - len(self._known))
        self._known[number] = kind(*values)
        return self._known[number]


def _from_anywhere(value: object) -> object:
    """A path as it is from any folder: workers may run in another one."""
    return value.absolute() if isinstance(value, Path) else value


def names_of(parcels: Sequence[Parcel]) -> list[str]:
    """The episodes of parcels, each once."""
    return list(dict.fromkeys(parcel.name for parcel in parcels))
