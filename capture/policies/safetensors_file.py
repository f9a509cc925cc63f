"""safetensors files, one or several with an index. Every error names the file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import safe_open
from torch import Tensor

from vla_attention.capture.policies.checkpoints import UnreadableCheckpoint, check_checkpoint_file, read_json_object
from vla_attention.capture.policies.weights import check_floats
from vla_attention.schemas.errors import listing


@dataclass(frozen=True)
class SafetensorsFile:
    """An open file: names and shapes are known, numbers are read when they are asked for."""

    path: Path
    stored: Any

    def names(self) -> list[str]:
        """Return the names of the tensors."""
        return list(self.stored.keys())

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a tensor."""
        return tuple(self.stored.get_slice(name).get_shape())

    def read(self, name: str) -> Tensor:
        """Read one tensor."""
        try:
            tensor: Tensor = self.stored.get_tensor(name)
        except Exception as error:  # the library's own, and PyTorch's for types and sizes that it does not know
            raise _unreadable(self.path, error) from error
        return tensor

    def check_floats(self, names: Iterable[str]) -> None:
        """Raise `CheckpointMismatch` for tensors that are no weights; see `weights.check_floats`."""
        check_floats({name: str(self.stored.get_slice(name).get_dtype()) for name in names}, self.path)


@contextmanager
def open_safetensors(path: Path) -> Iterator[SafetensorsFile]:
    """Open a file; `UnreadableCheckpoint` for a damaged one, also later while it is read."""
    check_checkpoint_file(path)
    try:
        opened = safe_open(path, framework="pt")
    except Exception as error:  # the library's own, and PyTorch's for a file that does not fit into memory
        raise _unreadable(path, error) from error
    with opened as stored:
        yield SafetensorsFile(path, stored)


class _Files:
    """The tensors of several open files, as `safe_open` gives those of one."""

    def __init__(self, file_of: dict[str, Any]) -> None:
        self._file_of = file_of

    def keys(self) -> list[str]:
        return list(self._file_of)

    def get_slice(self, name: str) -> Any:
        return self._file_of[name].get_slice(name)

    def get_tensor(self, name: str) -> Any:
        return self._file_of[name].get_tensor(name)


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
        opened = {file: stack.enter_context(open_safetensors(index.parent / file)) for file in files}
        held = {name: file for file in files for name in opened[file].names()}
        wrong = sorted(name for name in {*held, *stated} if held.get(name) != stated.get(name))
        if wrong:
            raise UnreadableCheckpoint(
                f"'{index}' and its files disagree on where {listing(wrong)} is: files of two checkpoints, or one is "
                "missing from the copy."
            )
        yield SafetensorsFile(index, _Files({name: opened[file].stored for name, file in held.items()}))


def _unreadable(path: Path, error: Exception) -> UnreadableCheckpoint:
    return UnreadableCheckpoint(f"'{path}' cannot be read ({error}): the file is damaged or its copy incomplete.")
