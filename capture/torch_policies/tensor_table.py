"""A table of tensors by identity, which does not keep them alive."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Generic, TypeVar

from torch import Tensor

_Known = TypeVar("_Known")


class TensorTable(Generic[_Known]):
    """What is known of some tensors, as long as they live."""

    def __init__(self) -> None:
        self._entries: dict[int, tuple[weakref.ref[Tensor], _Known]] = {}

    def __bool__(self) -> bool:
        return bool(self._entries)

    def get(self, tensor: Tensor) -> _Known | None:
        """Return what is known of a tensor."""
        entry = self._entries.get(id(tensor))
        return None if entry is None or entry[0]() is not tensor else entry[1]

    def put(self, tensor: Tensor, known: _Known) -> None:
        """Note what is known of a tensor."""
        number, entries = id(tensor), self._entries

        def forget(gone: weakref.ref[Tensor]) -> None:
            entry = entries.get(number)
            if entry is not None and entry[0] is gone:
                del entries[number]

        entries[number] = weakref.ref(tensor, forget), known

    def drop(self, tensor: Tensor) -> None:
        """Forget a tensor."""
        self._entries.pop(id(tensor), None)

    def keep(self, wanted: Callable[[_Known], bool]) -> None:
        """Forget the tensors of which something else is known."""
        for number in [number for number, (_, known) in self._entries.items() if not wanted(known)]:
            del self._entries[number]
