"""Files of tensors, in PyTorch's format or as safetensors, read without executing any code of the file."""

from __future__ import annotations

import _codecs
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from vla_attention.capture.foreign_files.pickles import TENSORS, PickleDamaged, PickleRefused
from vla_attention.capture.foreign_files.regular_files import check_regular
from vla_attention.capture.foreign_files.torch_files import check_tensors, load_torch
from vla_attention.capture.policies.safetensors_file import open_safetensors
from vla_attention.schemas.errors import UserError


class TensorFileNotFound(UserError, FileNotFoundError):
    """There is no such file of tensors."""


class UnreadableTensors(UserError, ValueError):
    """A file of tensors is damaged, or holds no tensors."""


class RefusedPickle(UnreadableTensors):
    """A pickle needs more than tensors; nothing of it was executed."""


#: Types in the pickle of Transformer Engine's extra state: plain bytes.
_HARMLESS: list[Any] = [io.BytesIO, bytes, _codecs.encode]
#: Some writers wrap the tensors in a dictionary under one of these names.
_WRAPPERS = ("model", "state_dict")


def read_tensors(path: str | Path) -> dict[str, Any]:
    """Read a `.pt`, `.pth` or `.safetensors` file: name -> tensor (or extra state, which carries no weights).

    Raises `TensorFileNotFound`, `UnreadableTensors`, or `RefusedPickle` if the file would execute code.
    """
    path = Path(path)
    try:
        check_regular(path, UnreadableTensors)
    except FileNotFoundError:
        raise TensorFileNotFound(f"There is no file of tensors at '{path}'.") from None
    content = _read_safetensors(path) if path.suffix == ".safetensors" else _read_torch(path)
    for wrapper in _WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
    if not isinstance(content, Mapping) or not any(isinstance(value, Tensor) for value in content.values()):
        raise UnreadableTensors(f"'{path}' holds no tensors by name, but {type(content).__name__}.")
    try:
        check_tensors(content.values())
    except PickleRefused as error:
        raise UnreadableTensors(f"'{path}' was refused: it {error}.") from error
    return {str(name): value for name, value in content.items()}


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    with open_safetensors(path) as stored:
        return {name: stored.read(name) for name in stored.names()}


def _read_torch(path: Path) -> Any:
    try:
        return load_torch(path, TENSORS, _HARMLESS)
    except PickleRefused as error:
        raise refused(path, error) from error
    except OSError as error:
        raise UnreadableTensors(f"'{path}' cannot be read ({error.strerror or error}).") from error


def refused(path: Path, error: PickleRefused) -> UnreadableTensors:
    """Return the error for a pickle: `RefusedPickle` for one that is whole and asks for more than tensors."""
    if isinstance(error, PickleDamaged):
        return UnreadableTensors(f"'{path}' cannot be read as tensors: it {error}, or it is something else.")
    return RefusedPickle(f"'{path}' was refused: it {error}, and tensors do not; nothing of it was executed.")
