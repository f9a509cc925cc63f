"""Whether the rows of a batch are apart in a policy's attention calls.

Where a kernel is given (batch · head, query, dim), nothing in the shapes tells which of the two is the outer axis: with
the heads outside, rows of one environment would be stored as another's. Something is changed in the first row of the
batch alone, and what changes then is looked at: in the module that made the attention call, which is called again with
another first row, and in the actions of a policy call that the user can repeat (`own_setting`).
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from vla_attention.capture.torch_policies.attention_calls import AttentionCall, CallShape
from vla_attention.capture.torch_policies.call_order import CallOrder, KnownCalls
from vla_attention.capture.torch_policies.call_state import CallState
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused
from vla_attention.capture.torch_policies.own_setting import arrays_of
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.capture.torch_policies.policy_modules import FoundPolicy
from vla_attention.capture.torch_policies.watch import RandomNumbers, watch_attention
from vla_attention.schemas.errors import BadArgument


class BatchRowsMixed(BadArgument):
    """A policy whose rows of a batch are not apart in its attention calls."""


#: The arguments of a module's call.
Given = tuple[tuple[Any, ...], dict[str, Any]]


class RunningModules:
    """The modules of a policy that run, and what they were given, the innermost last."""

    def __init__(self, policy: FoundPolicy) -> None:
        self._policy = policy
        self.stack: list[tuple[nn.Module, Given]] = []

    @contextmanager
    def followed(self) -> Iterator[None]:
        """Keep track of them within the block."""

        def begins(module: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
            self.stack.append((module, (args, kwargs)))

        def ends(module: nn.Module, *others: Any) -> None:
            if self.stack and self.stack[-1][0] is module:
                self.stack.pop()

        with ExitStack() as stack:
            for module in self._policy.modules.values():
                for handle in (
                    module.register_forward_pre_hook(begins, with_kwargs=True),
                    module.register_forward_hook(ends, always_call=True),
                ):
                    stack.callback(handle.remove)
            yield


@dataclass(frozen=True)
class ModuleCall:
    """The first recorded call of a batch: its shape, a module that makes it, and a copy of what that was given.

    autocast: the devices under autocast, and their dtypes.
    """

    shape: CallShape
    module: nn.Module
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    autocast: tuple[tuple[str, torch.dtype], ...]

    @classmethod
    def of(cls, shape: CallShape, running: RunningModules) -> ModuleCall | None:
        """Copy what the innermost running module was given that was given tokens, and nothing that has no copy."""
        devices = (device for device in ("cpu", "cuda") if torch.is_autocast_enabled(device))
        autocast = tuple((device, torch.get_autocast_dtype(device)) for device in devices)
        for module, arguments in reversed(running.stack):
            if any(_batch_axis(value, shape.batch) is not None for value in pytree.tree_leaves(arguments)):
                # A lock, a file, a tensor with gradients have no copy: a module around it may not be given them.
                with suppress(Exception):
                    args, kwargs = pytree.tree_map(_copied, arguments)
                    return cls(shape, module, args, kwargs, autocast)
        return None


def _copied(value: Any) -> Any:
    return value.detach().clone() if isinstance(value, Tensor) else copy.deepcopy(value)


class _Rows:
    """A watcher that keeps the rows of the first call of a shape, (batch, head, query, key)."""

    changes = False
    rows: Tensor | None = None

    def __init__(self, shape: CallShape) -> None:
        self._shape = shape

    def change(self, shape: CallShape) -> None:
        return None

    def saw(self, call: AttentionCall) -> None:
        same = (call.shape.module, call.shape.batch, call.shape.heads) == (
            self._shape.module,
            self._shape.batch,
            self._shape.heads,
        )
        if self.rows is None and same:
            self.rows = call.rows(slice(None)).float().cpu()


def rows_of_module_apart(policy: FoundPolicy, call: ModuleCall) -> bool | None:
    """Call a module again, and again with another first row of its batch: whether that changes the first row's alone.

    None: not known, because the module cannot be called again, or because no rows or those of everything change.
    Policy and random numbers are as before afterwards.
    """
    batch = call.shape.batch
    unchanged: Tensor | None = None
    state = CallState(policy.policy, call.module.forward)
    for last_axis in (None, False, True):  # as many tokens as rows: either axis may be the batch
        watcher = _Rows(call.shape)
        try:
            args, kwargs = pytree.tree_map(_copied, (call.args, call.kwargs))
            if last_axis is not None:
                tokens = [
                    value for value in pytree.tree_leaves((args, kwargs)) if _batch_axis(value, batch) is not None
                ]
                ndim = max(value.ndim for value in tokens)  # of (token, width) beside others, the batch is none
                change = partial(_first_row_changed, batch=batch, ndim=ndim, last_axis=last_axis)
                args, kwargs = pytree.tree_map(change, (args, kwargs))
            with ExitStack() as stack:
                stack.enter_context(torch.no_grad())
                for device, dtype in call.autocast:
                    stack.enter_context(torch.autocast(device, dtype))
                stack.enter_context(watch_attention(policy, watcher))
                call.module(*args, **kwargs)
        except Exception:  # of the policy's own code: it keeps something that this call lacks
            return None
        finally:
            state.again()
        if watcher.rows is None:
            return None
        if unchanged is None:
            unchanged = watcher.rows
        elif unchanged.shape != watcher.rows.shape:
            return None
        elif (apart := _apart(unchanged, watcher.rows)) is not None:
            return apart
    return None


def _apart(unchanged: Tensor, changed: Tensor) -> bool | None:
    """Return whether only rows of the first row of the batch differ; False: those that are its with the heads outside.

    unchanged, changed: (batch, head, query, key).
    """
    batch, heads = unchanged.shape[:2]
    moved = (unchanged - changed).abs().flatten(2).amax(dim=2)  # (batch, head)
    differ = moved > _MOVED * moved.max()
    if int(differ.sum()) != heads:
        return None
    if bool(differ[0].all()):
        return True
    # With the heads outside, the first row of the batch has every `batch`-th of the folded rows.
    return False if bool(differ.flatten()[::batch].all()) else None


#: Share of the largest change of rows that counts as one.
_MOVED = 0.01
#: The weight of the last key of a changed row, as a factor; the first key's stays, those between follow.
_LOWEST_FACTOR = 0.05
#: Largest change of the other rows' actions, relative to that of the changed row's. Other kernels are no reason: both
#: calls are made with a mask.
_TOLERANCE = 1e-3


def _batch_axis(value: Any, batch: int, last_axis: bool = False) -> int | None:
    """The axis of the batch in tokens (batch, token, width), or (token, batch, width); None for what is no tokens.

    last_axis: of two that are as large, the second.
    """
    if not isinstance(value, Tensor) or not value.is_floating_point() or value.ndim not in (2, 3):
        return None
    axes = [axis for axis in range(value.ndim - 1) if value.shape[axis] == batch]
    return axes[-1 if last_axis else 0] if axes else None


def _first_row_changed(value: Any, batch: int, ndim: int, last_axis: bool) -> Any:
    """Change tokens of so many axes in the first row of the batch; all else is as it was."""
    axis = _batch_axis(value, batch, last_axis)
    if axis is not None and value.ndim == ndim:
        row = value.select(axis, 0)
        spread = row.float().std(correction=0)
        if not spread.isfinite():
            return value  # a mask
        # Not a multiple: norms take those away.
        row += spread * torch.linspace(-1, 1, row.shape[-1], device=row.device).to(row.dtype)
    return value


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
