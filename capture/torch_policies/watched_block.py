"""One watched block: which module is running, and what the watcher is told."""

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
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused
from vla_attention.capture.torch_policies.policy_modules import FoundPolicy
from vla_attention.capture.torch_policies.unseen_attention import UnseenAttention
from vla_attention.schemas.errors import BadArgument


class OtherPolicy(BadArgument):
    """Attention of modules that the watched policy does not hold."""


class NotFollowed(BadArgument):
    """A policy that ran in another thread than the block that records it."""


@dataclass(frozen=True)
class Where:
    """The innermost module that is running: its path in the policy, and itself (None outside every module)."""

    path: str
    module: nn.Module | None


class WatchedBlock:
    """What `watch_attention` and the kinds of calls share during one block."""

    def __init__(self, known_policy: FoundPolicy, watcher: Watcher, *, every_function: bool = True) -> None:
        self.policy = known_policy.policy
        self.paths = {id(module): path for path, module in known_policy.modules.items()}
        self.watcher = watcher
        #: The first error of watching, which the block raises at its end if the policy's code went on without it.
        self.error: BaseException | None = None
        #: Softmaxes by hand that were changed and met no values yet.
        self.changed: list[CallShape] = []
        #: Softmaxes by hand that began, and those that met values: the shape as it began, and as it turned out to be.
        self._began: Counter[CallShape] = Counter()
        self._met_values: Counter[tuple[CallShape, CallShape]] = Counter()
        self._every_function = every_function
        self._known_policy = known_policy
        self._number = 0
        #: The modules whose forward is running, the innermost last.
        self._running: list[nn.Module] = []
        #: What they were given.
        self._given: list[tuple[tuple[Any, ...], dict[str, Any]]] = []
        #: Of the call that the watcher saw last, if it wants its output to be followed.
        self._way: OutputWay | None = None
        self._thread = threading.get_ident()
        #: Whether a module of the policy ran in another thread.
        self._ran_elsewhere = False

    @property
    def in_this_thread(self) -> bool:
        """Whether the code that asks runs in the block's thread; what other threads call is not the block's."""
        return threading.get_ident() == self._thread

    def where(self) -> Where:
        """Return the innermost module of the policy whose forward is running.

        Raises:
            OtherPolicy: a module that the policy does not hold is running, and none of the policy's is.
        """
        if self._running:
            module = self._running[-1]
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
        """The innermost module whose forward is running, in words."""
        return f"module '{self.paths[id(self._running[-1])]}'" if self._running else "the policy"

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
        with torch.no_grad(), self._failing():
            return self.watcher.change(shape)

    def passes(self, shape: CallShape) -> bool:
        """Return whether a call that has run is none of the watcher's, and count it then."""
        ask = getattr(self.watcher, "passes", None)
        if ask is None:
            return False
        with self._failing():
            if not ask(shape):
                return False
        self._number += 1
        return True

    def expected(self, asked: CallShape) -> CallShape | None:
        """Return what a softmax by hand turns out to be, if blocks that looked at every function know.

        asked: its shape without a number. None: it is not known, or looked at again in this block.
        """
        return None if self._every_function or self.changes else self._known_policy.softmaxes.get(asked)

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
        # A softmax that was attention at some times and a gate at others must be followed every time: what was not
        # the same in every block, and at every softmax that looked alike, is unknown (None) from then on.
        known = self._known_policy.softmaxes
        always = {asked: shape for (asked, shape), times in self._met_values.items() if times == self._began[asked]}
        for asked in self._began:
            shape = always.get(asked)
            known[asked] = shape if known.get(asked, shape) == shape else None

    def saw(self, call: AttentionCall) -> None:
        """Tell the watcher about a call, and count it."""
        if call.shape.number != self._number:  # another call came between a softmax and its product
            call = replace(call, shape=replace(call.shape, number=self._number))
        inside = getattr(self.watcher, "inside", None)
        if inside is not None:
            with self._failing(), _without_modes():  # under the policy's autocast, which it keeps
                inside(call.shape, self._running, self._given)
        with self.computing():
            self._number += 1
            self._way = self.watcher.saw(call)

    def take_way(self) -> OutputWay | None:
        """Return how the output of the call that was just seen is followed, once."""
        way, self._way = self._way, None
        return way

    @contextmanager
    def computing(self) -> Iterator[None]:
        """Compute for the watcher beside the policy: without gradients, autocast and function modes."""
        with exact(), self._failing(), _without_modes():
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

    def close(self) -> None:
        """End a block whose code raised nothing.

        Raises:
            NotFollowed: the policy ran in another thread.
            ChangeRefused: a softmax was changed that is no attention.
            BaseException: an error of watching that the policy's code caught.
        """
        if self.error is not None:
            raise self.error
        if self.changed:
            raise ChangeRefused(
                f"A softmax that is no attention was changed as if it were the call {self.changed[0]}: it was "
                "multiplied with no values, as the gate of a mixture of experts. Give the layout's rule a kind or "
                "a number of keys that this softmax does not have, or leave its block out."
            )
        if self._ran_elsewhere:
            raise NotFollowed(
                f"The policy ({type(self.policy).__name__}) ran in another thread than the block that records it. Open "
                "the block in the thread that calls the policy, around that one call, and let no other thread call it "
                "meanwhile."
            )
        self._learn()

    @contextmanager
    def following_modules(
        self,
        at_module: Callable[[], None],
        around_projection: Callable[[nn.Module, Callable[..., Any]], Callable[..., Any]],
    ) -> Iterator[None]:
        """Keep track of which modules run.

        `at_module` is called where a module begins or ends, `around_projection` returns what stands in place of the
        forward of a module to which outputs are followed. Hooks would not do: `module.forward(...)` skips them, and so
        do some fast paths.
        """
        wanted = {id(module) for module in getattr(self.watcher, "output_modules", ())}
        replaced: list[_Forward] = []

        def replace_forward(module: nn.Module, call: Callable[..., Any]) -> None:
            replaced.append(_Forward(module, around_projection(module, call) if id(module) in wanted else call))

        try:
            for module in self._known_policy.attending:
                replace_forward(module, self._followed(module, module.forward, at_module))
            for module in self._known_policy.simple:
                replace_forward(module, self._noticed(module.forward, at_module))
            yield
        finally:
            for forward in replaced:
                forward.give_back()

    def _noticed(self, forward: Callable[..., Any], at_module: Callable[[], None]) -> Callable[..., Any]:
        """Return the forward of a simple module, in which no attention runs."""

        def noticed(*args: Any, **kwargs: Any) -> Any:
            if self.in_this_thread:
                at_module()
            else:
                self._ran_elsewhere = True
            return forward(*args, **kwargs)

        return noticed

    def _followed(
        self, module: nn.Module, forward: Callable[..., Any], at_module: Callable[[], None]
    ) -> Callable[..., Any]:
        running, given = self._running, self._given

        def followed(*args: Any, **kwargs: Any) -> Any:
            if not self.in_this_thread:
                self._ran_elsewhere = True
                return forward(*args, **kwargs)
            at_module()
            running.append(module)
            given.append((args, kwargs))
            try:
                return forward(*args, **kwargs)
            finally:
                running.pop()
                given.pop()
                at_module()

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
        #: What stood there on the instance before: a library's wrapper, as of accelerate; None: the class's forward.
        self.before = module.__dict__.get("forward")
        self.call = call
        module.__dict__["forward"] = self

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.call(*args, **kwargs)

    def __reduce__(self) -> tuple[Any, ...]:
        return _own_forward, (self.module, self.before)

    def give_back(self) -> None:
        """Give the module its own forward again, unless the policy's code has set another one meanwhile."""
        self.call = _own_forward(self.module, self.before)
        if self.module.__dict__.get("forward") is not self:
            return
        if self.before is None:
            del self.module.__dict__["forward"]
        else:
            self.module.__dict__["forward"] = self.before


def _own_forward(module: nn.Module, before: Callable[..., Any] | None) -> Callable[..., Any]:
    return types.MethodType(type(module).forward, module) if before is None else before


def _frame_owners() -> Iterator[object]:
    """Yield the `self` of the functions that are running, the innermost first."""
    frame = sys._getframe(2)
    while frame is not None:
        code = frame.f_code
        if code.co_argcount and code.co_varnames[0] == "self":
            yield frame.f_locals.get("self")
        frame = frame.f_back  # type: ignore[assignment]
