"""The functions that compute attention, seen while the policy's own code calls them.

Most policies call them by names in torch (`torch.nn.functional.scaled_dot_product_attention`, `tensor.softmax(-1)`).
During a block something else stands under these names; other functions cost nothing more. What is called otherwise,
such as a function that was imported by name, is seen by a `TorchFunctionMode` only, through which every function of
torch goes: a few microseconds each, more than many policies compute in it. The result of a softmax is followed by that
mode, from the softmax to the next module that begins or ends after its product with the values. So is the output of a
call, to its addition to the residual stream, where the watcher wants it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import wraps
from typing import Any

import torch
from torch import nn, overrides
from torch.overrides import TorchFunctionMode

from vla_attention.capture.torch_policies import fused_calls, multihead_calls, softmax_calls
from vla_attention.capture.torch_policies.followed_outputs import OutputFollower
from vla_attention.capture.torch_policies.tensor_functions import tensors_among
from vla_attention.capture.torch_policies.unseen_attention import ATTENTION_OPERATOR, LOAD_WITH_SDPA, UnseenAttention
from vla_attention.capture.torch_policies.watched_block import WatchedBlock
from vla_attention.schemas.errors import UserError

#: Where policies find the functions. `F.softmax` calls the tensor's method; `torch.bmm` is called by
#: `multi_head_attention_forward`.
_NAMES: tuple[tuple[Any, str], ...] = (
    (torch.nn.functional, "scaled_dot_product_attention"),
    (torch.nn.functional, "multi_head_attention_forward"),
    (torch.Tensor, "softmax"),
    (torch, "softmax"),
    (torch, "_safe_softmax"),
    (torch.special, "softmax"),
    (torch, "bmm"),
)
#: Functions of torch in Python that call the tensor's softmax, which is seen itself.
_CALLS_SOFTMAX = frozenset((torch.nn.functional.softmax,))
_OPERATORS = frozenset((torch._ops.OpOverload, torch._ops.OpOverloadPacket))
#: The stack of function modes of this thread. Torch has no public name for it.
_modes: Callable[[], list[TorchFunctionMode]] = overrides._get_current_function_mode_stack
_pop: Callable[[], TorchFunctionMode] = overrides._pop_mode
_push: Callable[[TorchFunctionMode], None] = overrides._push_mode
_Call = Callable[[Any, tuple[Any, ...], Mapping[str, Any]], Any]


class SeenFunctions:
    """Sees the attention functions of one block, in the thread in which it was opened.

    every_function: look at every function of torch, not only at those under the usual names.

    Attributes:
        by_names: whether no attention function was seen that was called otherwise than by its usual name.
        block: whose functions they are.
        softmaxes: the followed results of softmaxes.
        outputs: the followed outputs of attention calls.
        handlers: what is done instead of a function.
        inside: whether a handler runs; what it calls is no call of the policy's.
    """

    def __init__(self, block: WatchedBlock, *, every_function: bool) -> None:
        self.by_names = True
        self.every_function = every_function
        self.block = block
        self.softmaxes = softmax_calls.Softmaxes(block)
        self.outputs = OutputFollower(block)
        self.inside = False
        self.handlers: dict[Any, _Call] = {
            **dict.fromkeys(fused_calls.SDPA_FUNCTIONS, self._attend(fused_calls.watch_sdpa)),
            **dict.fromkeys(multihead_calls.FUNCTIONS, self._attend(self._multihead)),
            **dict.fromkeys(fused_calls.FLEX_FUNCTIONS, self._attend(fused_calls.watch_flex)),
            **dict.fromkeys(softmax_calls.SOFTMAXES, self.softmaxes.softmax),
        }
        #: Whether calls are seen: what stands under the names may be called after the block.
        self._seeing = False
        #: What `nn.MultiheadAttention` calls inside; None while none runs.
        self._inner_calls: list[multihead_calls.InnerCall] | None = None
        #: Sees every function of torch while it is entered.
        self._mode = _EveryFunction(self)
        #: Whether it is entered for what is followed.
        self._following = False
        #: How many modes there were before.
        self._depth = len(_modes())

    @contextmanager
    def names_replaced(self) -> Iterator[None]:
        """Put what sees a call under the names of the functions; afterwards they are as before."""
        replaced = []
        try:
            for owner, name in _NAMES:
                function = getattr(owner, name)
                stand_in = self._in_place_of(function)
                if function in self.handlers:  # some functions give the mode what stands under their name
                    self.handlers[stand_in] = self.handlers[function]
                replaced.append((owner, name, owner.__dict__.get(name), stand_in))
                setattr(owner, name, stand_in)
            yield
        finally:
            for owner, name, before, stand_in in replaced:
                if owner.__dict__.get(name) is not stand_in:
                    continue  # the policy's code has set another one meanwhile
                if before is None:  # inherited
                    delattr(owner, name)
                else:
                    setattr(owner, name, before)

    @contextmanager
    def seeing(self) -> Iterator[None]:
        """See what is called in the block's thread."""
        self._seeing = True
        try:
            with self._mode if self.every_function else nullcontext():
                yield
        finally:
            self._seeing = False
            self._stop_following()

    def at_module(self) -> None:
        """Say that a module begins or ends: where nothing is followed any more, the mode that follows ends."""
        if self._following and not self._follows:
            self._stop_following()

    def around_projection(self, module: nn.Module, forward: Callable[..., Any]) -> Callable[..., Any]:
        """Return a forward that tells what follows an output what the projection was given and what it returned."""

        def projected(*args: Any, **kwargs: Any) -> Any:
            if not self._sees or self.inside or not self.outputs.awaits(module):
                return forward(*args, **kwargs)
            given = next(tensors_among((*args, *kwargs.values())), None)
            self.inside = True  # the module is one step
            try:
                result = forward(*args, **kwargs)
            finally:
                self.inside = False
            returned = next(tensors_among((result,)), None)
            if given is not None and returned is not None:
                self.outputs.project(module, given, returned)
                self._follow_what_is_left()
            return result

        return projected

    def _in_place_of(self, function: Any) -> Any:
        @wraps(function)
        def seen(*args: Any, **kwargs: Any) -> Any:
            if not self._sees:
                return function(*args, **kwargs)
            if self.inside:
                result = function(*args, **kwargs)
                if self._inner_calls is not None:
                    self._inner_calls.append(multihead_calls.InnerCall(function, args, result))
                return result
            handler = self.handlers.get(function)
            if handler is None:
                return function(*args, **kwargs)
            return self.handle(handler, function, args, kwargs)

        return seen

    @property
    def _sees(self) -> bool:
        return self._seeing and self.block.in_this_thread

    @property
    def _follows(self) -> bool:
        """Whether anything is followed."""
        return bool(self.softmaxes.followed) or bool(self.outputs)

    def handle(self, handler: _Call, function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        """Run a handler in place of a function, and follow the output of a call if the watcher wants it."""
        self.inside = True
        try:
            result = handler(function, args, kwargs)
            way = self.block.take_way()
            if way is not None:
                self.outputs.begin(way, next(tensors_among((result,))))
            return result
        finally:
            self.inside = False
            self._follow_what_is_left()

    def _follow_what_is_left(self) -> None:
        """Enter the mode that sees every function, if something is followed."""
        if not self._follows or self._following or self.every_function:
            return
        # Below the modes that the policy's code has entered, which leave from the top.
        above = [_pop() for _ in _modes()[self._depth :]]
        for mode in (self._mode, *reversed(above)):
            _push(mode)
        self._following = True

    def follow(self, function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        """Run a function that is no attention function, and follow what it makes of what is followed."""

        def run() -> Any:
            if self.softmaxes.followed:
                return self.softmaxes.follow(function, args, kwargs)
            return function(*args, **kwargs)

        return self.outputs.follow(function, args, kwargs, run) if self.outputs else run()

    def _attend(self, watch_call: Callable[..., Any]) -> _Call:
        def attend(function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
            try:
                return watch_call(self.block, function, args, kwargs)
            except UserError as error:  # the policy's code may catch it
                raise self.block.failed(error) from None

        return attend

    def _multihead(self, block: WatchedBlock, function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        def run(*args: Any, **kwargs: Any) -> tuple[Any, list[multihead_calls.InnerCall]]:
            inner: list[multihead_calls.InnerCall] = []
            self._inner_calls = inner
            try:
                return function(*args, **kwargs), inner
            finally:
                self._inner_calls = None

        return multihead_calls.watch_call(block, run, args, kwargs)

    def _stop_following(self) -> None:
        """Leave the mode that follows softmaxes and outputs, wherever it stands."""
        if not self._following or self._mode not in _modes():
            return  # inside of a function that the mode has seen, it is not there
        # Torch leaves modes from the top only, and the policy's own ones may have been entered since.
        above = []
        while (mode := _pop()) is not self._mode:
            above.append(mode)
        for mode in reversed(above):
            _push(mode)
        self._following = False


class _EveryFunction(TorchFunctionMode):
    """Sees every torch function of one thread."""

    def __init__(self, seen: SeenFunctions) -> None:
        super().__init__()
        self._seen = seen
        #: Every function of the policy comes by here: a look at each says whether anything is followed.
        self._softmaxes, self._outputs = seen.softmaxes.followed.entries, seen.outputs

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        seen = self._seen
        if seen.inside:
            return func(*args, **kwargs) if kwargs else func(*args)
        handler = seen.handlers.get(func)
        if handler is not None:
            seen.by_names = False
            return seen.handle(handler, func, args, kwargs or {})
        if type(func) in _OPERATORS:
            self._refuse_unseen(func)
        if (self._softmaxes or self._outputs) and func not in _CALLS_SOFTMAX:
            return seen.handle(seen.follow, func, args, kwargs or {})
        return func(*args, **kwargs) if kwargs else func(*args)

    def _refuse_unseen(self, operator: Any) -> None:
        """Raise `UnseenAttention` for an attention operator that no handler knows."""
        name = str(getattr(operator, "_qualified_op_name", None) or operator.name())
        if ATTENTION_OPERATOR.match(name):
            raise self._seen.block.failed(
                UnseenAttention(f"The operator {name} computes attention in a way that gives no rows. {LOAD_WITH_SDPA}")
            )
