"""`functools.cached_property` as it is from Python 3.12 on: without a lock.

Before, one lock stands for all objects of a class while a value is computed, so that threads which read one episode
each, or wait for a network each, wait for one another.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, TypeVar

Value = TypeVar("Value")

if TYPE_CHECKING or sys.version_info >= (3, 12):
    from functools import cached_property
else:

    class cached_property(Generic[Value]):
        """A property that is computed once for each object; two threads at once may both compute it."""

        def __init__(self, func: Callable[[Any], Value]) -> None:
            self.func = func
            self.__doc__ = func.__doc__

        def __set_name__(self, owner: type, name: str) -> None:
            self._name = name

        def __get__(self, instance: Any, owner: type | None = None) -> Any:
            if instance is None:
                return self
            # The class has no __set__: what is in the object's own dictionary comes first from now on.
            return instance.__dict__.setdefault(self._name, self.func(instance))


__all__ = ["cached_property"]
