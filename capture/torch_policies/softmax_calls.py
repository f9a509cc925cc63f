"""Attention calls by hand: a softmax over the last axis, and a product of its result with the values.

The result of the softmax is followed through casts, dropout, transposes and folds to a `matmul`, `bmm` or `einsum`. A
softmax that meets no values (a classifier, the gate of a mixture of experts) is no attention call.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from vla_attention.capture.torch_policies.attention_calls import (
    MASKED_BELOW,
    AttentionCall,
    CallShape,
    Positions,
    at_positions,
)
from vla_attention.capture.torch_policies.call_tensors import (
    ChangeRefused,
    batch_and_heads,
    check_keys_left,
    fitted_change,
    normalised,
    part,
)
from vla_attention.capture.torch_policies.softmax_axes import Axes, Product, find_product
from vla_attention.capture.torch_policies.tensor_functions import (
    CHANGES,
    SAME_NUMBERS,
    TensorTable,
    axes_after,
    no_dropout,
)
from vla_attention.capture.torch_policies.watched_block import WatchedBlock, Where

#: `torch.nn.functional.softmax` calls the tensor's.
SOFTMAXES: tuple[Callable[..., Any], ...] = (
    torch.softmax, Tensor.softmax, torch.special.softmax, torch._safe_softmax,
    torch.ops.aten.softmax, torch.ops.aten.softmax.int, torch.ops.aten._softmax, torch.ops.aten._softmax.default,
)  # fmt: skip
_MATMULS = {
    torch.matmul, torch.bmm, Tensor.matmul, Tensor.bmm, Tensor.__matmul__, Tensor.__rmatmul__, torch.linalg.matmul,
    torch.ops.aten.matmul, torch.ops.aten.matmul.default, torch.ops.aten.bmm, torch.ops.aten.bmm.default,
}  # fmt: skip


_ORDER_UNKNOWN = (
    "picks its probabilities by an index (as rows[..., order]) before it multiplies them with the values, so that "
    "nothing tells which key, head and row of the batch is where. Slices are followed, and an order that is made after "
    "the product; else give the call a rule without a site"
)
#: Functions whose result has some of the numbers, in an order of its own.
_PICKS = {
    torch.index_select, Tensor.index_select, torch.gather, Tensor.gather, torch.take_along_dim, Tensor.take_along_dim,
    torch.flip, Tensor.flip, torch.roll, Tensor.roll,
}  # fmt: skip


@dataclass
class _Softmax:
    """A softmax whose result has not met values yet.

    Attributes:
        where: the module that ran it.
        shape: of the call, if it is one.
        logits: what it took, before any change; None if the result was written over them.
        result: what it returned. Weak, so that what meets no values is not kept.
        change: logits that the watcher added, (batch or 1, head or 1, query or 1, key or 1).
        written: how often torch had written to logits and result when the softmax returned.
        altered: whether something wrote to the result, or to a tensor that comes from it, afterwards.
    """

    where: Where
    shape: CallShape
    logits: Tensor | None
    result: weakref.ref[Tensor]
    change: Tensor | None
    written: tuple[int, int]
    altered: bool = False


@dataclass(frozen=True)
class _Followed:
    """A tensor that comes from a softmax.

    altered: its numbers are others than the softmax's. picked: they were picked by an index, so that which key, head
    and row of the batch is where is not known.
    """

    softmax: _Softmax
    axes: Axes
    altered: bool
    picked: bool = False


@dataclass(frozen=True)
class SoftmaxTensors:
    """The tensors of a call by hand.

    Attributes:
        softmax: what the call began with.
        product: which axes are what.
        probabilities: as they were multiplied.
        altered: whether they differ from the softmax's result by more than rounding and the order of axes.
        operand, result: the other operand of the product, and its result.
    """

    softmax: _Softmax
    product: Product
    probabilities: Tensor
    altered: bool
    operand: Tensor
    result: Tensor

    @property
    def values(self) -> Tensor:
        """The values (batch, kv_head, key, dim)."""
        return self.product.values_of(self.operand.detach())

    @property
    def outputs(self) -> Tensor:
        """What the product computed, (batch, head, query, dim)."""
        return self.product.output_of(self.result.detach())

    def rows(self, queries: Positions, batch: Positions) -> Tensor:
        """Return float32 probabilities (batch, head, query, key) of these queries."""
        softmax, result = self.softmax, self.softmax.result()
        if not self.altered and result is not None and torch.finfo(result.dtype).bits >= 32:
            return self._part(self._in_order(result.detach()), queries, batch).float()
        if self.altered or softmax.logits is None:
            rows = self._part(self.product.rows_of(self.probabilities.detach()), queries, batch).float()
            if torch.finfo(self.probabilities.dtype).bits >= 32:
                return rows
            sums = rows.sum(dim=-1, keepdim=True)
            return rows / torch.where((sums - 1).abs() < _ROUNDING, sums, 1.0)
        # Rounded to the compute precision, probabilities would not sum to 1.
        logits = self._part(self._in_order(softmax.logits.detach()), queries, batch)
        logits = logits.to(torch.promote_types(logits.dtype, torch.float32))
        return normalised(logits if softmax.change is None else logits + part(softmax.change, queries, batch))

    def allowed(self, queries: Positions) -> Tensor:
        """Return (batch, head or 1, query, key) bool: where the logits are those of no mask.

        Where the logits are gone, a key that has any mass in any head is seen.
        """
        if self.softmax.logits is None or self.softmax.logits.shape[-1] != self.product.axes.sizes[-1]:
            return (self.rows(queries, slice(None)) > 0).any(1, keepdim=True)
        logits = self._part(self._in_order(self.softmax.logits.detach()), queries, slice(None)).float()
        highest = logits.amax(-1, keepdim=True)
        return (logits > highest + MASKED_BELOW) & (highest > MASKED_BELOW)

    def _in_order(self, tensor: Tensor) -> Tensor:
        product, keys = self.product, self.product.axes.key
        return tensor.reshape(*product.axes.sizes[:-1], tensor.shape[-1]).permute(
            *product.batch, *product.heads, product.query, keys
        )

    def _part(self, tensor: Tensor, queries: Positions, batch: Positions) -> Tensor:
        """Take queries and batch rows of (*batch, *heads, query, key)."""
        tensor = at_positions(tensor, tensor.ndim - 2, queries)
        sizes = (self.product.size(self.product.batch), self.product.size(self.product.heads))
        return at_positions(tensor.reshape(*sizes, *tensor.shape[-2:]), 0, batch)


class Softmaxes:
    """Follows the results of softmaxes in one thread to their products with values."""

    def __init__(self, block: WatchedBlock) -> None:
        self._block = block
        self.followed: TensorTable[_Followed] = TensorTable()

    def softmax(self, function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        """Run a softmax, changed if the watcher says so, and follow its result."""
        if not self._may_attend(function, args, kwargs):
            return function(*args, **kwargs)
        name = "self" if "self" in kwargs else "input"
        logits: Tensor = args[0] if args else kwargs[name]
        *lead, queries, keys = logits.shape
        where = self._block.where()
        # Of (batch, kv_head, group, query, key), the heads are both; of one axis, the module tells the heads.
        batch, heads = (lead[0], lead[1] * lead[2]) if len(lead) == 3 else batch_and_heads(lead, where.module)
        shape = self._block.new_shape(where, "softmax", (batch, heads, heads, queries, keys), logits.dtype)
        asked = replace(shape, number=0)
        expected = self._block.expected(asked)
        if expected is not None and self._block.passes(replace(expected, number=shape.number)):
            return function(*args, **kwargs)  # attention that is not wanted need not be followed
        self._block.began_softmax(asked)
        change = self._block.change(shape)
        if change is None:
            result = function(*args, **kwargs)
        else:
            change = fitted_change(change, shape, logits.device)
            # The policy may write over them, and they tell which keys are masked.
            logits = logits.clone()
            changed = logits + change.expand(batch, heads, queries, keys).reshape(logits.shape).to(logits.dtype)
            check_keys_left(
                logits.reshape(batch, heads, queries, keys), changed.reshape(batch, heads, queries, keys), shape
            )
            result = function(changed, *args[1:], **kwargs) if args else function(**{**kwargs, name: changed})
            self._block.changed.append(shape)
        sizes = (batch, heads, queries, keys) if len(lead) == 1 else tuple(logits.shape)
        first = ((0, 1), (2,), (3,)) if len(lead) == 1 else tuple((axis,) for axis in range(len(sizes)))
        overwritten = result.data_ptr() == logits.data_ptr()
        softmax = _Softmax(
            where,
            shape,
            None if overwritten else logits,
            weakref.ref(result),
            change,
            (_times_written(logits), _times_written(result)),
        )
        self.followed.put(result, _Followed(softmax, Axes(sizes, first), altered=False))
        return result

    def follow(self, function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        """Run any other function, and follow what comes of a softmax's result."""
        operands = (*args[:1], *args[1]) if function is torch.einsum and isinstance(args[1], list | tuple) else args
        known = ((tensor, self.followed.get(tensor)) for tensor in (*operands, *kwargs.values()))
        source = next(((tensor, followed) for tensor, followed in known if followed is not None), None)
        result = function(*args, **kwargs)
        if source is None:
            return result
        before, given = source
        if args and args[0] is not None and getattr(function, "__name__", "") in _WRITES:
            written = self.followed.get(args[0])
            if written is not None:
                written.softmax.altered = True
        if function in _MATMULS or function is torch.einsum:
            self._product(function, args, kwargs, result)
        elif isinstance(result, Tensor) and result.ndim:
            axes = _axes_after(function, args, kwargs, before, given.axes, result)
            if axes is not None:
                altered = given.altered or (function not in SAME_NUMBERS and not no_dropout(function, args, kwargs))
                picked = given.picked or _picks(function, args)
                self.followed.put(result, _Followed(given.softmax, axes, altered, picked))
        return result

    def _may_attend(self, function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> bool:
        logits = args[0] if args else kwargs.get("input", kwargs.get("self"))
        axis = args[1] if len(args) > 1 else kwargs.get("dim", kwargs.get("axis"))
        if not isinstance(logits, Tensor) or torch._C._functorch.is_functorch_wrapped_tensor(logits):
            return False
        return 3 <= logits.ndim <= 5 and axis in (-1, logits.ndim - 1)

    def _product(self, function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any], result: Any) -> None:
        if function is torch.einsum:
            equation, *operands = args
            if len(operands) == 1 and isinstance(operands[0], list | tuple):
                operands = list(operands[0])
        else:
            equation, operands = None, [*args, *kwargs.values()][:2]
            if function is Tensor.__rmatmul__:
                operands.reverse()
        if len(operands) != 2 or not all(isinstance(operand, Tensor) for operand in operands):
            return
        letters = _letters(equation, operands[0].ndim, operands[1].ndim)
        if letters is None:
            return
        first, second, out = letters
        for given, values, probability_letters, value_letters in ((0, 1, first, second), (1, 0, second, first)):
            followed = self.followed.get(operands[given])
            if followed is None:
                continue
            product = find_product(
                followed.axes, probability_letters, value_letters, out, tuple(operands[values].shape)
            )
            if product is not None:
                self._saw(followed, product, operands[given], operands[values], result)
                return

    def _saw(
        self, followed: _Followed, product: Product, probabilities: Tensor, values: Tensor, result: Tensor
    ) -> None:
        softmax = followed.softmax
        batch, heads, kv_heads, queries, keys = product.sizes
        before = softmax.shape
        if softmax.change is not None and (batch, heads, queries) != (before.batch, before.heads, before.queries):
            refused = ChangeRefused(
                f"The attention call {before} cannot be changed: its product with the values shows other axes "
                f"(batch {batch}, {heads} heads, {queries} queries) than the softmax. Leave this call out."
            )
            raise self._block.failed(refused)
        shape = before
        if product.sizes != (before.batch, before.heads, before.kv_heads, before.queries, before.keys):
            shape = replace(before, batch=batch, heads=heads, kv_heads=kv_heads, queries=queries, keys=keys)
        if softmax.change is not None:
            self._block.changed.remove(before)
        # Other tensors that come from this softmax need not be followed any more.
        self.followed.keep(lambda other: other.softmax is not softmax)
        # What was written to the result after the softmax is in the rows that meet the values, not in those of the
        # softmax; and logits that were written over do not give its rows again.
        before_logits, before_result = softmax.written
        softmax_result = softmax.result()
        altered = (
            followed.altered
            or softmax.altered
            or (softmax_result is not None and _times_written(softmax_result) != before_result)
        )
        if softmax.logits is not None and _times_written(softmax.logits) != before_logits:
            softmax.logits = None
        self._block.softmax_met_values(before, shape)
        if not self._block.changes and self._block.passes(shape):
            return
        tensors = SoftmaxTensors(softmax, product, probabilities, altered, values, result)
        asked = None if shape == replace(before, kv_heads=kv_heads) else before
        self._block.saw(AttentionCall(shape, tensors, asked, _ORDER_UNKNOWN if followed.picked else ""))


#: Methods that write to their tensor otherwise than those of `CHANGES`.
_WRITES = {"__setitem__", "copy_", "index_fill_", "index_copy_", "scatter_", "masked_scatter_", "zero_", "fill_"}
#: Largest difference of a sum of probabilities from 1 that rounding to bfloat16 leaves, with room.
_ROUNDING = 1e-2


def _axes_after(
    function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any], before: Tensor, axes: Axes, result: Tensor
) -> Axes | None:
    """Return the axes of what a function made of a followed tensor, None if it cannot be followed."""
    if function in CHANGES:
        return axes if result.shape == before.shape else None
    if function in SAME_NUMBERS:
        return axes_after(function, args, kwargs, axes, result)
    if result is before:  # changed in place
        return axes
    if (function is Tensor.__getitem__ or function in _PICKS) and result.ndim == before.ndim:
        # Keys may be cut off, as those of attention sinks are.
        key = axes.key_position()
        same = all(result.shape[axis] == before.shape[axis] for axis in range(before.ndim) if axis != key)
        return axes.with_keys(result.shape[key]) if key is not None and same else None
    return None


def _picks(function: Any, args: tuple[Any, ...]) -> bool:
    """Whether a function's result may have the numbers in another order: slices keep it, other indices may not."""
    if function is not Tensor.__getitem__:
        return function in _PICKS
    index = args[1] if isinstance(args[1], tuple) else (args[1],)
    return not all(part is Ellipsis or isinstance(part, slice) for part in index)


def _times_written(tensor: Tensor) -> int:
    """Return how often torch wrote to a tensor; tensors of inference mode do not count it."""
    return 0 if tensor.is_inference() else tensor._version


@lru_cache(maxsize=1024)
def _letters(equation: str | None, first: int, second: int) -> tuple[str, str, str] | None:
    """Return the letters of both operands and of the result; of a matmul (equation None) as einsum would write it."""
    spare = [chr(number) for number in range(0x3B1, 0x3B1 + 24)]
    if equation is None:
        if min(first, second) < 2:
            return None
        batch = "".join(spare[: max(first, second) - 2])
        first_batch, second_batch = batch[len(batch) - (first - 2) :], batch[len(batch) - (second - 2) :]
        return f"{first_batch}mk", f"{second_batch}kn", f"{batch}mn"
    if not isinstance(equation, str):
        return None
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
