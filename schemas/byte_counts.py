"""Sizes as people write them: 20GB, 1.5 TB, 500MiB, or a plain number of bytes. Imports nothing heavy."""

from __future__ import annotations

import re

_UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
_UNITS |= {"KIB": 2**10, "MIB": 2**20, "GIB": 2**30, "TIB": 2**40}
_UNITS |= {unit[0]: _UNITS[unit] for unit in ("KB", "MB", "GB", "TB")}
#: At most 15 digits before the point: more are a mistake, and hundreds would be an infinite float.
_SIZE = re.compile(r"([0-9]{1,15}(?:\.[0-9]*)?|\.[0-9]+)\s*([A-Za-z]*)")


def parse_bytes(text: str) -> int | None:
    """Read a number of bytes with or without a unit; KB (or K) is 1000 bytes, KiB 1024. None for anything else."""
    match = _SIZE.fullmatch(text.strip())
    unit = _UNITS.get(match[2].upper()) if match else None
    return None if match is None or unit is None else int(float(match[1]) * unit)
