"""What is known of some tensors, as long as they live."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Generic, TypeVar

from torch import Tensor

_Known = TypeVar("_Known")


def tensors_among(values: Iterable[Any]) -> Iterator[Tensor]:
    """Yield the tensors among values, those in lists and tuples too."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from tensors_among(value)


class TensorTable(Generic[_Known]):
    """What is known of some tensors, as long as they live; it does not keep them alive.

    entries: by the tensors' ids. Whether it is empty costs less to ask than whether the table is.
    """

    def __init__(self) -> None:
        self.entries: dict[int, tuple[weakref.ref[Tensor], _Known]] = {}

    def get(self, tensor: object) -> _Known | None:
        """Return what is known of a tensor."""
        entry = self.entries.get(id(tensor))
        return None if entry is None or entry[0]() is not tensor else entry[1]

    def put(self, tensor: Tensor, known: _Known) -> None:
        """Note what is known of a tensor."""
        number, entries = id(tensor), self.entries

        def forget(gone: weakref.ref[Tensor]) -> None:
            entry = entries.get(number)
            if entry is not None and entry[0] is gone:
                del entries[number]

        entries[number] = weakref.ref(tensor, forget), known

    def tensors(self, wanted: Callable[[_Known], bool]) -> list[Tensor]:
        """Return the living tensors of which something wanted is known."""
        chosen = (reference() for reference, known in list(self.entries.values()) if wanted(known))
        return [tensor for tensor in chosen if tensor is not None]

    def keep(self, wanted: Callable[[_Known], bool]) -> None:
        """Forget the tensors of which something else is known."""
        for number, (_, known) in list(self.entries.items()):
            if not wanted(known):
                self.entries.pop(number, None)
