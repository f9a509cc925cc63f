"""safetensors files, one or several with an index. Every error names the file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import safe_open
from torch import Tensor

from vla_attention.capture.policies.checkpoints import UnreadableCheckpoint, check_checkpoint_file, read_json_object
from vla_attention.capture.policies.weights import Shapes, check_floats
from vla_attention.schemas.errors import listing


@dataclass(frozen=True)
class SafetensorsFile:
    """Open tensors: names and shapes are known, numbers are read when they are asked for.

    held: name -> the library's open file that holds the tensor, and its name there.
    """

    path: Path
    held: Mapping[str, tuple[Any, str]]

    def shapes(self) -> Shapes:
        """Return name -> shape."""
        return {name: tuple(file.get_slice(raw).get_shape()) for name, (file, raw) in self.held.items()}

    def read(self, name: str) -> Tensor:
        """Read one tensor."""
        file, raw = self.held[name]
        try:
            tensor: Tensor = file.get_tensor(raw)
        except Exception as error:  # the library's own, and PyTorch's for types and sizes that it does not know
            raise _unreadable(self.path, error) from error
        return tensor

    def check_floats(self) -> None:
        """Raise `CheckpointMismatch` for tensors that are no weights; see `weights.check_floats`."""
        check_floats({raw: str(file.get_slice(raw).get_dtype()) for file, raw in self.held.values()}, self.path)


@contextmanager
def open_safetensors(path: Path) -> Iterator[SafetensorsFile]:
    """Open a file; `UnreadableCheckpoint` for a damaged one, also later while it is read."""
    check_checkpoint_file(path)
    try:
        opened = safe_open(path, framework="pt")
    except Exception as error:  # the library's own, and PyTorch's for a file that does not fit into memory
        raise _unreadable(path, error) from error
    with opened as file:
        names: list[str] = file.keys()
        yield SafetensorsFile(path, {name: (file, name) for name in names})


@contextmanager
def open_indexed_safetensors(index: Path) -> Iterator[SafetensorsFile]:
    """Open a checkpoint of several files by its index, which names the file of each tensor.

    Raises:
        UnreadableCheckpoint: a file is missing or damaged, or does not hold the tensors that the index says.
    """
    stated = read_json_object(index).get("weight_map")
    if not isinstance(stated, dict) or not all(
        isinstance(file, str) and file.endswith(".safetensors") and Path(file).name == file for file in stated.values()
    ):
        raise UnreadableCheckpoint(f"'{index}' has no weight_map from tensors to files beside it.")
    files = sorted(set(stated.values()))
    with ExitStack() as stack:
        opened = {file: stack.enter_context(open_safetensors(index.parent / file)).held for file in files}
        file_of = {name: file for file, held in opened.items() for name in held}
        wrong = sorted(name for name in {*file_of, *stated} if file_of.get(name) != stated.get(name))
        if wrong:
            raise UnreadableCheckpoint(
                f"'{index}' and its files disagree on where {listing(wrong)} is: files of two checkpoints, or one is "
                "missing from the copy."
            )
        yield SafetensorsFile(index, {name: place for held in opened.values() for name, place in held.items()})


def _unreadable(path: Path, error: Exception) -> UnreadableCheckpoint:
    return UnreadableCheckpoint(f"'{path}' cannot be read ({error}): the file is damaged or its copy incomplete.")
