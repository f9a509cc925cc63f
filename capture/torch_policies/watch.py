"""Seeing every attention call of a torch policy while its own code runs.

`seen_functions` sees the functions that compute attention. Compiled parts run eager meanwhile, and the fast path of
`nn.MultiheadAttention`, which nothing sees, is off. The policy's own kernels compute what it returns: with nothing
changed, actions are bit-equal with those of the same policy run eager with the fast path off.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from vla_attention.capture.torch_policies.attention_calls import Watcher
from vla_attention.capture.torch_policies.policy_modules import find_policy
from vla_attention.capture.torch_policies.seen_functions import SeenFunctions
from vla_attention.capture.torch_policies.watched_block import WatchedBlock
from vla_attention.schemas.errors import BadArgument

_ACTIVE = threading.Lock()


class AlreadyWatched(BadArgument):
    """A block inside another one, or two at the same time."""


@contextmanager
def watch_attention(policy: object, watcher: Watcher, *, every_function: bool = True) -> Iterator[SeenFunctions]:
    """Tell `watcher` about every attention call of `policy` inside the block, in the thread of the block.

    The block gives `SeenFunctions`, whose `by_names` says whether `every_function` was needed.

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
        block = WatchedBlock(known_policy, watcher, every_function=every_function)
        functions = SeenFunctions(block, every_function=every_function)
        with (
            seen_by_python(),
            functions.names_replaced(),
            block.following_modules(functions.at_module, functions.around_projection),
            functions.seeing(),
        ):
            yield functions
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


class RandomNumbers:
    """The states of torch's random numbers, on the processor and every GPU, of numpy's and Python's, when made."""

    def __init__(self) -> None:
        self._cpu = torch.random.get_rng_state()
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        self._numpy = np.random.get_state()  # noqa: NPY002 - what the policy may draw from
        self._python = random.getstate()
        self._gpus = [torch.cuda.get_rng_state(device) for device in range(count)]

    def again(self) -> None:
        """Set the states to what they were."""
        torch.random.set_rng_state(self._cpu)
        np.random.set_state(self._numpy)  # noqa: NPY002
        random.setstate(self._python)
        for device, state in enumerate(self._gpus):
            torch.cuda.set_rng_state(state, device)
