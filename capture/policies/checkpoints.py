"""Checkpoint folders of any family: the errors that they can cause, and reading their JSON files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, TypeVar

from msgspec import Meta

from vla_attention.schemas.checked_files import check_regular, read_object
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.jsonable import MalformedDocument, from_json

T = TypeVar("T")

#: Size of an axis, or a number of parts, that a checkpoint states. The largest of the models here is a vocabulary of
#: 257,152.
MAX_SIZE = 1_000_000
#: Blocks of a transformer; each is made before the first tensor is compared. The models here have 28.
MAX_BLOCKS = 500
#: Steps, actions of a chunk, text slots: no tensor has their number, so that none is compared with it.
MAX_STEPS = 10_000
#: The same as types of fields, for `read_typed`.
Size = Annotated[int, Meta(ge=1, le=MAX_SIZE)]
Blocks = Annotated[int, Meta(ge=1, le=MAX_BLOCKS)]
Steps = Annotated[int, Meta(ge=1, le=MAX_STEPS)]


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
    check_checkpoint_file(path)
    return read_object(path, UnreadableCheckpoint, inside=path.parent)


def check_checkpoint_file(path: Path) -> int:
    """Return the size of a checkpoint's file in bytes; `UnreadableCheckpoint` if it is none, see `check_regular`."""
    try:
        return check_regular(path, UnreadableCheckpoint, inside=path.parent)
    except FileNotFoundError:
        raise UnreadableCheckpoint(f"There is no '{path}', which the checkpoint needs.") from None


def read_typed(path: Path, declared: type[T]) -> T:
    """Read a JSON file into a msgspec struct; `UnsupportedCheckpoint` names the value that it does not take."""
    try:
        return from_json(declared, read_json_object(path), f"'{path}' at $")
    except MalformedDocument as error:
        raise UnsupportedCheckpoint(str(error)) from None


def check_size(what: str, value: object, most: int = MAX_SIZE, *, least: int = 1) -> int:
    """Return a whole number that a checkpoint states, or raise `UnreadableCheckpoint`. what: begins the sentence."""
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise UnreadableCheckpoint(f"{what} is {value!r}; expected a whole number from {least} to {most}.")
    return value
