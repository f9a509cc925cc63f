"""JSON files of limited size, nesting and numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from vla_attention.capture.foreign_files.regular_files import Refuse, check_regular

#: Bytes of a file. The largest of a real checkpoint, statistics and trees of arrays, have 0.2 MB; decoded, empty lists
#: take 25 times as much memory.
MAX_BYTES = 8_000_000
#: Objects and lists in one another. Real files have up to six.
MAX_DEPTH = 64
#: Digits of a whole number: those that 64 bits hold for certain.
MAX_DIGITS = 18


def read_object(path: Path, refuse: Refuse, *, inside: Path | None = None) -> dict[str, Any]:
    """Read a JSON file that holds an object. inside: see `check_regular`.

    Raises:
        FileNotFoundError: there is no such file.
        What `refuse` makes: it is no regular file, too large, no JSON, too deep, or holds something else.
    """
    size = check_regular(path, refuse, inside=inside)
    if size > MAX_BYTES:
        raise refuse(f"'{path}' has {size} bytes; a JSON file of {MAX_BYTES} at most is read.")
    try:
        content = json.loads(path.read_bytes(), parse_int=_whole)
    except (ValueError, OSError) as error:
        raise refuse(f"'{path}' is not valid JSON ({error}).") from error
    except RecursionError:
        raise refuse(_too_deep(path)) from None
    if not isinstance(content, dict):
        raise refuse(f"'{path}' should hold a JSON object, but holds a {type(content).__name__}.")
    if _depth_exceeds(content, MAX_DEPTH):
        raise refuse(_too_deep(path))
    return content


def _too_deep(path: Path) -> str:
    return f"'{path}' has objects and lists that are nested more than {MAX_DEPTH} deep."


def _whole(digits: str) -> int:
    if len(digits.lstrip("-")) > MAX_DIGITS:
        raise ValueError(f"it has a whole number of {len(digits.lstrip('-'))} digits; expected at most {MAX_DIGITS}")
    return int(digits)


def _depth_exceeds(content: Any, limit: int) -> bool:
    """Whether values are nested deeper than `limit`; level by level, without recursion."""
    level: list[Any] = [content]
    for _ in range(limit):
        level = [
            inner
            for outer in level
            for inner in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(inner, (dict, list))
        ]
        if not level:
            return False
    return True
