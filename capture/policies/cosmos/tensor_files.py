"""Files of tensors, in PyTorch's format or as safetensors, read without executing any code of the file."""

from __future__ import annotations

import _codecs
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from vla_attention.capture.policies.checkpoints import CheckpointNotFound, UnreadableCheckpoint
from vla_attention.capture.policies.safetensors_file import open_safetensors
from vla_attention.capture.torch_files import load_torch, tensor_problem
from vla_attention.schemas.checked_files import check_regular

#: Types in the pickle of Transformer Engine's extra state: plain bytes.
_EXTRA_STATE: list[Any] = [io.BytesIO, bytes, _codecs.encode]
#: Some writers wrap the tensors in a dictionary under one of these names.
_WRAPPERS = ("model", "state_dict")


def read_tensors(path: str | Path) -> dict[str, Any]:
    """Read a `.pt`, `.pth` or `.safetensors` file: name -> tensor (or extra state, which carries no weights).

    Raises `CheckpointNotFound` or `UnreadableCheckpoint`, also for a file that would execute code.
    """
    path = Path(path)
    try:
        check_regular(path, UnreadableCheckpoint)
    except FileNotFoundError:
        raise CheckpointNotFound(f"There is no file of tensors at '{path}'.") from None
    content: Any
    if path.suffix == ".safetensors":
        with open_safetensors(path) as stored:
            content = {name: stored.read(name) for name in stored.held}
    else:
        content = load_torch(path, UnreadableCheckpoint, _EXTRA_STATE)
    for wrapper in _WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
    if not isinstance(content, Mapping) or not any(isinstance(value, Tensor) for value in content.values()):
        raise UnreadableCheckpoint(f"'{path}' holds no tensors by name, but {type(content).__name__}.")
    if problem := tensor_problem(content.values()):
        raise UnreadableCheckpoint(f"'{path}' was refused: it {problem}.")
    return {str(name): value for name, value in content.items()}
