"""Seeing every attention call of a torch policy while its own code runs.

One `TorchFunctionMode` sees the functions that compute attention. Compiled parts run eager meanwhile, and the fast path
of `nn.MultiheadAttention`, which nothing sees, is off. The policy's own kernels compute what it returns: with nothing
changed, actions are bit-equal with those of the same policy run eager with the fast path off.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

from vla_attention.capture.torch_policies import flex_calls, multihead_calls, sdpa_calls, softmax_calls
from vla_attention.capture.torch_policies.attention_calls import Watcher
from vla_attention.capture.torch_policies.policy_modules import find_policy
from vla_attention.capture.torch_policies.unseen_attention import (
    ATTENTION_OPERATOR,
    LOAD_WITH_SDPA,
    UnseenAttention,
)
from vla_attention.capture.torch_policies.watched_block import WatchedBlock
from vla_attention.schemas.errors import BadArgument, UserError

_OPERATORS = frozenset((torch._ops.OpOverload, torch._ops.OpOverloadPacket))
_ACTIVE = threading.Lock()


class AlreadyWatched(BadArgument):
    """A block inside another one, or two at the same time."""


@contextmanager
def watch_attention(policy: object, watcher: Watcher) -> Iterator[None]:
    """Tell `watcher` about every attention call of `policy` inside the block, in whatever thread it runs.

    policy: an `nn.Module`, an object that holds modules, or what `find_policy` made of one, which spares the search for
    modules at every block.

    Raises:
        AlreadyWatched: another block is open in this process.
        NoModules, CannotRunEager: see `modules_of`.
        OtherPolicy: attention of a module that the policy does not hold ran in the block.
        StillRunning: the policy still runs in another thread at the end.
        NotFollowed: it ran in another thread in methods that are no forward, and no attention was seen.
        UnseenAttention: the policy is set to attention that gives no rows, such as flash-attn's, or an operator that
            computes attention so ran.
        ChangeRefused: a change that does not fit its call, or that the call does not allow.
    """
    found = find_policy(policy)
    if not _ACTIVE.acquire(blocking=False):
        raise AlreadyWatched(
            "Attention is already recorded in another block of this process: blocks cannot be inside each other, and "
            "one block records one policy. Close the other block first."
        )
    try:
        block = WatchedBlock(found, watcher)
        try:
            with seen_by_python(), block.following_modules(lambda: _Mode(block)), _Mode(block):
                yield
        except BaseException:
            block.abandon()
            raise
        block.close()
    finally:
        _ACTIVE.release()


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


class _Mode(TorchFunctionMode):
    """Sees the torch functions of one thread."""

    def __init__(self, block: WatchedBlock) -> None:
        super().__init__()
        self._block = block
        self._softmaxes = softmax_calls.Softmaxes(block)
        #: Every function of the policy comes by here: one look at a dictionary says whether a softmax is followed.
        self._followed = self._softmaxes.followed
        self._handlers: dict[Any, Callable[..., Any]] = {
            **{function: self._attend(sdpa_calls.watch_call) for function in sdpa_calls.FUNCTIONS},
            **{function: self._attend(multihead_calls.watch_call) for function in multihead_calls.FUNCTIONS},
            **{function: self._attend(flex_calls.watch_call) for function in flex_calls.FUNCTIONS},
            **dict.fromkeys(softmax_calls.SOFTMAXES, self._softmaxes.softmax),
        }

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        handler = self._handlers.get(func)
        if handler is not None:
            return handler(func, args, kwargs or {})
        if type(func) in _OPERATORS:
            self._refuse_unseen(func)
        if self._followed:
            return self._softmaxes.follow(func, args, kwargs or {})
        return func(*args, **kwargs) if kwargs else func(*args)

    def _attend(self, watch_call: Callable[..., Any]) -> Callable[..., Any]:
        def attend(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
            try:
                return watch_call(self._block, func, args, kwargs)
            except UserError as error:  # the policy's code may catch it
                raise self._block.failed(error) from None

        return attend

    def _refuse_unseen(self, operator: Any) -> None:
        """Raise `UnseenAttention` for an attention operator that no handler knows."""
        name = str(getattr(operator, "_qualified_op_name", None) or operator.name())
        if ATTENTION_OPERATOR.match(name):
            raise self._block.failed(
                UnseenAttention(f"The operator {name} computes attention in a way that gives no rows. {LOAD_WITH_SDPA}")
            )
