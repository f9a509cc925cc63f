"""Which arithmetic made a number: what another version of it kept in the cache is not used."""

from __future__ import annotations

import hashlib
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path

import vla_attention

#: The sources that numbers depend on: how bytes become rows, selectors weights, and rows measures.
_SOURCES = (
    "schemas/*.py",
    "schemas/groupings/*.py",
    "schemas/groupings/word_lists/*",
    "schemas/stores/*.py",
    "analyze/stores/*.py",
    "analyze/measures/*.py",
    "analyze/heads/*.py",
    "analyze/words/*.py",
)


@cache
def arithmetic_version() -> str:
    """A digest of the sources that make the numbers, of numpy's version and of the machine's order of bytes.

    A number that somebody must raise with every change would be forgotten once, and the cache would then give numbers
    of the arithmetic before.
    """
    digest = hashlib.sha256(f"numpy {version('numpy')} {sys.byteorder} {sys.version_info[:2]}".encode())
    package = Path(vla_attention.__file__).parent
    for pattern in _SOURCES:
        for file in sorted(package.glob(pattern)):
            if file.is_file():
                content = file.read_bytes()
                digest.update(f"\n{file.relative_to(package)} {len(content)}\n".encode())
                digest.update(content)
    return digest.hexdigest()
