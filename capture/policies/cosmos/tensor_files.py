"""Files of tensors, in PyTorch's format or as safetensors, read without executing any code of the file."""

from __future__ import annotations

import _codecs
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from vla_attention.capture.foreign_files.checked_files import check_regular
from vla_attention.capture.foreign_files.pickles import TENSORS, PickleDamaged, PickleRefused
from vla_attention.capture.foreign_files.torch_files import check_tensors, load_torch
from vla_attention.capture.policies.checkpoints import CheckpointNotFound, UnreadableCheckpoint
from vla_attention.capture.policies.safetensors_file import open_safetensors


class RefusedPickle(UnreadableCheckpoint):
    """A pickle needs more than tensors; nothing of it was executed."""


#: Types in the pickle of Transformer Engine's extra state: plain bytes.
_HARMLESS: list[Any] = [io.BytesIO, bytes, _codecs.encode]
#: Some writers wrap the tensors in a dictionary under one of these names.
_WRAPPERS = ("model", "state_dict")


def read_tensors(path: str | Path) -> dict[str, Any]:
    """Read a `.pt`, `.pth` or `.safetensors` file: name -> tensor (or extra state, which carries no weights).

    Raises `CheckpointNotFound`, `UnreadableCheckpoint`, or `RefusedPickle` if the file would execute code.
    """
    path = Path(path)
    try:
        check_regular(path, UnreadableCheckpoint)
    except FileNotFoundError:
        raise CheckpointNotFound(f"There is no file of tensors at '{path}'.") from None
    content: Any
    if path.suffix == ".safetensors":
        with open_safetensors(path) as stored:
            content = {name: stored.read(name) for name in stored.names()}
    else:
        try:
            content = load_torch(path, TENSORS, _HARMLESS)
        except PickleRefused as error:
            raise refused(path, error) from error
        except OSError as error:
            raise UnreadableCheckpoint(f"'{path}' cannot be read ({error.strerror or error}).") from error
    for wrapper in _WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
    if not isinstance(content, Mapping) or not any(isinstance(value, Tensor) for value in content.values()):
        raise UnreadableCheckpoint(f"'{path}' holds no tensors by name, but {type(content).__name__}.")
    try:
        check_tensors(content.values())
    except PickleRefused as error:
        raise UnreadableCheckpoint(f"'{path}' was refused: it {error}.") from error
    return {str(name): value for name, value in content.items()}


def refused(path: Path, error: PickleRefused) -> UnreadableCheckpoint:
    """Return the error for a pickle: `RefusedPickle` for one that is whole and asks for more than tensors."""
    if isinstance(error, PickleDamaged):
        return UnreadableCheckpoint(f"'{path}' cannot be read as tensors: it {error}, or it is something else.")
    return RefusedPickle(f"'{path}' was refused: it {error}, and tensors do not; nothing of it was executed.")
