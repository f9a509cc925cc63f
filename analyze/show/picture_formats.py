"""In which formats pictures are saved: PNG and PDF, or PNG alone, as a command line says."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

_formats: ContextVar[tuple[str, ...]] = ContextVar("formats of pictures", default=("png", "pdf"))


def picture_formats() -> tuple[str, ...]:
    """The formats of pictures that are saved now."""
    return _formats.get()


@contextmanager
def pictures_saved_as(formats: Sequence[str]) -> Iterator[None]:
    """Within the block, pictures are saved in these formats."""
    token = _formats.set(tuple(formats))
    try:
        yield
    finally:
        _formats.reset(token)
