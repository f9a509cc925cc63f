"""Products by hand: which axes of the operands are the batch's, the heads', queries', keys' and channels'."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from vla_attention.capture.torch_policies.tensor_table import tensors_among

PRODUCTS = {
    torch.matmul, torch.bmm, Tensor.matmul, Tensor.bmm, Tensor.__matmul__, Tensor.__rmatmul__, torch.linalg.matmul,
    torch.ops.aten.matmul, torch.ops.aten.matmul.default, torch.ops.aten.bmm, torch.ops.aten.bmm.default, torch.einsum,
}  # fmt: skip


def operands_of(
    function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> tuple[list[Tensor], tuple[str, str, str] | None]:
    """Return the operands of a product, and its letters (see `_letters`); None where they cannot be told."""
    operands = list(tensors_among((*args, *kwargs.values())))
    if function is Tensor.__rmatmul__:
        operands.reverse()
    if len(operands) != 2:
        return operands, None
    return operands, _letters(args[0] if function is torch.einsum else None, operands[0].ndim, operands[1].ndim)


@dataclass(frozen=True)
class Product:
    """Which axes of a product are what.

    Attributes:
        rows: the axes of the probabilities in the order *batch, *heads, query, key.
        num_batch: how many of them are the batch.
        values: the axes of the values in the order *batch, *heads, key, dim; -1 for those that they lack.
        num_lead_of_values: how many of batch and heads, from the first, the values have; other heads share them.
        output: the order in which the output has *batch, *heads, query, dim.
    """

    rows: tuple[int, ...]
    num_batch: int
    values: tuple[int, ...]
    num_lead_of_values: int
    output: tuple[int, ...]

    def values_of(self, values: Tensor, rows: Tensor) -> Tensor:
        """Return the values, (*batch, *heads that they have, key, dim)."""
        ordered = values.permute([axis for axis in self.values if axis >= 0])
        for position, axis in enumerate(self.values):
            ordered = ordered if axis >= 0 else ordered.unsqueeze(position)
        count = self.num_lead_of_values
        return ordered.expand(*rows.shape[:count], *ordered.shape[count:])


# A policy makes the same few products hundreds of times in a call.
@lru_cache(maxsize=1024)
def find_product(
    letters: str, value_letters: str, output_letters: str, shape: tuple[int, ...], value_shape: tuple[int, ...]
) -> Product | None:
    """Read a product in the notation of einsum: the probabilities' letters, the values' and the output's.

    Returns None for a product that is no attention: it does not sum over one axis, sums over something else, or its
    values are the same for every batch row, head and query, as class embeddings are.
    """
    keys = [letter for letter in letters if letter in value_letters and letter not in output_letters]
    dims = [letter for letter in value_letters if letter not in letters]
    if len(keys) != 1 or len(dims) != 1 or len(set(letters)) != len(letters):
        return None
    if set(output_letters) != (set(letters) | set(dims)) - set(keys) or (len(value_shape) == 2 and len(shape) > 2):
        return None
    size, value_size = dict(zip(letters, shape, strict=True)), dict(zip(value_letters, value_shape, strict=True))
    # Letters of size 1 in the values are broadcast: these axes share the values.
    held = {letter for letter in value_letters if letter in size and value_size[letter] == size[letter]}
    free = [letter for letter in letters if letter not in held]
    if not free or any(value_size[letter] not in (1, size[letter]) for letter in value_letters if letter in size):
        return None
    query = free[-1]
    lead = [letter for letter in letters if letter not in (query, keys[0])]
    if lead and lead[0] in free and any(letters.index(letter) > letters.index(query) for letter in held - set(keys)):
        # The same for every batch row and another one for each query: a table of relative positions, not values.
        return None
    shared = [letter in held for letter in lead]
    # The first axis is the batch; a third one that values lack is grouped heads. Heads share values if those that the
    # values lack are the last axes; else every head is given its values.
    num_batch = min(1, len(lead)) if len(lead) < 3 or not shared[-1] else len(lead) - 1
    first_free = shared.index(False) if False in shared else len(lead)
    if any(shared[first_free:]) or first_free < num_batch:
        first_free = len(lead)
    return Product(
        rows=tuple(letters.index(letter) for letter in (*lead, query, keys[0])),
        num_batch=num_batch,
        values=tuple(value_letters.find(letter) for letter in (*lead, keys[0], dims[0])),
        num_lead_of_values=first_free,
        output=tuple([*lead, query, dims[0]].index(letter) for letter in output_letters),
    )


@lru_cache(maxsize=1024)
def _letters(equation: str | None, first: int, second: int) -> tuple[str, str, str] | None:
    """Return the letters of both operands and of the result; of a matmul (equation None) as einsum would write it."""
    spare = [chr(number) for number in range(0x3B1, 0x3B1 + 24)]
    if equation is None:
        if min(first, second) < 2:
            return None
        batch = "".join(spare[: max(first, second) - 2])
        return f"{batch[len(batch) - first + 2 :]}mk", f"{batch[len(batch) - second + 2 :]}kn", f"{batch}mn"
    inputs, arrow, out = equation.replace(" ", "").partition("->")
    operands = inputs.split(",")
    if len(operands) != 2:
        return None
    if not arrow:
        once = sorted(letter for letter in set(inputs) - {",", "."} if inputs.count(letter) == 1)
        out = ("..." if "..." in inputs else "") + "".join(once)
    rest = [ndim - len(operand.replace("...", "")) for ndim, operand in zip((first, second), operands, strict=True)]
    dots = ["".join(spare[max(rest) - count : max(rest)]) for count in rest]
    written = [operand.replace("...", dot) for operand, dot in zip(operands, dots, strict=True)]
    return written[0], written[1], out.replace("...", "".join(spare[: max(rest)]))
