"""Which axis is which, from a softmax to the product with the values.

The result of a softmax over (batch, head, query, key), or over fewer or more axes before the key, is often transposed,
folded and cast before it meets the values. `Axes` follows it: every axis of a tensor is made of axes of the softmax,
which are numbered in their order. `find_product` reads from a product which of them are batch, heads and query.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

from torch import Tensor

#: Of an axis that no axis of the softmax is in: the values' dim.
_DIM = -1


@dataclass(frozen=True)
class Axes:
    """How the axes of a tensor are made of the axes of a softmax.

    Attributes:
        sizes: of the softmax's axes; the last one is the key.
        parts: for every axis of the tensor, the softmax's axes that are folded into it, the outermost first.
    """

    sizes: tuple[int, ...]
    parts: tuple[tuple[int, ...], ...]

    @property
    def key(self) -> int:
        """The number of the key axis."""
        return len(self.sizes) - 1

    def permuted(self, order: Sequence[int]) -> Axes:
        """Return the axes in another order."""
        return replace(self, parts=tuple(self.parts[axis] for axis in order))

    def refolded(self, shape: Sequence[int]) -> Axes | None:
        """Return the axes after a reshape, or None if one of the tensor's axes has no whole axes of the softmax in it.

        An axis of the softmax that the reshape divides, as heads into groups, becomes two.
        """
        left = [axis for part in self.parts for axis in part]
        parts = []
        for size in shape:
            taken: list[int] = []
            product = 1
            # An axis of size 1 is taken where one is wanted, and where it stands before a wanted one.
            while left and (product < size or (size == 1 and not taken and self.sizes[left[0]] == 1)):
                missing, whole = size // product, self.sizes[left[0]]
                if 1 < missing < whole and product * missing == size and whole % missing == 0 and left[0] != self.key:
                    return self._divided(left[0], missing).refolded(shape)
                taken.append(left.pop(0))
                product *= self.sizes[taken[-1]]
            if product != size:
                return None
            parts.append(tuple(taken))
        if not parts or any(self.sizes[axis] != 1 for axis in left):
            return None
        parts[-1] = (*parts[-1], *left)
        return Axes(self.sizes, tuple(parts))

    def _divided(self, divided: int, outer: int) -> Axes:
        """Return the same axes with one of the softmax's divided into `outer` and the rest."""
        sizes = (*self.sizes[:divided], outer, self.sizes[divided] // outer, *self.sizes[divided + 1 :])
        numbers: dict[int, tuple[int, ...]] = {axis: (axis + (axis > divided),) for axis in range(len(self.sizes))}
        numbers[divided] = (divided, divided + 1)
        return Axes(sizes, tuple(tuple(new for axis in part for new in numbers[axis]) for part in self.parts))

    def with_keys(self, keys: int) -> Axes:
        """Return the axes after some keys were cut off."""
        return replace(self, sizes=(*self.sizes[:-1], keys))

    def key_position(self) -> int | None:
        """Return which axis of the tensor is the key, None if it is folded with another one."""
        for position, part in enumerate(self.parts):
            if self.key in part:
                alone = all(self.sizes[axis] == 1 for axis in part if axis != self.key)
                return position if alone else None
        return None


@dataclass(frozen=True)
class Product:
    """A product of probabilities with values, and which axes of the softmax are what.

    Attributes:
        axes: of the probabilities as they are multiplied.
        batch, heads: axes of the softmax that are batch rows and heads, the outermost first.
        query: the axis of the softmax that is the query.
        shared: how many of `heads`, from the first, the values have; heads of the others share their values.
        values, output: axes of the two tensors, made of axes of the softmax and of -1, the values' dim.
    """

    axes: Axes
    batch: tuple[int, ...]
    heads: tuple[int, ...]
    query: int
    shared: int
    values: tuple[tuple[int, ...], ...]
    output: tuple[tuple[int, ...], ...]

    def size(self, axes: Sequence[int]) -> int:
        """Return the product of the sizes of axes of the softmax."""
        return math.prod(self.axes.sizes[axis] for axis in axes)

    @cached_property
    def sizes(self) -> tuple[int, int, int, int, int]:
        """Batch, heads, kv_heads, queries, keys."""
        kv_heads = self.size(self.heads[: self.shared])
        return self.size(self.batch), self.size(self.heads), kv_heads, self.size((self.query,)), self.axes.sizes[-1]

    def rows_of(self, probabilities: Tensor) -> Tensor:
        """Return the probabilities of the product as (*batch, *heads, query, key)."""
        order = (*self.batch, *self.heads, self.query, self.axes.key)
        return in_order(probabilities, self.axes.parts, order, self.axes.sizes)

    def values_of(self, values: Tensor) -> Tensor:
        """Return (batch, kv_head, key, dim)."""
        heads = self.heads[: self.shared]
        ordered = in_order(values, self.values, (*self.batch, *heads, self.axes.key, _DIM), self.axes.sizes)
        ordered = ordered.expand(*(self.axes.sizes[axis] for axis in (*self.batch, *heads)), *ordered.shape[-2:])
        return ordered.reshape(self.size(self.batch), self.size(heads), *ordered.shape[-2:])

    def output_of(self, output: Tensor) -> Tensor:
        """Return (batch, head, query, dim)."""
        ordered = in_order(output, self.output, (*self.batch, *self.heads, self.query, _DIM), self.axes.sizes)
        return ordered.reshape(self.size(self.batch), self.size(self.heads), *ordered.shape[-2:])


# A policy makes the same few products hundreds of times in a call.
@lru_cache(maxsize=1024)
def find_product(
    axes: Axes, letters: str, value_letters: str, output_letters: str, value_shape: tuple[int, ...]
) -> Product | None:
    """Read a product in the notation of einsum: the probabilities' letters, the values' and the output's.

    Returns None for a product that is no attention: it does not sum over the key, sums over something else, or its
    values are the same for every batch row, head and query, as class embeddings are.
    """
    position = axes.key_position()
    if position is None or len(letters) != len(axes.parts) or len(value_letters) != len(value_shape):
        return None
    key = letters[position]
    extra = [letter for letter in value_letters if letter not in letters]
    if (
        key not in value_letters or key in output_letters or len(extra) != 1 or extra[0] not in output_letters
        or len(set(letters)) != len(letters) or set(output_letters) != (set(letters) | set(extra)) - {key}
    ):  # fmt: skip
        return None
    part_of = dict(zip(letters, axes.parts, strict=True))
    part_of[extra[0]] = (_DIM,)
    part_of[key] = (axes.key,)
    # Letters of size 1 in the values are broadcast: these axes share the values.
    held = set()
    for letter, size in zip(value_letters, value_shape, strict=True):
        full = math.prod(axes.sizes[axis] for axis in part_of[letter] if axis != _DIM)
        if letter == extra[0] or size == full:
            held.add(letter)
        elif size != 1:
            return None
    order = range(axes.key)
    shared = {axis for letter in held if letter in letters and letter != key for axis in part_of[letter]}
    placed = {axis for letter in letters if letter != key for axis in part_of[letter]}
    hidden = {axis for axis in axes.parts[position] if axis != axes.key}
    # A query axis of size 1 may be folded into the key's.
    free = [axis for axis in order if (axis in placed and axis not in shared) or axis in hidden]
    if not free or (len(value_shape) == 2 and len(axes.parts) > 2):
        return None
    query = free[-1]
    if 0 in free and any(axis > query for axis in shared):
        # The same for every batch row and another one for each query: a table of relative positions, not values.
        return None
    lead = [axis for axis in order if axis != query]
    batch, heads = _batch_and_heads(lead, free)
    # Neighbouring heads share values (grouped queries) if the heads that the values lack are the last axes. In another
    # order there is no (batch, kv_head, key, dim): then every head is given its values.
    first_free = next((number for number, axis in enumerate(heads) if axis in free), len(heads))
    if any(axis not in free for axis in heads[first_free:]):
        first_free = len(heads)
    return Product(
        axes=axes, batch=batch, heads=heads, query=query, shared=first_free,
        values=tuple(part_of[letter] if letter in held else () for letter in value_letters),
        output=tuple(part_of[letter] for letter in output_letters),
    )  # fmt: skip


def _batch_and_heads(lead: Sequence[int], free: Sequence[int]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Divide the axes before the query: the first is the batch; a third one that values lack is grouped heads."""
    if len(lead) == 2 or lead[-1] in free:
        return (lead[0],), tuple(lead[1:])
    return tuple(lead[:-1]), (lead[-1],)


def in_order(tensor: Tensor, parts: Sequence[Sequence[int]], order: Sequence[int], sizes: Sequence[int]) -> Tensor:
    """Take folded axes apart and bring the softmax's axes into an order; axes that the tensor lacks have size 1."""
    axes: list[int] = []
    shape: list[int] = []
    for size, part in zip(tensor.shape, parts, strict=True):
        if len(part) == 1 or not part:
            axes.extend(part or (-2,))
            shape.append(size)
        else:
            axes.extend(part)
            shape.extend(sizes[axis] for axis in part)
    tensor = tensor.reshape(shape)
    # Axes of size 1 that stand for nothing go away.
    for position in reversed([number for number, axis in enumerate(axes) if axis not in order]):
        tensor = tensor.squeeze(position)
        del axes[position]
    for axis in order:
        if axis not in axes:
            tensor = tensor.unsqueeze(-1)
            axes.append(axis)
    return tensor.permute([axes.index(axis) for axis in order])
