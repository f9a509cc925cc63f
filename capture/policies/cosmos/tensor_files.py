"""Files of tensors, in PyTorch's format or as safetensors, read without executing any code of the file."""

from __future__ import annotations

import _codecs
import io
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

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
    if not path.is_file():
        raise TensorFileNotFound(f"There is no file of tensors at '{path}'.")
    content = _read_safetensors(path) if path.suffix == ".safetensors" else _read_torch(path)
    for wrapper in _WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
    if not isinstance(content, Mapping) or not any(isinstance(value, Tensor) for value in content.values()):
        raise UnreadableTensors(f"'{path}' holds no tensors by name, but {type(content).__name__}.")
    return dict(content)


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise UnreadableTensors(f"'{path}' cannot be read ({error}): the file is damaged or incomplete.") from error


def _read_torch(path: Path) -> Any:
    with torch.serialization.safe_globals(_HARMLESS):
        try:
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        except RuntimeError as error:  # files in PyTorch's old format cannot be mapped
            if "mmap" not in str(error):
                raise _unreadable(path, error) from error
        except (pickle.UnpicklingError, EOFError, OSError, ValueError) as error:
            raise _unreadable(path, error) from error
        try:
            return torch.load(path, map_location="cpu", weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError) as error:
            raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> UnreadableTensors:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    # One line of PyTorch's message names what it refused; the others advise how to execute it nevertheless.
    refused = [line for line in lines if "GLOBAL" in line]
    if refused:
        return RefusedPickle(
            f"'{path}' was refused: it asks for more than tensors ({refused[0].rstrip('.')}), and nothing of it was "
            "executed."
        )
    first = lines[0].rstrip(".") if lines else type(error).__name__
    return UnreadableTensors(f"'{path}' cannot be read as tensors ({first}): the file is damaged or something else.")
