"""Precomputed T5 embeddings, read from their pickle without executing any code of the file."""

from __future__ import annotations

import collections
import difflib
import hashlib
import io
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import torch._utils
from torch import Tensor

from vla_attention.capture.foreign_files.checked_files import check_regular
from vla_attention.capture.foreign_files.pickles import (
    TENSORS,
    Check,
    PickleDamaged,
    PickleRefused,
    anything,
    check_pickle,
    nothing,
)
from vla_attention.capture.foreign_files.torch_files import check_tensors, load_torch
from vla_attention.capture.policies.checkpoints import CheckpointNotFound, UnreadableCheckpoint
from vla_attention.capture.policies.cosmos.tensor_files import RefusedPickle
from vla_attention.schemas.errors import UnknownName, listing


def _load_storage(content: bytes) -> Any:
    """Read a storage with PyTorch's own restricted reader, on the CPU; replaces the pickle's `_load_from_bytes`."""
    return load_torch(io.BytesIO(content), TENSORS)


#: The only functions that such a file may call.
_ALLOWED: dict[tuple[str, str], Callable[..., Any]] = {
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): torch._utils._rebuild_tensor_v2,
    ("torch.storage", "_load_from_bytes"): _load_storage,
}


#: The same by their names in the pickle, with what their arguments have to be.
_CALLS: dict[str, Check] = {".".join(name): nothing if name[1] == "OrderedDict" else anything for name in _ALLOWED}
#: Bytes of a file. One embedding of T5-11b has 1 MB; LIBERO has 130 tasks.
MAX_EMBEDDINGS_BYTES = 2_000_000_000


class _RestrictedUnpickler(pickle.Unpickler):
    """Reads tensors only; any other object is refused before it is created."""

    def find_class(self, module: str, name: str) -> Any:
        """Return one of the allowed functions; `RefusedPickle` for any other."""
        allowed = _ALLOWED.get((module, name))
        if allowed is None:
            raise RefusedPickle(f"asks for {module}.{name}")
        return allowed

    def persistent_load(self, identifier: Any) -> NoReturn:
        """Raise `RefusedPickle`: a file of embeddings needs nothing outside itself."""
        raise RefusedPickle("refers to something outside itself")


@dataclass(frozen=True)
class TextEmbeddings:
    """Precomputed text embeddings: instruction -> (1, position, width), positions after the real tokens are 0."""

    path: str
    by_instruction: Mapping[str, Tensor]
    digest: str

    @property
    def shape(self) -> tuple[int, int]:
        """Positions and width of every embedding."""
        _, positions, width = next(iter(self.by_instruction.values())).shape
        return positions, width

    def find(self, instruction: str) -> Tensor:
        """Return the embedding of an instruction; `UnknownName` lists the nearest instructions."""
        if instruction in self.by_instruction:
            return self.by_instruction[instruction]
        near = difflib.get_close_matches(instruction, list(self.by_instruction), n=3, cutoff=0.5)
        nearest = listing(f"'{name}'" for name in near) if near else "none of them is near"
        raise UnknownName(
            f"There is no text embedding of '{instruction}' among the {len(self.by_instruction)} of '{self.path}'; "
            f"nearest: {nearest}. Precompute it and give the file as --t5-text-embeddings-path, or give --t5-encoder "
            "PATH."
        )


def read_embeddings(path: str | Path) -> TextEmbeddings:
    """Read a pickle of text embeddings.

    Raises `CheckpointNotFound`, `UnreadableCheckpoint`, or `RefusedPickle` when it holds more than tensors; nothing of
    it was executed then.
    """
    path = Path(path)
    try:
        size = check_regular(path, UnreadableCheckpoint)
    except FileNotFoundError:
        raise CheckpointNotFound(
            f"There are no text embeddings at '{path}'; give --t5-text-embeddings-path (libero_t5_embeddings.pkl of "
            "the checkpoint)."
        ) from None
    if size > MAX_EMBEDDINGS_BYTES:
        raise UnreadableCheckpoint(
            f"'{path}' has {size} bytes; text embeddings of {MAX_EMBEDDINGS_BYTES} at most are read."
        )
    with path.open("rb") as file:
        content = _read(file, path)
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return TextEmbeddings(str(path), _checked(content, path), digest)


def _read(file: BinaryIO, path: Path) -> Any:
    try:
        check_pickle(file, _CALLS, most_numbers=0)
        file.seek(0)
        return _RestrictedUnpickler(file).load()
    except (PickleRefused, RefusedPickle) as error:
        if isinstance(error, PickleDamaged):
            raise UnreadableCheckpoint(f"'{path}' cannot be read as text embeddings: it {error}.") from error
        raise RefusedPickle(
            f"'{path}' was refused: it {error}, and text embeddings need tensors only; nothing of it was executed."
        ) from error
    except Exception as error:  # a damaged pickle raises almost anything
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UnreadableCheckpoint(f"'{path}' cannot be read as text embeddings ({first}).") from error


def _checked(found: Any, path: Path) -> dict[str, Tensor]:
    if not isinstance(found, dict) or not found:
        raise UnreadableCheckpoint(
            f"'{path}' holds no text embeddings (a dictionary of instructions), but {type(found).__name__}."
        )
    shapes = set()
    for name, value in found.items():
        if not isinstance(name, str) or not isinstance(value, Tensor) or value.ndim != 3 or value.shape[0] != 1:
            raise UnreadableCheckpoint(
                f"'{path}' should hold instruction -> tensor (1, position, width), but has an entry for {name!r} that "
                f"is {tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__}."
            )
        shapes.add(tuple(value.shape))
    try:
        check_tensors(found.values())
    except PickleRefused as error:
        raise UnreadableCheckpoint(f"'{path}' {error}.") from error
    if len(shapes) > 1:
        raise UnreadableCheckpoint(f"The embeddings of '{path}' have different shapes: {listing(sorted(shapes))}.")
    return dict(found)
