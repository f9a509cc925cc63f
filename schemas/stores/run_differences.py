"""In which fields the configurations of two runs differ."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.stores.digest import run_configuration
from vla_attention.schemas.stores.store_format import RootAttributes

#: Path of a field, and its values in the one and in the other run; None where a run has no such field.
Difference = tuple[str, object, object]


def run_differences(one: RootAttributes, other: RootAttributes) -> Iterator[Difference]:
    """The fields in which two runs' configurations differ, in the order of the root's attributes."""
    yield from _differences(run_configuration(to_json(one)), run_configuration(to_json(other)), "")


def _differences(one: Any, other: Any, where: str) -> Iterator[Difference]:
    if isinstance(one, dict) and isinstance(other, dict):
        for key in [*one, *(key for key in other if key not in one)]:
            yield from _differences(one.get(key), other.get(key), f"{where}.{key}".lstrip("."))
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other) and where.startswith("sites"):
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from _differences(a, b, f"{where}[{i}]")
    elif one != other:
        yield where, one, other
