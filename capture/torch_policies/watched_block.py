"""One watched block: which module is running, in whatever thread, and what the watcher is told."""

from __future__ import annotations

import sys
import threading
import types
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import update_wrapper
from typing import Any

import torch
from torch import Tensor, nn

from vla_attention.capture.torch_policies.added_updates import OutputWay
from vla_attention.capture.torch_policies.attention_calls import AttentionCall, CallShape, Kind, Watcher, exact
from vla_attention.capture.torch_policies.call_changes import ChangeRefused
from vla_attention.capture.torch_policies.policy_modules import FoundPolicy
from vla_attention.capture.torch_policies.unseen_attention import UnseenAttention
from vla_attention.schemas.errors import BadArgument


class OtherPolicy(BadArgument):
    """Attention of modules that the watched policy does not hold."""


class StillRunning(BadArgument):
    """A block that ends while the policy runs in another thread."""


class NotFollowed(BadArgument):
    """A policy that ran in another thread, in methods in which its attention is not seen."""


@dataclass(frozen=True)
class Where:
    """The innermost module that is running: its path in the policy, and itself (None outside every module)."""

    path: str
    module: nn.Module | None


class _ThreadState(threading.local):
    """What belongs to one thread: the modules whose forward is running, whether its calls are seen, and an output.

    way: of the call that the watcher saw last, if it wants its output to be followed.
    """

    def __init__(self) -> None:
        self.running: list[nn.Module] = []
        self.seen = False
        self.way: OutputWay | None = None


class WatchedBlock:
    """What `watch_attention` and the kinds of calls share during one block."""

    def __init__(self, found: FoundPolicy, watcher: Watcher, *, every_function: bool = True) -> None:
        self.policy = found.policy
        self.paths = {id(module): path for path, module in found.modules.items()}
        self.watcher = watcher
        #: The first error of watching, which the block raises at its end if the policy's code went on without it.
        self.error: BaseException | None = None
        #: Softmaxes by hand that were changed and met no values yet.
        self.changed: list[CallShape] = []
        #: Softmaxes by hand that began, and those that met values: the shape as it began, and as it turned out to be.
        self._began: Counter[CallShape] = Counter()
        self._met_values: Counter[tuple[CallShape, CallShape]] = Counter()
        self._every_function = every_function
        self._found = found
        #: Whether simple modules ran in a thread where nothing is seen.
        self._unseen_thread = False
        self._number = 0
        self._lock = threading.RLock()
        self._thread = _ThreadState()
        self._elsewhere = 0
        self._closed = False

    def where(self) -> Where:
        """Return the innermost module of the policy whose forward is running in this thread.

        Raises:
            OtherPolicy: a module that the policy does not hold is running, and none of the policy's is.
        """
        if self._thread.running:
            module = self._thread.running[-1]
            return Where(self.paths[id(module)], module)
        foreign = None
        for owner in _frame_owners():
            if id(owner) in self.paths:
                return Where(self.paths[id(owner)], owner if isinstance(owner, nn.Module) else None)
            if owner is self.policy:
                return Where("", None)
            if foreign is None and isinstance(owner, nn.Module):
                foreign = owner
        if foreign is None:
            return Where("", None)
        raise self.failed(
            OtherPolicy(
                f"Attention ran in a module of class {type(foreign).__name__}, which the watched policy "
                f"({type(self.policy).__name__}) does not hold: one block records one policy. Call the other model "
                "outside the block, or give the object that holds both."
            )
        )

    @property
    def running_module(self) -> str:
        """The innermost module whose forward is running in this thread, in words."""
        running = self._thread.running
        return f"module '{self.paths[id(running[-1])]}'" if running else "the policy"

    def new_shape(
        self, where: Where, kind: Kind, sizes: tuple[int, int, int, int, int], dtype: torch.dtype
    ) -> CallShape:
        """Return the shape of the call that comes next; sizes: batch, heads, kv_heads, queries, keys."""
        batch, heads, kv_heads, queries, keys = sizes
        return CallShape(
            module=where.path, kind=kind, number=self._number, batch=batch, heads=heads, kv_heads=kv_heads,
            queries=queries, keys=keys, dtype=str(dtype).removeprefix("torch."),
        )  # fmt: skip

    @property
    def changes(self) -> bool:
        """Whether the watcher changes any call."""
        return bool(getattr(self.watcher, "changes", True))

    def change(self, shape: CallShape) -> Tensor | None:
        """Ask the watcher for a change of the call that comes next."""
        if not self.changes:
            return None
        with self._lock, torch.no_grad(), self._failing():
            return None if self._closed else self.watcher.change(shape)

    def passes(self, shape: CallShape) -> bool:
        """Return whether a call that has run is none of the watcher's, and count it then."""
        ask = getattr(self.watcher, "passes", None)
        if ask is None:
            return False
        with self._lock, self._failing():
            if self._closed or not ask(shape):
                return self._closed
            self._number += 1
            return True

    def expected(self, asked: CallShape) -> CallShape | None:
        """Return what a softmax by hand turns out to be, if blocks that looked at every function know.

        asked: its shape without a number. None: it is not known, or looked at again in this block.
        """
        return None if self._every_function or self.changes else self._found.softmaxes.get(asked)

    def began_softmax(self, asked: CallShape) -> None:
        """Note a softmax by hand; asked: its shape without a number."""
        if self._every_function:
            self._began[asked] += 1

    def softmax_met_values(self, asked: CallShape, shape: CallShape) -> None:
        """Note that a softmax by hand met values: its shape as it began, and as it turned out to be."""
        if self._every_function:
            self._met_values[replace(asked, number=0), replace(shape, number=0)] += 1

    def _learn(self) -> None:
        """Remember what the softmaxes by hand of this block turned out to be."""
        known = self._found.softmaxes
        always = {asked: shape for (asked, shape), times in self._met_values.items() if times == self._began[asked]}
        for asked in self._began:
            shape = always.get(asked)
            known[asked] = shape if known.get(asked, shape) == shape else None

    def saw(self, call: AttentionCall) -> None:
        """Tell the watcher about a call, and count it."""
        with self.computing():
            if self._closed:  # a thread that still runs; the block has ended with an error
                return
            if call.shape.number != self._number:  # another call came in between, in this thread or in another
                call = replace(call, shape=replace(call.shape, number=self._number))
            self._number += 1
            self._thread.way = self.watcher.saw(call)

    def take_way(self) -> OutputWay | None:
        """Return how the output of the call that was just seen is followed, once."""
        way, self._thread.way = self._thread.way, None
        return way

    @contextmanager
    def computing(self) -> Iterator[None]:
        """Compute for the watcher beside the policy: without gradients, autocast and function modes."""
        with self._lock, exact(), self._failing(), _without_modes():
            yield

    def refuse_nested(self, *tensors: Tensor) -> None:
        """Raise `UnseenAttention` for nested tensors, whose sequences have lengths of their own, and inside of vmap."""
        if any(torch._C._functorch.is_functorch_wrapped_tensor(tensor) for tensor in tensors):
            raise self.failed(
                UnseenAttention(
                    f"{self.where().path or 'The policy'} computes attention inside of torch.vmap or another transform "
                    "of torch.func, whose tensors have no numbers that can be recorded. Call it with a batch instead."
                )
            )
        if any(tensor.is_nested for tensor in tensors):
            raise self.failed(
                UnseenAttention(
                    f"{self.where().path or 'The policy'} computes attention of nested tensors, whose rows cannot be "
                    "recorded. Call the policy with padded tensors and a mask."
                )
            )

    def failed(self, error: BaseException) -> BaseException:
        """Remember an error of watching, and return it."""
        self.error = self.error or error
        return error

    @contextmanager
    def _failing(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            self.failed(error)
            raise

    def abandon(self) -> None:
        """End the block after an error."""
        with self._lock:
            self._closed = True

    def close(self) -> None:
        """End the block.

        Raises:
            StillRunning: the policy still runs in another thread.
            NotFollowed: it ran in another thread so that no attention was seen.
            ChangeRefused: a softmax was changed that is no attention.
            BaseException: an error of watching that the policy's code caught, or met in another thread.
        """
        with self._lock:
            self._closed = True
            if self._elsewhere:
                raise StillRunning(
                    f"The policy ({type(self.policy).__name__}) still runs in another thread at the end of the block "
                    "that records it. Wait for its answer inside the block."
                )
            if self.error is not None:
                raise self.error
            if self.changed:
                raise ChangeRefused(
                    f"A softmax that is no attention was changed as if it were the call {self.changed[0]}: it was "
                    "multiplied with no values, as the gate of a mixture of experts. Give the layout's rule a kind or "
                    "a number of keys that this softmax does not have, or leave its block out."
                )
            if self._unseen_thread and not self._number:
                raise NotFollowed(
                    f"The policy ({type(self.policy).__name__}) ran in another thread than the block that records it, "
                    "in methods that are no forward of a module, and no attention was seen. Call it in the "
                    "thread of the block."
                )
            self._learn()

    @contextmanager
    def following_modules(
        self,
        seeing: Callable[[], AbstractContextManager[object]],
        at_module: Callable[[], None],
        around_projection: Callable[[nn.Module, Callable[..., Any]], Callable[..., Any]],
    ) -> Iterator[None]:
        """Keep track of which modules run, and see the calls of every thread that runs one of them.

        Calls are seen by threads. A module that is called in a thread where none are enters `seeing` for its forward.
        `at_module` is called where a module begins or ends, `around_projection` returns what stands in place of the
        forward of a module to which outputs are followed. Hooks would not do: `module.forward(...)` skips them, and so
        do some fast paths.
        """
        wanted = {id(module) for module in getattr(self.watcher, "output_modules", ())}
        replaced: list[_Forward] = []
        self._thread.seen = True

        def replace_forward(module: nn.Module, call: Callable[..., Any]) -> None:
            replaced.append(_Forward(module, around_projection(module, call) if id(module) in wanted else call))

        try:
            for module in self._found.attending:
                replace_forward(module, self._followed(module, module.forward, seeing, at_module))
            for module in self._found.simple:
                replace_forward(module, self._noticed(module.forward, at_module))
            yield
        finally:
            self._thread.seen = False
            for forward in replaced:
                forward.give_back()

    def _noticed(self, forward: Callable[..., Any], at_module: Callable[[], None]) -> Callable[..., Any]:
        """Notice a simple module that runs in another thread, outside every forward that could enter a mode there."""
        thread = self._thread

        def noticed(*args: Any, **kwargs: Any) -> Any:
            if not thread.seen:
                self._unseen_thread = True
            at_module()
            return forward(*args, **kwargs)

        return noticed

    def _followed(
        self,
        module: nn.Module,
        forward: Callable[..., Any],
        seeing: Callable[[], AbstractContextManager[object]],
        at_module: Callable[[], None],
    ) -> Callable[..., Any]:
        thread = self._thread

        def followed(*args: Any, **kwargs: Any) -> Any:
            if not thread.seen:
                return in_other_thread(args, kwargs)
            at_module()
            thread.running.append(module)
            try:
                return forward(*args, **kwargs)
            finally:
                thread.running.pop()
                at_module()

        def in_other_thread(args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
            with self._lock:
                self._elsewhere += 1
            try:
                with seeing():
                    thread.seen = True
                    try:
                        return followed(*args, **kwargs)
                    finally:
                        thread.seen = False
            finally:
                with self._lock:
                    self._elsewhere -= 1

        return followed


def _without_modes() -> AbstractContextManager[object]:
    """Compute past function modes, those of the policy's code too: what a watcher computes is none of theirs."""
    return torch._C.DisableTorchFunction() if torch._C._len_torch_function_stack() else nullcontext()


class _Forward:
    """What stands in place of a module's forward during a block.

    A copy or a pickle of the module that is made in the block has the module's own forward: with this one, it would
    compute with the weights of the original.
    """

    def __init__(self, module: nn.Module, call: Callable[..., Any]) -> None:
        update_wrapper(self, module.forward)  # its signature stays what it was
        self.module = module
        self.own = module.__dict__.get("forward")
        self.call = call
        module.__dict__["forward"] = self

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.call(*args, **kwargs)

    def __reduce__(self) -> tuple[Any, ...]:
        return _own_forward, (self.module, self.own)

    def give_back(self) -> None:
        """Give the module its own forward again, unless the policy's code has set another one meanwhile."""
        self.call = _own_forward(self.module, self.own)
        if self.module.__dict__.get("forward") is not self:
            return
        if self.own is None:
            del self.module.__dict__["forward"]
        else:
            self.module.__dict__["forward"] = self.own


def _own_forward(module: nn.Module, own: Callable[..., Any] | None) -> Callable[..., Any]:
    return types.MethodType(type(module).forward, module) if own is None else own


def _frame_owners() -> Iterator[object]:
    """Yield the `self` of the functions that are running, the innermost first."""
    frame = sys._getframe(2)
    while frame is not None:
        code = frame.f_code
        if code.co_argcount and code.co_varnames[0] == "self":
            yield frame.f_locals.get("self")
        frame = frame.f_back  # type: ignore[assignment]
