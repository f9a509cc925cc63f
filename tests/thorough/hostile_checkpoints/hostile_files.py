"""Files that attack whoever reads them: pickles, zips, safetensors, JSON, pipes and links."""

from __future__ import annotations

import json
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.thorough.hostile_runs import Make


@dataclass(frozen=True)
class Case:
    """An attack: how it is made, and what the sentence has to contain (a regular expression)."""

    make: Make
    sentence: str


class Execute:
    """An object whose pickle makes a file when it is read."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> Any:
        return os.system, (f"touch {self.trace}",)


#: What is said of a file that torch cannot read.
NO_TORCH_FILE = "cannot be read as a file of torch.save"
#: What an executed pickle leaves, in the folder of its case.
TRACE = "executed"


def executing_pickle(folder: Path) -> bytes:
    return pickle.dumps({"net.a": Execute(folder / TRACE)}, protocol=2)


def hash_bomb() -> bytes:
    """A dictionary whose key is a tuple that holds itself twice, forty times over: to hash it takes an hour."""
    return b"\x80\x02}" + b")" + b"2\x86" * 40 + b"K\x01s."


def table_bomb() -> bytes:
    """An entry of number 4 billion in a table: Python's own reader takes 64 GB for it."""
    return b"\x80\x02}r" + struct.pack("<I", 2**32 - 16) + b"."


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value.encode())) + value.encode()


def torch_zip(
    path: Path, content: bytes, method: int = zipfile.ZIP_STORED, more: dict[str, bytes] | None = None
) -> None:
    """A file of `torch.save` with this pickle."""
    with zipfile.ZipFile(path, "w", method) as file:
        file.writestr("archive/data.pkl", content)
        for name, stored in (more or {}).items():
            file.writestr(f"archive/{name}", stored)
        file.writestr("archive/version", b"3\n")


def old_torch(path: Path, content: bytes) -> None:
    """A file of `torch.save` before 1.6 with this pickle."""
    head = [pickle.dumps(part, protocol=2) for part in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True})]
    path.write_bytes(b"".join([*head, content, pickle.dumps([], protocol=2)]))


def safetensors(path: Path, header: bytes | dict[str, Any], data: bytes = b"", *, length: int | None = None) -> None:
    """A safetensors file; length: what it says of its header."""
    written = json.dumps(header).encode() if isinstance(header, dict) else header
    path.write_bytes(struct.pack("<Q", len(written) if length is None else length) + written + data)


def tensor(shape: list[int], end: int, start: int = 0, kind: str = "F32") -> dict[str, Any]:
    return {"dtype": kind, "shape": shape, "data_offsets": [start, end]}


def sparse(path: Path, size: int, head: bytes = b"") -> None:
    """A file of a size that takes no room on the disk."""
    path.write_bytes(head)
    os.truncate(path, size)


def pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def link(path: Path, to: str | Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to(to)


def deep(levels: int = 100_000) -> str:
    return '{"a": ' + "[" * levels + "]" * levels + "}"


def edit(path: Path, make: Callable[[dict[str, Any]], object]) -> None:
    """Change a JSON file."""
    content = json.loads(path.read_text())
    make(content)
    path.write_text(json.dumps(content))


HUGE_NUMBER = '{"type": "pi05", "chunk_size": ' + "9" * 5000 + "}"
