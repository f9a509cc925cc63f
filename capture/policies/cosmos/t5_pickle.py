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
from typing import Any

import torch
import torch._utils
from torch import Tensor

from vla_attention.capture.policies.checkpoints import CheckpointNotFound, UnreadableCheckpoint
from vla_attention.capture.torch_files import reason_of, tensor_problem
from vla_attention.schemas.bounded_process import BoundedProcess
from vla_attention.schemas.checked_files import check_regular
from vla_attention.schemas.errors import UnknownName, listing

#: The command that adds sentences to such a file.
ENCODE_PROMPTS = "vla_attention.capture.policies.cosmos.encode_prompts"


def _load_storage(content: bytes) -> Any:
    """Read a storage with PyTorch's own restricted reader, on the CPU; replaces the pickle's `_load_from_bytes`."""
    return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)


#: The only functions that such a file may call.
_ALLOWED: dict[tuple[str, str], Callable[..., Any]] = {
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): torch._utils._rebuild_tensor_v2,
    ("torch.storage", "_load_from_bytes"): _load_storage,
}


class _RestrictedUnpickler(pickle.Unpickler):
    """Reads tensors only; any other object is refused before it is created."""

    def find_class(self, module: str, name: str) -> Any:
        """Return one of the allowed functions; `UnpicklingError` for any other."""
        allowed = _ALLOWED.get((module, name))
        if allowed is None:
            raise pickle.UnpicklingError(
                f"it asks for {module}.{name}, and text embeddings need tensors only; nothing of it was executed"
            )
        return allowed


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
        """Return the embedding of an instruction, zeros for an empty one without; `UnknownName` lists the nearest."""
        if instruction in self.by_instruction:
            return self.by_instruction[instruction]
        if not instruction:
            return torch.zeros_like(next(iter(self.by_instruction.values())))
        near = difflib.get_close_matches(instruction, list(self.by_instruction), n=3, cutoff=0.5)
        nearest = listing(f"'{name}'" for name in near) if near else "none of them is near"
        raise UnknownName(
            f"There is no text embedding of '{instruction}' among the {len(self.by_instruction)} of '{self.path}'; "
            f"nearest: {nearest}. Give --t5-encoder FOLDER, or encode it where there is one: `python -m "
            f"{ENCODE_PROMPTS} {self.path} NEW.pkl --t5-encoder FOLDER --prompt '{instruction}'`, and give "
            "--t5-text-embeddings-path NEW.pkl."
        )


def read_embeddings(path: str | Path) -> TextEmbeddings:
    """Read a pickle of text embeddings, in a process with limits.

    Raises `CheckpointNotFound`, or `UnreadableCheckpoint` when it is damaged, takes too much, or holds more than
    tensors; nothing of it was executed then.
    """
    path = Path(path)
    try:
        check_regular(path, UnreadableCheckpoint)
    except FileNotFoundError:
        raise CheckpointNotFound(
            f"There are no text embeddings at '{path}'; give --t5-text-embeddings-path (libero_t5_embeddings.pkl of "
            "the checkpoint)."
        ) from None
    process = BoundedProcess(UnreadableCheckpoint)
    stored = process.call(path, checked_embeddings, path)
    process.close()
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return TextEmbeddings(str(path), torch.load(io.BytesIO(stored), weights_only=True), digest)


def checked_embeddings(path: Path) -> bytes:
    """Read and check a pickle of text embeddings; returns them as torch.save writes them."""
    try:
        with path.open("rb") as file:
            found = _RestrictedUnpickler(file).load()
    except MemoryError:
        raise
    except Exception as error:  # a damaged pickle raises almost anything
        raise UnreadableCheckpoint(
            f"'{path}' was refused as text embeddings: {reason_of(error)}. Get it again from its source."
        ) from error
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
    if problem := tensor_problem(found.values()):
        raise UnreadableCheckpoint(f"'{path}' was refused as text embeddings: it {problem}.")
    if len(shapes) > 1:
        raise UnreadableCheckpoint(f"The embeddings of '{path}' have different shapes: {listing(sorted(shapes))}.")
    stored = io.BytesIO()
    torch.save(dict(found), stored)
    return stored.getvalue()
