"""Seeing every attention call of a torch policy while its own code runs, by one `TorchFunctionMode`.

Compiled parts run eager meanwhile, and the fast path of `nn.MultiheadAttention`, which nothing sees, is off. The
policy's own kernels compute what it returns: with nothing changed, actions are bit-equal with those of the same policy
run eager with the fast path off.

A mode makes every function of torch pass through Python. Once it is known which modules compute attention
(`WatchedPlaces`), the mode is on only in them, and as long as something is followed that came of it.
"""

from __future__ import annotations

import sys
import threading
import types
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from threading import get_ident
from typing import Any

import torch
from msgspec import structs
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from vla_attention.capture.torch_policies.attention_calls import AttentionCall, CallShape, Kind, Watcher, exact
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused, Masks
from vla_attention.capture.torch_policies.fused_calls import FLEX_FUNCTIONS, SDPA_FUNCTIONS, watch_flex, watch_sdpa
from vla_attention.capture.torch_policies.output_ways import OutputWay, OutputWays
from vla_attention.capture.torch_policies.policy_modules import CannotRunEager, FoundPolicy, find_policy
from vla_attention.capture.torch_policies.products import PRODUCTS
from vla_attention.capture.torch_policies.softmax_calls import SELECTIONS, SOFTMAXES, Softmaxes
from vla_attention.capture.torch_policies.unseen_attention import ATTENTION_OPERATOR, LOAD_WITH_SDPA, UnseenAttention
from vla_attention.capture.torch_policies.watched_places import OUTSIDE
from vla_attention.schemas.errors import BadArgument, Note, UserError, listing, plural

#: Runs a function of torch with its arguments, and notes what is known of its result.
Handler = Callable[[Any, tuple[Any, ...], Mapping[str, Any]], Any]

_is_wrapped = torch._C._functorch.is_functorch_wrapped_tensor

_ACTIVE = threading.Lock()
_OPERATORS = frozenset((torch._ops.OpOverload, torch._ops.OpOverloadPacket))
_MULTIHEAD = torch.nn.functional.multi_head_attention_forward
#: The same function for a mode that sees what it calls inside: it does not ask first whether there is a mode.
_OPEN_MULTIHEAD = types.FunctionType(
    _MULTIHEAD.__code__,
    {**vars(torch.nn.functional), "has_torch_function": lambda tensors: False},
    argdefs=_MULTIHEAD.__defaults__,
)
_OPEN_MULTIHEAD.__kwdefaults__ = _MULTIHEAD.__kwdefaults__


class AlreadyWatched(BadArgument):
    """A block inside another one, or two at the same time."""


class OtherPolicy(BadArgument):
    """Attention of modules that the watched policy does not hold."""


class NotFollowed(BadArgument):
    """A policy that ran in another thread than the block that records it."""


class AttentionMode(TorchFunctionMode):
    """Sees every function of torch that the thread of one block calls, and tells the watcher of attention.

    Attributes:
        outputs: the outputs of attention calls that are followed to the residual stream.
    """

    def __init__(self, known: FoundPolicy, watcher: Watcher) -> None:
        super().__init__()
        self._policy, self._watcher = known.policy, watcher
        self._paths = {id(module): path for path, module in known.modules.items()}
        self._softmaxes = Softmaxes(self)
        self.masks = Masks()
        watcher.unmet = self._softmaxes.unmet
        self.outputs = OutputWays(lambda: f"module '{self.where()[0]}'", self.computing)
        self._handlers: dict[Any, Handler] = {
            **dict.fromkeys(SDPA_FUNCTIONS, self._attending_here(partial(watch_sdpa, self))),
            **dict.fromkeys(FLEX_FUNCTIONS, self._attending_here(partial(watch_flex, self))),
            **dict.fromkeys(SOFTMAXES, self._attending_here(self._softmaxes.softmax)),
            **dict.fromkeys(PRODUCTS, self._softmaxes.follow),
            **dict.fromkeys(SELECTIONS, self._attending_here(self._softmaxes.select)),
        }
        #: The first error of watching, which the block raises at its end if the policy's code went on without it.
        self._error: BaseException | None = None
        #: Of the attention call that comes next.
        self.number = 0
        #: Heads of `nn.MultiheadAttention` while it runs, 0 otherwise.
        self._multihead_heads = 0
        self._way: OutputWay | None = None
        self._thread = get_ident()
        self._ran_elsewhere = False
        self._places = known.places
        #: Whether every function is watched; else in which modules it is off, and how many others are running.
        self.whole = watcher.whole = bool(watcher.changes) or known.places.next_is_whole()
        watcher.number = known.places.calls
        self._quiet: Set[int] = frozenset() if self.whole else known.places.quiet
        self._watched = 0
        #: Ids of the policy's modules that are running, the innermost last, that ran, and that computed attention.
        self._running: list[int] = []
        self._ran, self._attending = set[int](), set[int]()
        self._on = False

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        handler = self._handlers.get(func)
        if handler is None:
            if func is _MULTIHEAD:
                return self._multihead(args, kwargs or {})
            if type(func) in _OPERATORS:
                self._refuse_unseen(func)
            if not self._softmaxes.entries and not self.outputs.entries:
                return func(*args, **kwargs) if kwargs else func(*args)
            handler = self._softmaxes.follow
        given = kwargs or {}
        try:
            if not self.outputs.entries:
                result = handler(func, args, given)
            else:
                result = self.outputs.follow(func, args, given, lambda: handler(func, args, given))
        except UserError as error:  # the policy's code may catch it
            raise self.failed(error) from None
        if self._way is not None:
            way, self._way = self._way, None
            self.outputs.begin(way, result[0] if isinstance(result, tuple) else result)
        return result

    def _attending_here(self, handler: Handler) -> Handler:
        def noting(function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
            self._attending.add(self._running[-1] if self._running else OUTSIDE)
            return handler(function, args, kwargs)

        return noting

    def _multihead(self, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        """Run the function of `nn.MultiheadAttention`, and see what it calls inside: projections and attention."""
        before, self._multihead_heads = self._multihead_heads, kwargs["num_heads"] if len(args) < 5 else args[4]
        try:
            with self:
                return _OPEN_MULTIHEAD(*args, **kwargs)
        finally:
            self._multihead_heads = before

    def _refuse_unseen(self, operator: Any) -> None:
        name = str(getattr(operator, "_qualified_op_name", None) or operator.name())
        if ATTENTION_OPERATOR.match(name):
            raise self.failed(
                UnseenAttention(f"The operator {name} computes attention in a way that gives no rows. {LOAD_WITH_SDPA}")
            )

    def where(self) -> tuple[str, nn.Module | None]:
        """Return the path of the policy's innermost module that runs, in its forward or another method, and the module.

        That is None outside of all modules.

        Raises:
            OtherPolicy: a module that the policy does not hold is running, and none of the policy's is.
        """
        foreign = None
        for owner in _frame_owners():
            if id(owner) in self._paths:
                return self._paths[id(owner)], owner if isinstance(owner, nn.Module) else None
            if owner is self._policy:
                return "", None
            if foreign is None and isinstance(owner, nn.Module):
                foreign = owner
        if foreign is None:
            return "", None
        raise self.failed(
            OtherPolicy(
                f"Attention ran in a module of class {type(foreign).__name__}, which the watched policy "
                f"({type(self._policy).__name__}) does not hold: one block records one policy. Call the other model "
                "outside the block, or give the object that holds both."
            )
        )

    def new_shape(
        self, module: str, kind: Kind, sizes: tuple[int, int, int, int, int], dtype: torch.dtype
    ) -> CallShape:
        """Return the shape of the call that comes next; sizes: batch, heads, kv_heads, queries, keys."""
        batch, heads, kv_heads, queries, keys = sizes
        if self._multihead_heads:
            kind, batch, heads = "multihead", batch * heads // self._multihead_heads, self._multihead_heads
            kv_heads = heads
        return CallShape(
            module=module, kind=kind, number=self.number, batch=batch, heads=heads, kv_heads=kv_heads,
            queries=queries, keys=keys, dtype=str(dtype).removeprefix("torch."),
        )  # fmt: skip

    def change(self, shape: CallShape) -> Tensor | None:
        """Ask the watcher for a change of the call that comes next."""
        if not self._watcher.changes:
            return None
        with torch.no_grad(), self._failing():
            change = self._watcher.change(shape)
        selects = self._softmaxes.selects(shape)
        if change is not None and selects and bool(change.any()):
            raise self.failed(
                ChangeRefused(
                    f"The attention call {shape} cannot be changed: {selects} selects keys by their scores first, and "
                    "without a key it would select another one. Leave this call out (layers), or record the policy "
                    "with all keys."
                )
            )
        return change

    def passes(self, shape: CallShape) -> bool:
        """Return whether a call that has run is none of the watcher's, and count it then."""
        if shape.number != self.number:
            shape = structs.replace(shape, number=self.number)
        try:
            passed = self._watcher.passes(shape)
        except BaseException as error:
            self.failed(error)
            raise
        self.number += passed
        return passed

    def sinks(self, shape: CallShape) -> int:
        """Ask the watcher how many keys of a softmax have no values."""
        with self._failing():
            return self._watcher.sinks(shape)

    def saw(self, call: AttentionCall, probabilities: Sequence[Tensor] = ()) -> None:
        """Tell the watcher about a call, and count it; probabilities: tensors that the policy may use once more."""
        with self.computing():
            self.number += 1
            self._way = self._watcher.saw(call)
        if self._way is not None:
            self.outputs.note_other_use(self._way, probabilities)

    def refuse(self, shape: CallShape, why: str) -> None:
        """Tell the watcher that a call that it took has no rows, in words that follow "it"."""
        with self._failing():
            self._watcher.refuse(shape, why)

    @contextmanager
    def computing(self) -> Iterator[None]:
        """Compute for the watcher beside the policy: without gradients, autocast and function modes."""
        with exact(), self._failing(), _without_modes():
            yield

    def refuse_without_numbers(self, *tensors: Tensor) -> None:
        """Raise an error where numbers cannot be read: nested tensors, vmap, the meta device, a graph's capture."""
        if torch.cuda.is_initialized() and torch.cuda.is_current_stream_capturing():  # type: ignore[no-untyped-call]
            raise self.failed(
                CannotRunEager(
                    f"{self.where()[0] or 'The policy'} computes attention while a CUDA graph is captured: nothing is "
                    "computed then, and no attention is seen when the graph is replayed. Switch the policy's CUDA "
                    "graphs off."
                )
            )
        for tensor in tensors:
            if _is_wrapped(tensor) or tensor.is_nested or tensor.is_meta:
                self._refuse_without_numbers(tensors)

    def _refuse_without_numbers(self, tensors: Sequence[Tensor]) -> None:
        if any(_is_wrapped(tensor) for tensor in tensors):
            reason = (
                "inside of torch.vmap or another transform of torch.func, whose tensors have no numbers that can be "
                "recorded. Call it with a batch instead."
            )
        elif any(tensor.is_nested for tensor in tensors):
            reason = "of nested tensors, whose rows cannot be recorded. Call the policy with padded tensors and a mask."
        else:
            reason = "on the meta device, whose tensors have no numbers. Load the weights, and move the inputs to them."
        raise self.failed(UnseenAttention(f"{self.where()[0] or 'The policy'} computes attention {reason}"))

    def failed(self, error: BaseException) -> BaseException:
        """Remember an error of watching, and return it."""
        self._error = self._error or error
        return error

    @contextmanager
    def _failing(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            self.failed(error)
            raise

    def begin(self, module: nn.Module) -> bool:
        """Notice that a module begins, and watch it or not; False if its end is of no interest.

        Every module that the policy calls comes by here.
        """
        number = id(module)
        if get_ident() != self._thread:
            self._ran_elsewhere = self._ran_elsewhere or number in self._paths
            return False
        if number in self._paths:
            self._running.append(number)
            self._ran.add(number)
            if number in self._quiet:
                if self._on and not self._watched:
                    self._leave_stack()
                return True
        elif not self._quiet:
            return False
        self._watched += 1
        if not self._on:
            self._enter_stack()
        return True

    def end(self, module: nn.Module) -> None:
        """Notice that a module ends for which `begin` gave True."""
        number = id(module)
        if number in self._paths:
            self._running.pop()
        if number not in self._quiet:
            self._watched -= 1
        if self._quiet and self._on and not self._watched:
            self._leave_stack()

    def _enter_stack(self) -> None:
        """Go on the stack of function modes: below what the policy put there, which it takes off from the top.

        Lower still are those that were there before the block, and torch's default device, which has to be the lowest.
        """
        height, place, before = torch._C._len_torch_function_stack(), 0, list(self._before)
        default = getattr(torch._GLOBAL_DEVICE_CONTEXT, "device_context", None)
        while place < height:
            mode = torch._C._get_function_stack_at(place)
            if before and mode is before[0]:
                before.pop(0)
            elif mode is not default or default is None:
                break
            place += 1
        above = [torch._C._pop_torch_function_stack() for _ in range(height - place)]
        for mode in (self, *reversed(above)):
            torch._C._push_on_torch_function_stack(mode)
        self._on = True

    def _leave_stack(self) -> None:
        """Go off it again, unless something is followed, or torch itself took this mode off to ask it about a function.

        In such a function modules may run.
        """
        if self._softmaxes.entries or self.outputs.entries:
            return
        height = torch._C._len_torch_function_stack()
        for place in range(height - 1, -1, -1):
            if torch._C._get_function_stack_at(place) is self:
                above = [torch._C._pop_torch_function_stack() for _ in range(height - place)][:-1]
                for mode in reversed(above):
                    torch._C._push_on_torch_function_stack(mode)
                self._on = False
                return

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Be on in the block, throughout or where attention is."""
        self._before = [torch._C._get_function_stack_at(place) for place in range(torch._C._len_torch_function_stack())]
        if not self._quiet:
            self._enter_stack()
        _NOTICING.mode = self
        try:
            yield
        finally:
            _NOTICING.mode = None
            self._softmaxes.entries.clear()
            self.outputs.entries.clear()
            self._leave_stack()

    def close(self) -> None:
        """End a block whose code raised nothing; errors: see `watch_attention`, also those that the policy caught."""
        if self._error is not None:
            raise self._error
        if self._softmaxes.changed:
            shape, last = self._softmaxes.unmet[min(self._softmaxes.changed)]
            raise ChangeRefused(
                f"A softmax was changed as if it were the call {shape}, and met no values (last function: {last}): it "
                "is no attention, as the gate of a mixture of experts, or attention that is not seen. Give the "
                "layout's rule a kind or a number of keys that this softmax does not have, or leave its block out."
            )
        if self._ran_elsewhere:
            raise NotFollowed(
                f"The policy ({type(self._policy).__name__}) ran in another thread than the block that records "
                "it. Open the block in the thread that calls the policy, around that one call, and let no other thread "
                "call it meanwhile."
            )
        missed = self._places.missed
        found = self._places.passed(self._ran, self._attending, whole=self.whole, number=self.number)
        self._watcher.modules = self._ran | self._places.seen
        if found:
            paths = listing(sorted(self._paths[number] or "the policy itself" for number in found))
            warnings.warn(
                f"The policy computes attention in {paths} now, where it had none in the first policy calls. In "
                f"{plural(missed, 'block')} before this one no attention was seen, which may have been there, and "
                "nothing of them was recorded.",
                Note,
            )


@contextmanager
def watch_attention(policy: object, watcher: Watcher) -> Iterator[None]:
    """Tell `watcher` about every attention call of `policy` inside the block, in the thread of the block.

    policy: an `nn.Module`, an object that holds modules, or what `find_policy` made of one, which spares the search for
    modules at every block.

    Raises:
        AlreadyWatched: another block is open in this process.
        NoModules, CannotRunEager: see `modules_of`.
        OtherPolicy: attention of a module that the policy does not hold ran in the block.
        NotFollowed: the policy ran in another thread.
        UnseenAttention: the policy is set to attention that gives no rows, such as flash-attn's, or an operator that
            computes attention so ran.
        ChangeRefused: a change that does not fit its call, or that the call does not allow.
    """
    known_policy = find_policy(policy)
    if not _ACTIVE.acquire(blocking=False):
        raise AlreadyWatched(
            "Attention is already recorded in another block of this process: blocks cannot be inside each other, and "
            "one block records one policy. Close the other block first."
        )
    try:
        mode = AttentionMode(known_policy, watcher)
        with seen_by_python(), noticing_modules(), mode.watching():
            yield
        mode.close()
    finally:
        _ACTIVE.release()


@dataclass
class _Noticing:
    """Who is told of modules that run. blocks: how many hold `nn.Module.__call__`, which calls as `plain` does."""

    mode: AttentionMode | None = None
    blocks: int = 0
    plain: Callable[..., Any] = nn.Module.__call__
    noticed: Callable[..., Any] | None = None


_NOTICING = _Noticing()


@contextmanager
def noticing_modules() -> Iterator[None]:
    """Tell the mode that watches of every module that runs.

    torch's global hooks would make every module slower, and torch.compile warn. Hold this around many watched blocks:
    the class of all modules is written to at the first and at the end of the last one, and Python (3.13) looks
    attributes up more slowly in a class that was written to a thousand times.
    """
    if not _NOTICING.blocks:
        plain = _NOTICING.plain = nn.Module.__call__

        def noticed(module: nn.Module, /, *args: Any, **kwargs: Any) -> Any:
            mode = _NOTICING.mode
            if mode is None or not mode.begin(module):
                return plain(module, *args, **kwargs)
            try:
                return plain(module, *args, **kwargs)
            finally:
                mode.end(module)

        nn.Module.__call__ = _NOTICING.noticed = noticed  # type: ignore[method-assign]
    _NOTICING.blocks += 1
    try:
        yield
    finally:
        _NOTICING.blocks -= 1
        if not _NOTICING.blocks and nn.Module.__call__ is _NOTICING.noticed:  # and nobody else has written to it
            nn.Module.__call__ = _NOTICING.plain  # type: ignore[method-assign]


@contextmanager
def seen_by_python() -> Iterator[None]:
    """Run compiled code eager, with the fast path of `nn.MultiheadAttention` off; both are as before afterwards."""
    fast_path = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        with torch.compiler.set_stance("force_eager"):
            yield
    finally:
        torch.backends.mha.set_fastpath_enabled(fast_path)


def _without_modes() -> AbstractContextManager[object]:
    """Compute past function modes, those of the policy's code too: what a watcher computes is none of theirs."""
    return torch._C.DisableTorchFunction() if torch._C._len_torch_function_stack() else nullcontext()


def _frame_owners() -> Iterator[object]:
    """Yield the `self` of the functions that are running, the innermost first."""
    frame = sys._getframe(2)
    while frame is not None:
        code = frame.f_code
        if code.co_argcount and code.co_varnames[0] == "self":
            yield frame.f_locals.get("self")
        frame = frame.f_back  # type: ignore[assignment]
