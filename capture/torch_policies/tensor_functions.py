"""What following tensors needs: what functions of torch do to them, and a table of what is known of some."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from vla_attention.capture.torch_policies.softmax_axes import Axes

#: Functions whose result has the same axes and the same numbers, up to rounding.
COPIES = {
    Tensor.to, Tensor.type, Tensor.type_as, Tensor.float, Tensor.half, Tensor.bfloat16, Tensor.double,
    Tensor.contiguous, Tensor.clone, torch.clone, Tensor.detach, torch.detach, Tensor.cpu, Tensor.cuda,
    Tensor.requires_grad_,
}  # fmt: skip
DROPOUTS = {torch.nn.functional.dropout, torch.dropout, torch.dropout_}
PRODUCTS = {torch.mul, Tensor.mul, Tensor.mul_, Tensor.__mul__, Tensor.__rmul__, Tensor.__imul__}
QUOTIENTS = {torch.div, Tensor.div, Tensor.div_, Tensor.__truediv__, Tensor.__itruediv__}
SUMS = {torch.add, Tensor.add, Tensor.add_, Tensor.__add__, Tensor.__radd__, Tensor.__iadd__}
#: Functions whose result has the same axes, and numbers that can differ.
CHANGES = {
    *DROPOUTS, *PRODUCTS, *QUOTIENTS, *SUMS, torch.nan_to_num, Tensor.nan_to_num, Tensor.nan_to_num_,
    Tensor.masked_fill, Tensor.masked_fill_, torch.masked_fill,
    torch.where, Tensor.where, torch.clamp, Tensor.clamp, Tensor.clamp_,
}  # fmt: skip
SWAPS = {
    torch.transpose, Tensor.transpose, torch.swapaxes, Tensor.swapaxes, torch.swapdims, Tensor.swapdims,
}  # fmt: skip
PERMUTES = {torch.permute, Tensor.permute}
MATRIX_TRANSPOSES = {Tensor.mT.__get__, Tensor.mH.__get__}  # type: ignore[attr-defined]
FOLDS = {
    Tensor.view, Tensor.reshape, torch.reshape, Tensor.flatten, torch.flatten, Tensor.unflatten, torch.unflatten,
    Tensor.squeeze, torch.squeeze, Tensor.unsqueeze, torch.unsqueeze, Tensor.view_as, Tensor.reshape_as,
}  # fmt: skip
#: Functions whose result has the same numbers, in another order of axes.
SAME_NUMBERS = {*COPIES, *SWAPS, *PERMUTES, *MATRIX_TRANSPOSES, *FOLDS}


def no_dropout(function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> bool:
    """Return whether a call is a dropout that takes nothing away."""
    if function not in DROPOUTS:
        return False
    rate, training = dict(enumerate(args)).get(1, kwargs.get("p", 0.5)), dict(enumerate(args)).get(2)
    if training is None:
        training = kwargs.get("training", kwargs.get("train", True))
    return not training or rate == 0


def axes_after(
    function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any], axes: Axes, result: Tensor
) -> Axes | None:
    """Return the axes of what one of `SAME_NUMBERS` made of a tensor, None if they cannot be told.

    axes: of the tensor, the function's first argument.
    """
    count = len(axes.parts)
    if function in COPIES:
        return axes if result.ndim == count else None
    if function in FOLDS:
        return axes.refolded(result.shape)
    if function in PERMUTES:
        positions = args[1:] or tuple(place for place in kwargs.values() if not isinstance(place, Tensor))
        return axes.permuted(positions if isinstance(positions[0], int) else positions[0])
    order = list(range(count))
    if function in MATRIX_TRANSPOSES:
        first, second = -2, -1
    else:
        first, second = [place for place in (*args[1:], *kwargs.values()) if not isinstance(place, Tensor)][:2]
    order[first], order[second] = order[second], order[first]
    return axes.permuted(order)


def tensors_among(values: Iterable[Any]) -> Iterator[Tensor]:
    """Yield the tensors among values, those in lists and tuples too."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from tensors_among(value)


_Known = TypeVar("_Known")


class TensorTable(Generic[_Known]):
    """What is known of some tensors, as long as they live; it does not keep them alive.

    entries: by the tensors' ids. Whether it is empty costs less to ask than whether the table is.
    """

    def __init__(self) -> None:
        self.entries: dict[int, tuple[weakref.ref[Tensor], _Known]] = {}

    def __bool__(self) -> bool:
        return bool(self.entries)

    def get(self, tensor: object) -> _Known | None:
        """Return what is known of a tensor."""
        entry = self.entries.get(id(tensor))
        return None if entry is None or entry[0]() is not tensor else entry[1]

    def put(self, tensor: Tensor, known: _Known) -> None:
        """Note what is known of a tensor."""
        number, entries = id(tensor), self.entries

        def forget(gone: weakref.ref[Tensor]) -> None:
            entry = entries.get(number)
            if entry is not None and entry[0] is gone:
                del entries[number]

        entries[number] = weakref.ref(tensor, forget), known

    def drop(self, tensor: Tensor) -> None:
        """Forget a tensor."""
        self.entries.pop(id(tensor), None)

    def tensors(self) -> list[Tensor]:
        """Return the tensors of which anything is known."""
        return [tensor for reference, _ in self.entries.values() if (tensor := reference()) is not None]

    def sharing(self, tensor: Tensor) -> list[Tensor]:
        """Return the tensors of which anything is known that have the storage of another one."""
        storage = tensor.untyped_storage().data_ptr()
        return [known for known in self.tensors() if known.untyped_storage().data_ptr() == storage]

    def keep(self, wanted: Callable[[_Known], bool]) -> None:
        """Forget the tensors of which something else is known."""
        for number in [number for number, (_, known) in self.entries.items() if not wanted(known)]:
            del self.entries[number]
