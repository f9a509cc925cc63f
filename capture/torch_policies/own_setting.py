"""The difference between a policy call as its user makes it and as it is recorded.

Recording runs compiled code eager and switches the fast path of `nn.MultiheadAttention` off: actions may then differ
in their last digits from those of the user's own setting. A call is made both ways, with the same random numbers.

The same call shows whether rows of a batch are what they are taken for: heads may be folded outside of the batch into
one axis. Where a kernel is given (batch · head, query, dim), nothing in the shapes tells which of the two is the outer
axis. The attention of one row is changed, and the actions of the others must stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.torch_policies.attention_calls import AttentionCall, CallShape
from vla_attention.capture.torch_policies.call_order import CallOrder, KnownCalls
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.capture.torch_policies.watch import RandomNumbers, watch_attention
from vla_attention.schemas.errors import BadArgument


class CannotCompare(BadArgument):
    """A call whose results cannot be compared."""


@dataclass(frozen=True)
class OwnSettingDifference:
    """How far the results of a call are apart: the largest difference, and the largest number of the user's setting."""

    largest_difference: float
    largest_result: float

    def __str__(self) -> str:
        if self.largest_difference == 0:
            return "none (bit-equal)"
        return f"at most {self.largest_difference:.3g}, where the largest number is {self.largest_result:.3g}"


class _Silent:
    """A watcher that keeps nothing; it counts."""

    count = 0

    def change(self, shape: CallShape) -> None:
        return None

    def saw(self, call: AttentionCall) -> None:
        self.count += 1


def difference_to_own_setting(policy: object, call: Callable[[], Any]) -> OwnSettingDifference:
    """Make a policy call in the user's own setting and as it is recorded, and return the difference of the results.

    call: can be repeated; it returns the actions, as a tensor or an array, or several in lists or dictionaries. The
    states of torch's random numbers are as before the first call afterwards.

    Raises:
        CannotCompare: the call returns no numbers, another number of them the second time, or makes no attention call.
    """
    random, watcher = RandomNumbers(), _Silent()
    try:
        plain = arrays_of(call())
        random.again()
        with watch_attention(policy, watcher):
            recorded = arrays_of(call())
    finally:
        random.again()
    if not watcher.count:
        raise CannotCompare(
            "The call given as own_setting made no attention call when it was repeated: a policy that answers from a "
            "queue must be reset in it, as lambda: (policy.reset(), policy.select_action(batch))[1]."
        )
    if not plain or [values.shape for values in plain] != [values.shape for values in recorded]:
        raise CannotCompare(
            f"The call given as own_setting returned arrays of the shapes {[values.shape for values in plain]}, and "
            f"{[values.shape for values in recorded]} when it was repeated; it must return the actions, and always as "
            "many."
        )
    differences = [np.abs(a - b).max(initial=0) for a, b in zip(plain, recorded, strict=True)]
    if any(math.isnan(value) for value in differences):
        raise CannotCompare("The call given as own_setting returned NaN.")
    return OwnSettingDifference(float(max(differences)), float(max(np.abs(values).max(initial=0) for values in plain)))


def arrays_of(result: Any) -> list[NDArray[np.float64]]:
    """Return the arrays of a policy call's result, as float64, in their order."""
    if isinstance(result, torch.Tensor):
        return [result.detach().double().cpu().numpy()]
    if isinstance(result, np.ndarray):
        return [result.astype(np.float64)]
    if isinstance(result, (list, tuple)) and result and all(isinstance(value, (int, float)) for value in result):
        return [np.array(result, dtype=np.float64)]
    inside = result.values() if isinstance(result, Mapping) else result if isinstance(result, (list, tuple)) else ()
    return [array for value in inside for array in arrays_of(value)]


#: The weight of the last key of a changed row, as a factor; the first key's stays, those between follow.
_LOWEST_FACTOR = 0.05
#: Largest change of the other rows' actions, relative to that of the changed row's. Other kernels are no reason: both
#: calls are made with a mask.
_TOLERANCE = 1e-3


class BatchRowsMixed(BadArgument):
    """A policy whose rows of a batch are not apart in its attention calls."""


class _RowChanged:
    """A watcher that changes the calls of the layout's sites in the first row of their batch.

    factor: that of the last key's weight; 1 for a change that changes nothing.
    """

    def __init__(self, layout: PolicyLayout, policy: str, factor: float) -> None:
        self.batches: set[int] = set()
        self._order = CallOrder(KnownCalls(layout), policy)
        self._factor = factor

    def change(self, shape: CallShape) -> Tensor | None:
        place = self._order.place(shape)
        if place is None or place.site is None:
            return None
        added = torch.zeros(shape.batch, 1, 1, shape.keys)
        added[0] = torch.linspace(0, float(np.log(self._factor)), shape.keys)
        return added

    def saw(self, call: AttentionCall) -> None:
        place = self._order.place(call.shape)
        self._order.ran(call.shape, place)
        if place is not None and place.site is not None:
            self.batches.add(call.shape.batch)


def rows_apart(policy: object, layout: PolicyLayout, call: Callable[[], Any]) -> str:
    """Make a policy call of several rows twice, the second time with the first row changed; return what was found.

    call: can be repeated; those of the arrays that it returns which are actions begin with the batch. The states of
    torch's random numbers are as before the first call afterwards.

    Raises:
        BatchRowsMixed: the change of the first row changed the actions of another.
    """
    random, results = RandomNumbers(), []
    for factor in (1.0, _LOWEST_FACTOR):
        watcher = _RowChanged(layout, type(policy).__name__, factor)
        try:
            with watch_attention(policy, watcher):
                results.append(arrays_of(call()))
        except ChangeRefused as error:
            return f"not known ({error})"
        finally:
            random.again()
        batch = max(watcher.batches, default=1)
        if batch == 1:
            return "one"
    pairs = [
        (unchanged, changed)
        for unchanged, changed in zip(*results, strict=False)
        if unchanged.ndim and len(unchanged) == batch and unchanged.shape == changed.shape
    ]
    moved = [np.abs(unchanged - changed).reshape(batch, -1).max(axis=1, initial=0) for unchanged, changed in pairs]
    if len(watcher.batches) > 1 or not moved or not (first_moved := max(rows[0] for rows in moved)) > 0:
        return "not known (the call returns no actions by row, or they do not change)"
    others = max(rows[1:].max() for rows in moved)
    if others > _TOLERANCE * first_moved:
        raise BatchRowsMixed(
            f"The rows of a batch of {batch} are not apart: a change of the attention of row 0 changed the actions of "
            f"other rows by {others:.2g} (its own by {first_moved:.2g}). Where a policy folds heads and batch into one "
            "axis, the heads may be outside, and then a batch cannot be taken apart: record one environment at a time, "
            "with run.episode, and give own_setting a call of one row."
        )
    return f"apart ({batch} rows)"
