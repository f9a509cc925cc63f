"""JSON files of limited size, nesting and numbers; see `schemas.documents`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vla_attention.capture.foreign_files.regular_files import Refuse, check_regular
from vla_attention.schemas.documents import decode_json
from vla_attention.schemas.limits import WHOLE_NUMBER
from vla_attention.schemas.regular_files import NotRegular, read_regular

#: Bytes of a file. The largest of a real checkpoint, statistics and trees of arrays, have 0.2 MB; decoded, empty lists
#: take 25 times as much memory.
MAX_BYTES = 8_000_000


def read_object(path: Path, refuse: Refuse, *, inside: Path | None = None) -> dict[str, Any]:
    """Read a JSON file that holds an object. inside: see `check_regular`.

    Raises:
        FileNotFoundError: there is no such file.
        What `refuse` makes: it is no regular file, too large, no JSON, too deep, or holds something else.
    """
    check_regular(path, refuse, inside=inside)
    try:
        content = decode_json(read_regular(path, MAX_BYTES))
    except NotRegular as error:
        raise refuse(f"'{path}' cannot be read: {error.strerror}.") from None
    except (ValueError, OSError) as error:
        raise refuse(f"'{path}' is not valid JSON ({error}).") from error
    if not isinstance(content, dict):
        raise refuse(f"'{path}' should hold a JSON object, but holds a {type(content).__name__}.")
    if _has_longer_number(content):
        raise refuse(f"'{path}' has a whole number that 64 bits do not hold.")
    return content


def _has_longer_number(content: Any) -> bool:
    level: list[Any] = [content]
    while level:
        inner = [value for outer in level for value in (outer.values() if isinstance(outer, dict) else outer)]
        if any(isinstance(value, int) and not -WHOLE_NUMBER <= value < WHOLE_NUMBER for value in inner):
            return True
        level = [value for value in inner if isinstance(value, (dict, list))]
    return False
