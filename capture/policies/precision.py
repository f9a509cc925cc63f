"""Precisions that a model can run in, by their names on the command line and in checkpoints."""

from __future__ import annotations

import torch

from vla_attention.schemas.errors import BadArgument, listing

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def find_dtype(name: str) -> torch.dtype:
    """Return the precision of that name; `BadArgument` lists the names."""
    if name not in DTYPES:
        raise BadArgument(f"Cannot use --dtype '{name}'; expected {listing(DTYPES)}.")
    return DTYPES[name]


def dtype_name(dtype: torch.dtype) -> str:
    """Return the name of a precision, for instance `float32`."""
    return str(dtype).removeprefix("torch.")
