"""What cannot be written, in one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.store_format import StoreError


class StoreWriteFailed(StoreError, OSError):
    """The operating system refused a write: the disk is full, a permission is missing, a device failed."""


@contextmanager
def naming_the_failure(what: str) -> Iterator[None]:
    """Turn an error of the operating system into one sentence with what was being written."""
    try:
        yield
    except OSError as error:
        if isinstance(error, UserError):
            raise
        raise StoreWriteFailed(
            f"Cannot write {what}: {error.strerror or error}. Nothing of this episode was kept, and the episodes "
            "before it are unharmed; remove the cause and go on with --resume."
        ) from error
