"""Files of `torch.save`, read with PyTorch's restricted reader after a check of their zip and of their pickles."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import torch
from torch import Tensor

from vla_attention.capture.foreign_files.pickles import Check, PickleDamaged, PickleRefused, check_pickle

#: Bytes of a zip's directory. A model of two thousand tensors has 0.2 MB; read, an entry takes ten times as much.
MAX_DIRECTORY_BYTES = 8_000_000
#: Bytes of the pickle in a zip. It names the tensors, whose numbers are in files of their own: 1 MB.
MAX_PICKLE_BYTES = 64_000_000
#: Pickles at the beginning of a file in PyTorch's format before 1.6: a number, a version, sizes of types, the content,
#: and the names of the storages.
_OLD_PICKLES = 5
_ZIP, _PICKLE_NAME = b"PK\x03\x04", "data.pkl"
_LOCAL_HEADER = 30


def load_torch(source: Path | IO[bytes], allowed: Mapping[str, Check], more_types: Sequence[Any] = ()) -> Any:
    """Return the content of a file of `torch.save`, on the CPU. Nothing of the file is executed.

    source: a path, whose tensors are mapped into memory where the format allows it, or an open file. allowed: the
    functions that its pickle may call, see `pickles`. more_types: those of them that PyTorch does not know.

    Raises:
        PickleRefused: it holds more than `allowed`, is damaged, or is something else.
        OSError: it cannot be opened.
    """
    if isinstance(source, Path):
        with source.open("rb") as file:
            is_zip = _check_file(file, allowed)
    else:
        is_zip = _check_file(source, allowed)
        source.seek(0)
    try:
        with torch.serialization.safe_globals(list(more_types)), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the pickle has another protocol than torch's own
            mapped = is_zip and isinstance(source, Path)
            return torch.load(source, map_location="cpu", weights_only=True, mmap=mapped)
    except Exception as error:  # a damaged file raises almost anything
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise PickleDamaged(f"is damaged ({lines[0].rstrip('.') if lines else type(error).__name__})") from error


def check_tensors(values: Iterable[object]) -> None:
    """Raise `PickleRefused` unless all tensors are plain ones whose numbers are in their file.

    A tensor may claim any shape with a step of 0, and many tensors may claim the same numbers: no memory is taken
    before they are copied.
    """
    claimed, stored = 0, {}
    for value in values:
        if not isinstance(value, Tensor):
            continue
        if value.layout is not torch.strided or value.device.type != "cpu" or value.is_quantized or value.is_nested:
            raise PickleRefused(f"has a tensor that is {value.layout}, quantized or without numbers")
        storage, size = value.untyped_storage(), value.numel() * value.element_size()
        if size > storage.nbytes():
            raise PickleRefused(f"has a tensor of shape {tuple(value.shape)}, whose numbers it does not hold")
        claimed += size
        stored[storage.data_ptr()] = storage.nbytes()
    if claimed > 2 * sum(stored.values()):
        raise PickleRefused(f"has tensors of {claimed} bytes, and {sum(stored.values())} bytes of numbers for them")


def _check_file(file: IO[bytes], allowed: Mapping[str, Check]) -> bool:
    """Check the pickles of a file; returns whether it is a zip."""
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    is_zip = file.read(len(_ZIP)) == _ZIP
    file.seek(0)
    if is_zip:
        check_pickle(io.BytesIO(_pickle_in_zip(file, size)), allowed, most_numbers=size)
    else:
        for _ in range(_OLD_PICKLES):
            check_pickle(file, allowed, most_numbers=size)
    return is_zip


def _pickle_in_zip(file: IO[bytes], size: int) -> bytes:
    try:
        with zipfile.ZipFile(_Limited(file)) as opened:
            members = opened.infolist()
    except (zipfile.BadZipFile, struct.error, ValueError, NotImplementedError, OverflowError, EOFError) as error:
        raise PickleDamaged(f"is damaged ({error})") from error
    packed = [member.filename for member in members if member.compress_type != zipfile.ZIP_STORED]
    if packed or sum(member.file_size for member in members) > size:
        raise PickleRefused("is a compressed zip, which torch.save does not write")
    pickles = [member for member in members if member.filename.rpartition("/")[2] == _PICKLE_NAME]
    if len(pickles) != 1:
        raise PickleRefused(f"has {len(pickles)} files {_PICKLE_NAME}; expected one")
    if pickles[0].file_size > MAX_PICKLE_BYTES:
        raise PickleRefused(
            f"has a {_PICKLE_NAME} of {pickles[0].file_size} bytes; expected {MAX_PICKLE_BYTES} at most"
        )
    # Not by zipfile, which compares checksums that torch.save may leave out.
    file.seek(pickles[0].header_offset)
    header = file.read(_LOCAL_HEADER)
    if len(header) < _LOCAL_HEADER:
        raise PickleDamaged("is damaged (its directory leads beyond its end)")
    file.seek(sum(struct.unpack("<HH", header[-4:])), io.SEEK_CUR)
    return file.read(pickles[0].file_size)


class _Limited:
    """A file for `zipfile`, which reads the directory at once, however long it is said to be."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, count: int = -1) -> bytes:
        if count > MAX_DIRECTORY_BYTES:
            raise PickleRefused(f"has a directory of {count} bytes; expected {MAX_DIRECTORY_BYTES} at most")
        return self._file.read(MAX_DIRECTORY_BYTES if count < 0 else count)
