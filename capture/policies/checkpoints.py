"""Checkpoint folders of any family: the errors that they can cause, and reading their JSON files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vla_attention.capture.foreign_files.checked_files import check_regular, read_object
from vla_attention.schemas.errors import UserError

#: Size of an axis, or a number of parts, that a checkpoint states. The largest of the models here is a vocabulary of
#: 257,152.
MAX_SIZE = 1_000_000
#: Blocks of a transformer; each is made before the first tensor is compared. The models here have 28.
MAX_BLOCKS = 500
#: Steps, actions of a chunk, text slots: no tensor has their number, so that none is compared with it.
MAX_STEPS = 10_000

#: What values of wrong types raise when they are used.
_WRONG_VALUES = (TypeError, ValueError, KeyError, IndexError, AttributeError, ArithmeticError, RecursionError)


class CheckpointNotFound(UserError, FileNotFoundError):
    """There is no checkpoint, or not all of it."""


class UnsupportedCheckpoint(UserError, ValueError):
    """The folder is no checkpoint, or a checkpoint of another kind or form."""


class UnreadableCheckpoint(UserError, ValueError):
    """The folder has the right files, but one of them is damaged."""


class CheckpointMismatch(UserError, ValueError):
    """The checkpoint's tensors are not those of the model: names or shapes differ."""


def read_json_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object; anything else is an `UnreadableCheckpoint`."""
    try:
        return read_object(path, UnreadableCheckpoint, inside=path.parent)
    except FileNotFoundError:
        raise UnreadableCheckpoint(f"There is no '{path}', which the checkpoint needs.") from None


def check_checkpoint_file(path: Path) -> int:
    """Return the size of a checkpoint's file in bytes; `UnreadableCheckpoint` if it is none, see `check_regular`."""
    try:
        return check_regular(path, UnreadableCheckpoint, inside=path.parent)
    except FileNotFoundError:
        raise UnreadableCheckpoint(f"There is no '{path}', which the checkpoint needs.") from None


@contextmanager
def values_of(path: Path) -> Iterator[None]:
    """Turn what values of wrong types raise into an `UnreadableCheckpoint` that names their file."""
    try:
        yield
    except UserError:
        raise
    except _WRONG_VALUES as error:
        raise UnreadableCheckpoint(
            f"'{path}' has values of other types or sizes than a checkpoint's ({type(error).__name__}: {error})."
        ) from error


def check_size(what: str, value: object, most: int = MAX_SIZE, *, least: int = 1) -> int:
    """Return a whole number that a checkpoint states, or raise `UnreadableCheckpoint`. what: begins the sentence."""
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise UnreadableCheckpoint(f"{what} is {value!r}; expected a whole number from {least} to {most}.")
    return value
