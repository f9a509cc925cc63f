"""Attention calls by hand: a softmax over the last axis, and a product of its result with the values.

What comes of the softmax is followed to a `matmul`, `bmm` or `einsum`, and decided by values there: numbers that are
those of the softmax have its logits, which are exact; others (dropout, gates) are the rows themselves, as they are
multiplied; the softmax's numbers in another order are refused. A softmax that meets no values (a classifier, the gate
of a mixture of experts) is no attention call.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from msgspec import structs
from torch import Tensor, nn

from vla_attention.capture.torch_policies.attention_calls import NO_MASS, AttentionCall, CallShape, exact
from vla_attention.capture.torch_policies.call_tensors import (
    ChangeRefused,
    batch_and_heads,
    check_change,
    fitted_change,
    normalised,
    visible,
)
from vla_attention.capture.torch_policies.output_ways import used_tensors
from vla_attention.capture.torch_policies.products import PRODUCTS, Product, find_product, operands_of
from vla_attention.capture.torch_policies.tensor_table import TensorTable, tensors_among

if TYPE_CHECKING:
    from vla_attention.capture.torch_policies.watch import AttentionMode

#: In the order of what a mode is given, for torch's own functions in Python call the tensor's.
SOFTMAXES: tuple[Callable[..., Any], ...] = (
    torch.nn.functional.softmax, torch.softmax, Tensor.softmax, torch.special.softmax, torch._safe_softmax,
    torch.ops.aten.softmax, torch.ops.aten.softmax.int, torch.ops.aten._softmax, torch.ops.aten._softmax.default,
)  # fmt: skip
SELECTIONS = {
    torch.topk, Tensor.topk, torch.sort, Tensor.sort, torch.argsort, Tensor.argsort, torch.kthvalue, Tensor.kthvalue,
}  # fmt: skip
#: Largest difference of a sum of probabilities from 1 that rounding to bfloat16 leaves, with room.
_ROUNDING = 1e-2
_ORDER_UNKNOWN = (
    "brings the probabilities of its softmax into another order (as rows[..., order]) before it multiplies them with "
    "the values, so that nothing tells which key, head and row of the batch is where. Slices are followed, and an "
    "order that is made after the product; else give the call a rule without a site"
)
_VALUES_BY_QUERY = (
    "gives every query keys and values of its own (as gathered ones), so that no key has a place that a layout can "
    "name. Give the call a rule without a site"
)
_LINEAR_ATTENTION = (
    "is one of two products in a row, as of linear attention: the keys or the queries of this one are channels and no "
    "tokens. Give the call a rule without a site"
)
#: Functions that mix axes or add other things: what they make of a softmax's result are no probabilities.
_ENDS = {
    "linear", "bilinear", "conv1d", "conv2d", "conv3d", "conv_transpose1d", "conv_transpose2d", "conv_transpose3d",
    "mm", "mv", "addmm", "addmv", "addbmm", "baddbmm", "tensordot",
}  # fmt: skip
_SUMS = {"add", "radd", "iadd", "sub", "rsub", "isub", "addcmul", "lerp"}
#: Functions that change the order on an axis, as indices by tensors do too.
_REORDERS = {"index_select", "gather", "take_along_dim", "flip", "fliplr", "flipud", "rot90", "roll"}


@dataclass(frozen=True)
class _Softmax:
    """A softmax whose result has not met values yet.

    logits: what it took; before: the same without the watcher's change. change: that one, (batch or 1, head or 1, query
    or 1, key or 1). reordered: whether what is followed went
    through a function that changes the order of keys, heads or rows. numbers: of this softmax among those of the block,
    and of others in it, as of a mean of two.
    """

    numbers: tuple[int, ...]
    shape: CallShape
    logits: Tensor
    before: Tensor
    change: Tensor | None
    reordered: bool = False


@dataclass(frozen=True)
class _Made:
    """A product of two activations; of an attention call that was taken its shape, and the axis of its queries."""

    call: CallShape | None = None
    queries: int = -1


class Softmaxes:
    """Follows the results of softmaxes in one thread to their products with values."""

    def __init__(self, mode: AttentionMode) -> None:
        self._mode = mode
        self._followed: TensorTable[_Softmax] = TensorTable()
        #: Empty where nothing is followed: every function of the policy comes by here.
        self.entries = self._followed.entries
        #: What else the policy computed of a softmax's result, such as its product with relative positions.
        self._beside: TensorTable[_Softmax] = TensorTable()
        #: Products of two activations, and what was computed of them alone.
        self._products: TensorTable[_Made] = TensorTable()
        #: Softmaxes that were changed and met no values yet.
        self.changed: set[int] = set()
        #: All that met none yet, by their numbers, and the last function of what is followed.
        self.unmet: dict[int, tuple[CallShape, str]] = {}
        self._count = 0
        #: Module and number of keys -> the function that selected some of them.
        self._selected: dict[tuple[str, int], str] = {}

    def softmax(self, function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        """Run a softmax, changed if the watcher says so, and follow its result."""
        logits = args[0] if args else kwargs.get("input", kwargs.get("self"))
        axis = args[1] if len(args) > 1 else kwargs.get("dim", kwargs.get("axis"))
        if not isinstance(logits, Tensor) or torch._C._functorch.is_functorch_wrapped_tensor(logits):
            return function(*args, **kwargs)
        self._mode.refuse_without_numbers(logits)
        if not 3 <= logits.ndim <= 5 or axis not in (-1, logits.ndim - 1):
            return function(*args, **kwargs)
        *lead, queries, keys = logits.shape
        path, module = self._mode.where()
        # Of (batch, kv_head, group, query, key), the heads are both; of one axis, the module tells the heads.
        batch, heads = (lead[0], lead[1] * lead[2]) if len(lead) == 3 else batch_and_heads(lead, module)
        shape = self._mode.new_shape(path, "softmax", (batch, heads, heads, queries, keys), logits.dtype)
        batch, heads = shape.batch, shape.heads
        self._count += 1
        change, given = self._mode.change(shape), logits
        if change is None:
            result = function(*args, **kwargs)
        else:
            change = fitted_change(change, shape, logits.device)
            logits = logits.clone()  # the policy may write over them
            given = logits + change.expand(batch, heads, queries, keys).reshape(logits.shape).to(logits.dtype)
            size = batch, heads, queries, keys
            check_change(logits.reshape(size), given.reshape(size), shape)
            name = "self" if "self" in kwargs else "input"
            result = function(given, *args[1:], **kwargs) if args else function(**{**kwargs, name: given})
            self.changed.add(self._count)
        self.unmet[self._count] = shape, "softmax"
        self._followed.put(result, _Softmax((self._count,), shape, given.detach(), logits.detach(), change))
        return result

    def select(self, function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        """Run a function that selects numbers, which may be scores of keys."""
        result = self.follow(function, args, kwargs)
        for scores in tensors_among((*args, *kwargs.values())):
            if scores.ndim > 2 and scores.is_floating_point():
                self._selected[self._mode.where()[0], scores.shape[-1]] = function.__name__
        return result

    def selects(self, shape: CallShape) -> str:
        """Return the function by which the module of a call, or one in it, selected some of its keys; "" for none."""
        return next(
            (
                function
                for (path, keys), function in self._selected.items()
                if keys == shape.keys and f"{path}.".startswith(f"{shape.module}." if shape.module else "")
            ),
            "",
        )

    def follow(self, function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        """Run any other function, and follow what comes of a softmax's result."""
        result = function(*args, **kwargs)
        name = getattr(function, "__name__", "").strip("_")
        tensors = list(used_tensors(name, args, kwargs))
        for given in tensors:
            softmax = self._followed.get(given)
            if softmax is None:
                continue
            self.unmet.update(dict.fromkeys(self.unmet.keys() & softmax.numbers, (softmax.shape, name)))
            if function in PRODUCTS:
                self._beside.put(result, softmax)
                self._product(function, args, kwargs, given, softmax, result)
            elif isinstance(result, Tensor) and (name in _ENDS or (name in _SUMS and self._adds(tensors, result))):
                self._followed.entries.pop(id(result), None)  # it may be written in place
                self._beside.put(result, softmax)
            elif isinstance(result, Tensor) and result is not given and result.is_floating_point() and result.ndim:
                # Some keys may be cut off, as those of attention sinks are.
                fewer = result.ndim == given.ndim and sum(a != b for a, b in zip(result.shape, given.shape)) == 1  # noqa: B905
                if result.numel() == given.numel() or (fewer and result.numel() < given.numel()):
                    reordered = softmax.reordered or _reorders(name, args)
                    others = [other for tensor in tensors if (other := self._followed.get(tensor)) is not None]
                    numbers = tuple({number for other in others for number in other.numbers})
                    self._followed.put(result, replace(softmax, reordered=reordered, numbers=numbers))
                else:
                    self._beside.put(result, softmax)
            break
        if function in PRODUCTS:
            self._note_product(function, args, kwargs, result)
        elif name not in _ENDS | _SUMS and any(self._products.get(given) for given in tensors):
            for made in tensors_among((result,)):
                self._products.put(made, self._products.get(made) or _Made())
        return result

    def _note_product(self, function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any], result: Tensor) -> None:
        """Note a product of two activations, and refuse the attention call whose queries it sums over."""
        operands, letters = operands_of(function, args, kwargs)
        weights = any(isinstance(operand, nn.Parameter) for operand in operands)
        if letters is None or weights or letters[0][0] != letters[1][0] or letters[0][0] not in letters[2]:
            return
        for place, operand in enumerate(operands):
            made, partner = self._products.get(operand) or _Made(), operands[1 - place]
            if made.call and letters[place][made.queries] not in letters[2] and self._followed.get(partner) is None:
                self._mode.refuse(made.call, _LINEAR_ATTENTION)
        self._products.put(result, self._products.get(result) or _Made())

    def _adds(self, tensors: Sequence[Tensor], result: Tensor) -> bool:
        """Whether a sum adds something as large that comes of no softmax."""
        return any(tensor.numel() == result.numel() and self._followed.get(tensor) is None for tensor in tensors)

    def _product(
        self, function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any], given: Tensor, softmax: _Softmax,
        result: Tensor,
    ) -> None:  # fmt: skip
        operands, letters = operands_of(function, args, kwargs)
        if letters is None:
            return
        place = 0 if operands[0] is given else 1
        value = operands[1 - place]
        product = find_product(
            letters[place], letters[1 - place], letters[2], tuple(given.shape), tuple(value.shape)
        )  # fmt: skip
        if product is None:
            return
        self.changed.difference_update(softmax.numbers)
        for number in softmax.numbers:
            self.unmet.pop(number, None)
        multiplied = given.detach().permute(product.rows)
        sizes, count, dim = _sizes(softmax, product, given), multiplied.shape[-1], value.shape[product.values[-1]]
        sinks = softmax.logits.shape[-1] - count
        if not sinks or given.shape[:-1] != softmax.logits.shape[:-1] or self._mode.sinks(softmax.shape) != sinks:
            sinks = 0
        keys = count + sinks
        kv_heads = math.prod(multiplied.shape[: product.num_lead_of_values]) // sizes[0]
        before = softmax.shape
        shape = structs.replace(
            before, number=self._mode.number, batch=sizes[0], heads=sizes[1], kv_heads=kv_heads, queries=sizes[2],
            keys=keys,
        )  # fmt: skip
        memory = value.untyped_storage().data_ptr()
        linear = any(made.untyped_storage().data_ptr() == memory for made in self._products.tensors(lambda _: True))
        refused = _LINEAR_ATTENTION if linear else ""
        refused = _VALUES_BY_QUERY if kv_heads > sizes[1] else refused
        if softmax.change is not None and (
            refused
            or sizes != (before.batch, before.heads, before.queries)
            or not _is_changed(multiplied, softmax, given, product, softmax.change)
        ):
            raise self._mode.failed(
                ChangeRefused(
                    f"The attention call {before} cannot be changed: it {refused}."
                    if refused
                    else f"The attention call {before} cannot be changed: its product with the values shows other axes "
                    f"(batch {sizes[0]}, {sizes[1]} heads, {sizes[2]} queries) than the softmax, or shows them in "
                    "another order, as (batch, query, head, key). Leave this call out of the change (layers), change "
                    "all heads and queries alike, or compute the softmax over (batch, head, query, key)."
                )
            )
        if self._mode.passes(shape):
            return
        with exact():
            rows, shown, unknown = _decided(multiplied, softmax, given, product, (*sizes, count))
            values = product.values_of(value.detach(), multiplied).reshape(sizes[0], kv_heads, count, dim)
            if sinks:
                left = normalised(_wide(softmax.logits))[..., count:].permute(product.rows)
                rows = torch.cat([rows, left.reshape(*sizes, sinks)], dim=-1)
                values = nn.functional.pad(values, (0, 0, 0, sinks))
            seen = shown if shown.dtype is torch.bool else visible(shown)
            if seen is None:
                seen = rows.new_ones((), dtype=torch.bool).expand(sizes[0], 1, sizes[2], keys)
            elif sinks:
                seen = nn.functional.pad(seen, (0, sinks), value=True)
        back = sorted(range(len(product.output)), key=lambda axis: product.output[axis])
        self._products.put(result, _Made(shape, product.output.index(len(product.rows) - 2)))
        self._mode.saw(
            AttentionCall(
                shape,
                values,
                result.detach().permute(back).reshape(*sizes, dim),
                lambda queries, batch: rows[batch, :, queries],
                lambda queries: seen if queries.indices(sizes[2]) == (0, sizes[2], 1) else seen[:, :, queries],
                lambda mixed: mixed.reshape(*multiplied.shape[:-1], dim).permute(product.output),
                given.dtype,
                None if shape == structs.replace(before, number=shape.number, kv_heads=kv_heads) else before,
                refused or unknown,
            ),
            [
                tensor
                for table in (self._followed, self._beside)
                for tensor in table.tensors(lambda other: getattr(other, "logits", None) is softmax.logits)
            ],
        )


def _reorders(name: str, args: tuple[Any, ...]) -> bool:
    indices = args[1] if name == "getitem" else ()
    indices = indices if isinstance(indices, tuple) else (indices,)
    plain = (int, slice, type(None), type(Ellipsis))
    return name in _REORDERS or not all(isinstance(index, plain) for index in indices)


def _wide(logits: Tensor) -> Tensor:
    return logits.to(torch.promote_types(logits.dtype, torch.float32))


def _rounding(rows: Tensor, softmax: _Softmax) -> float:
    return max(torch.finfo(dtype).eps for dtype in (rows.dtype, softmax.logits.dtype))


def _are_equal(rows: Tensor, expected: Tensor, rounding: float) -> bool:
    """Whether probabilities are the expected ones, up to rounding."""
    beyond = (rows.float() - expected).abs_().sub_(expected, alpha=max(2 * rounding, 1e-4))
    return bool(beyond.amax() <= max(rounding / 100, 1e-6))


def _is_changed(rows: Tensor, softmax: _Softmax, given: Tensor, product: Product, change: Tensor) -> bool:
    """Whether the rows of a product (*lead, query, key) are changed in the cells (batch, head, query, key) of a change.

    Cut cells are 0, and the others what the softmax gives of its logits without them. Where something else than what
    the softmax gave is multiplied, that is looked at for cut cells; factors must be the same in any order of the axes.
    """
    shape, count = softmax.shape, rows.shape[-1]
    with exact():
        if softmax.before.shape[-1] > count:  # sinks are cut off behind the softmax
            before = softmax.before.permute(product.rows)
            changed = before.reshape(shape.batch, shape.heads, shape.queries, -1) + change.to(before.dtype)
            wanted = normalised(_wide(changed))[..., :count].reshape(rows.shape)
            return _are_equal(rows, wanted, _rounding(rows, softmax))
        for arrange in _arrangements(softmax.before, given):
            before = arrange(softmax.before).permute(product.rows)
            changed = before.reshape(shape.batch, shape.heads, shape.queries, -1) + change.to(before.dtype)
            if _are_equal(rows, normalised(_wide(changed)).reshape(rows.shape), _rounding(rows, softmax)):
                return True
        if _arranged(rows, softmax, given, product) is not None:
            return False
        cut = (change == float("-inf")).expand(shape.batch, shape.heads, shape.queries, rows.shape[-1])
        factors = change.masked_fill(change == float("-inf"), 0.0)
        alike = bool((factors == factors[:, :1, :1]).all())
        return alike and not bool(rows.reshape(cut.shape).masked_select(cut).any())


def _arranged(
    rows: Tensor, softmax: _Softmax, given: Tensor, product: Product
) -> tuple[Callable[[Tensor], Tensor], Tensor] | None:
    """Return how the softmax's axes became those of a product, and its probabilities so; None where it is not known."""
    expected = normalised(_wide(softmax.logits))
    for arrange in _arrangements(expected, given):
        arranged = arrange(expected).permute(product.rows)
        if _are_equal(rows, arranged, _rounding(rows, softmax)):
            return arrange, arranged
    return None


def _decided(
    rows: Tensor, softmax: _Softmax, given: Tensor, product: Product, sizes: tuple[int, ...]
) -> tuple[Tensor, Tensor, str]:
    """Return the rows of a product float32, what shows its mask, and why it is refused.

    The mask shows in logits, or is (batch, head, query, key) bool, of keys that are seen.

    rows: the probabilities as they are multiplied, (*lead, query, key). sizes: batch, heads, queries and keys, in which
    rows and logits are returned.
    """
    narrow, rounding = torch.finfo(rows.dtype).bits < 32, _rounding(rows, softmax)
    known = _arranged(rows, softmax, given, product)
    if known is not None:
        arrange, arranged = known
        logits = arrange(softmax.before).permute(product.rows).reshape(sizes)
        # Rounded to the compute precision, probabilities would not sum to 1.
        return (arranged if narrow else rows.float()).reshape(sizes), logits, ""
    # Something else is multiplied than what the softmax gave, or its logits were written over: then a key that has any
    # mass is seen. In float16 nothing tells, for keys that are seen may have none.
    expected = normalised(_wide(softmax.logits))
    half, rows, refused = rows.dtype is torch.float16, rows.float(), ""
    if rows.numel() == expected.numel():
        ours, theirs = (tensor.flatten().sort().values for tensor in (expected, rows))
        same_numbers = torch.allclose(theirs, ours, rtol=max(2 * rounding, 1e-4), atol=rounding / 100)
        refused = _ORDER_UNKNOWN if same_numbers else ""
    refused = _ORDER_UNKNOWN if softmax.reordered else refused
    if narrow:
        sums = rows.sum(dim=-1, keepdim=True)
        rows = rows / torch.where((sums - 1).abs() < _ROUNDING, sums, 1.0)
    rows = rows.reshape(sizes)
    seen = torch.ones_like(rows, dtype=torch.bool)
    if not half:
        seen = (rows > 0) & (rows > NO_MASS).any(dim=1, keepdim=True)
    return rows, seen, refused


def _arrangements(expected: Tensor, given: Tensor) -> list[Callable[[Tensor], Tensor]]:
    """Return how a softmax's (..., query, key) may have become the probabilities of a product, the likely way first."""
    shape, count = given.shape, given.shape[-1]
    if expected.numel() == given.numel():
        ways: list[Callable[[Tensor], Tensor]] = [lambda t: t.reshape(shape), lambda t: t.mT.reshape(shape)]
        return [*ways, lambda t: t.transpose(1, 2).reshape(shape)] if expected.ndim > 3 else ways
    if expected.shape[:-1] == shape[:-1] and count < expected.shape[-1]:  # keys are cut off
        return [lambda t: t[..., :count], lambda t: t[..., -count:]]
    return []


def _sizes(softmax: _Softmax, product: Product, given: Tensor) -> tuple[int, int, int]:
    """Return batch, heads and queries: of the axes of the product, or of the softmax where a reshape stands between."""
    *lead, queries, _ = (given.shape[axis] for axis in product.rows)
    of_product = math.prod(lead[: product.num_batch]), math.prod(lead[product.num_batch :]), queries
    before, shape = softmax.shape, softmax.logits.shape
    of_softmax = before.batch, before.heads, before.queries
    turned = not given.is_contiguous() and given.shape in (
        softmax.logits.mT.shape,
        softmax.logits.transpose(1, 2).shape,
    )
    as_is = given.shape[:-1] == shape[:-1] or turned or len(shape) == 3
    return of_product if math.prod(of_softmax) != math.prod(of_product) or (len(lead) > 1 and as_is) else of_softmax
