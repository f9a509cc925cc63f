"""What a policy call that the user can repeat tells of a recording, before it begins.

Recording runs compiled code eager and switches the fast path of `nn.MultiheadAttention` off: actions may then differ in
their last digits from those of the user's own setting. The call is made both ways, with the same random numbers.

Where a kernel is given (batch · head, query, dim), nothing in the shapes tells which of the two is the outer axis: with
the heads outside, rows of one environment would be stored as another's. Recorded calls tell it by what each row adds to
the residual stream (`replan_contributions.py`). Here the attention of the first row alone is changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.policies.random_numbers import RandomNumbers
from vla_attention.capture.torch_policies.attention_calls import AttentionCall, CallShape
from vla_attention.capture.torch_policies.call_order import CallOrder, CallPlace, KnownCalls
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, RecordedSite
from vla_attention.capture.torch_policies.watch import watch_attention
from vla_attention.schemas.errors import BadArgument

#: The weight of the last key of a changed row, as a factor; the first key's stays, those between follow.
_LOWEST_FACTOR = 0.05
#: Largest change of the other rows' actions, relative to that of the changed row's. Other kernels are no reason: both
#: calls are made with a mask.
_TOLERANCE = 1e-3


class CannotCompare(BadArgument):
    """A call whose results cannot be compared."""


class BatchRowsMixed(BadArgument):
    """A policy whose rows of a batch are not apart in its attention calls."""


class _RowChanged(CallOrder):
    """A watcher that changes the calls of the layout's sites in the first row of their batch.

    factor: that of the last key's weight; 1 for a change that changes nothing, None for none.
    """

    def __init__(self, layout: PolicyLayout, factor: float | None) -> None:
        super().__init__(KnownCalls(layout), "")
        self.changes = factor is not None
        self.batches: set[int] = set()
        self._factor = factor or 1.0

    def change(self, shape: CallShape) -> Tensor | None:
        place = self.place(shape)
        if place is None or place.site is None:
            return None
        added = torch.zeros(shape.batch, 1, 1, shape.keys)
        added[0] = torch.linspace(0, float(np.log(self._factor)), shape.keys)
        return added

    def wanted(self, place: CallPlace) -> bool:
        return True

    def take(self, call: AttentionCall, place: CallPlace, site: RecordedSite) -> None:
        self.batches.add(call.shape.batch)


def facts_of_own_setting(policy: object, layout: PolicyLayout, call: Callable[[], Any]) -> dict[str, str]:
    """Return how far actions are from the user's own setting, and whether rows of a batch are apart, for the store.

    call: can be repeated; it returns the actions, as a tensor or an array, or several in lists or dictionaries, whose
    first axis is the batch. The states of torch's random numbers are as before the first call afterwards.

    Raises:
        CannotCompare: the call returns no numbers, another number of them the second time, or makes no attention call.
        BatchRowsMixed: the change of the first row changed the actions of another.
    """
    random = RandomNumbers()

    def again(factor: float | None) -> tuple[list[NDArray[np.float64]], _RowChanged]:
        random.again()
        watcher = _RowChanged(layout, factor)
        with watch_attention(policy, watcher):
            return _arrays_of(call()), watcher

    apart = "one"
    try:
        plain = _arrays_of(call())
        recorded, watcher = again(None)
        difference = _difference(plain, recorded, watcher)
        if max(watcher.batches, default=1) > 1:
            apart = _rows_apart(again(1.0)[0], again(_LOWEST_FACTOR)[0], watcher.batches)
    except ChangeRefused as error:
        apart = f"not known ({error})"
    finally:
        random.again()
    return {"difference to own setting": difference, "rows of the batch of own setting": apart}


def _difference(plain: list[NDArray[np.float64]], recorded: list[NDArray[np.float64]], watcher: _RowChanged) -> str:
    if not watcher.ran:
        raise CannotCompare(
            "The call given as own_setting made no attention call when it was repeated: a policy that answers from a "
            "queue must be reset in it, as lambda: (policy.reset(), policy.select_action(batch))[1]."
        )
    shapes, again = ([values.shape for values in arrays] for arrays in (plain, recorded))
    if not plain or shapes != again:
        raise CannotCompare(
            f"The call given as own_setting returned arrays of the shapes {shapes}, and {again} when it was repeated; "
            "it must return the actions, and always as many."
        )
    difference = np.max([np.abs(a - b).max(initial=0) for a, b in zip(plain, recorded, strict=True)])
    if np.isnan(difference):
        raise CannotCompare("The call given as own_setting returned NaN.")
    largest = max(np.abs(values).max(initial=0) for values in plain)
    return f"at most {difference:.3g}, where the largest number is {largest:.3g}" if difference else "none (bit-equal)"


def _rows_apart(unchanged: list[NDArray[np.float64]], changed: list[NDArray[np.float64]], batches: set[int]) -> str:
    """Say whether the rows of a batch are apart: what a change of the first row's attention changed, by array."""
    batch = max(batches)
    moved = [
        np.abs(before - after).reshape(batch, -1).max(axis=1, initial=0)
        for before, after in zip(unchanged, changed, strict=False)
        if before.ndim and len(before) == batch and before.shape == after.shape
    ]
    if len(batches) > 1 or not moved or not (first_moved := max(rows[0] for rows in moved)) > 0:
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


def _arrays_of(result: Any) -> list[NDArray[np.float64]]:
    """Return the arrays of a policy call's result, as float64, in their order."""
    if isinstance(result, torch.Tensor):
        return [result.detach().double().cpu().numpy()]
    if isinstance(result, np.ndarray):
        return [result.astype(np.float64)]
    if isinstance(result, (list, tuple)) and result and all(isinstance(value, (int, float)) for value in result):
        return [np.array(result, dtype=np.float64)]
    inside = result.values() if isinstance(result, Mapping) else result if isinstance(result, (list, tuple)) else ()
    return [array for value in inside for array in _arrays_of(value)]
