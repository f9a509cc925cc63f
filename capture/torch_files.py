"""Files of `torch.save`, read by PyTorch's reader that runs no code of a file, with the types that a kind needs."""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vla_attention.schemas.checked_files import Refuse, check_regular
from vla_attention.schemas.errors import listing


def load_torch(path: Path, refuse: Refuse, more_types: Sequence[Any] = ()) -> Any:
    """Return the content of a file of `torch.save`, on the CPU, its tensors mapped into memory. Nothing is executed.

    more_types: functions and classes that its pickle may name beside those of tensors, or pairs of one with the name
    that it has in the file.

    Raises:
        FileNotFoundError: there is no such file.
        What `refuse` makes: it names anything else, is damaged, or is no file of `torch.save` since PyTorch 1.6.
    """
    check_regular(path, refuse)
    with torch.serialization.safe_globals(list(more_types)):
        try:
            others = torch.serialization.get_unsafe_globals_in_checkpoint(path)
            content = None if others else torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        except Exception as error:  # a damaged file raises almost anything
            raise refuse(
                f"'{path}' cannot be read as a file of torch.save ({reason_of(error)}); get it again from its source."
            ) from error
    if others:
        raise refuse(
            f"'{path}' was refused: it asks for {listing(sorted(others))}, which such a file does not need; nothing of "
            "it was executed. Get it again from its source."
        )
    return content


def reason_of(error: BaseException) -> str:
    """The first line of what an unpickler says of a file."""
    # Torch puts an advice to trust the file in front of the cause.
    cause = error.__context__ if isinstance(error, pickle.UnpicklingError) and error.__context__ else error
    return str(cause).strip().partition("\n")[0].rstrip(".") or type(cause).__name__


def tensor_problem(values: Iterable[object]) -> str:
    """What makes tensors larger than the numbers that their file holds; empty for nothing. Completes "it ...".

    A tensor may claim any shape with a step of 0: no memory is taken before it is copied.
    """
    for value in values:
        if not isinstance(value, Tensor):
            continue
        if value.layout is not torch.strided or value.device.type != "cpu" or value.is_quantized:
            return f"has a tensor that is {value.layout}, quantized or without numbers"
        if value.numel() * value.element_size() > value.untyped_storage().nbytes():
            return f"has a tensor of shape {tuple(value.shape)}, whose numbers it does not hold"
    return ""
