"""What a policy call changes beside its result: random numbers, and what the policy's objects hold."""

from __future__ import annotations

import copy
import random
import types
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from vla_attention.capture.torch_policies.policy_modules import DEPTH, MANY, MODULE_ATTRIBUTES
from vla_attention.capture.torch_policies.watch import RandomNumbers

#: How deep is looked into what a call names: it may name a simulator.
_DEPTH_OF_CALL = 2
_PLAIN = (str, bytes, int, float, complex, bool, type(None), type, types.ModuleType, types.FunctionType, torch.dtype)


class CallState:
    """The state of a policy and of random numbers when this was made.

    Of the policy: the attributes of its modules and objects, the entries of lists, queues and dictionaries there, the
    numbers of tensors and arrays that are no weights, and generators. Of the repeatable call, and of the modules'
    hooks: generators, entries and attributes of what they name (`self`, variables around them, global ones). What is
    held elsewhere, or by code that is not Python's, is not seen.
    """

    def __init__(self, policy: object, call: Callable[..., Any]) -> None:
        self._random = RandomNumbers()
        #: By id: what was looked at. It is kept, so that no other object gets its id.
        self._seen: dict[int, object] = {}
        self._put_back: list[Callable[[], object]] = []
        self._reseed: list[Callable[[int], object]] = []
        owner = policy.__self__ if isinstance(policy, types.MethodType) else policy
        self._take(owner, DEPTH, numbers=True)
        for named in _named_by(call):
            self._take(named, _DEPTH_OF_CALL, numbers=False)

    def again(self) -> None:
        """Set everything to what it was."""
        self._random.again()
        for put_back in self._put_back:
            put_back()

    def reseed(self, seed: int) -> None:
        """Let all random numbers begin at a seed."""
        torch.manual_seed(seed)
        np.random.seed(seed % 2**32)  # noqa: NPY002 - the policy may draw from it
        random.seed(seed)
        for reseed in self._reseed:
            reseed(seed)

    def _take(self, part: Any, depth: int, *, numbers: bool) -> None:
        """Note the state of a part, and of what it holds down to `depth`; numbers: those of tensors and arrays too."""
        if isinstance(part, _PLAIN) or id(part) in self._seen or _is_ours(part):
            return
        self._seen[id(part)] = part
        if self._take_generator(part):
            return
        if isinstance(part, Tensor | np.ndarray):
            if numbers and not isinstance(part, nn.Parameter):
                self._put_back.append(_numbers_of(part))
            return
        if isinstance(part, list | deque | dict | set):
            self._put_back.append(_entries_of(part))
            held = list(part.values() if isinstance(part, dict) else part) if len(part) <= MANY else []
        elif isinstance(part, tuple | frozenset):
            held = list(part) if len(part) <= MANY else []
        elif isinstance(part, nn.Module):
            self._put_back.append(_entries_of(part.__dict__, MODULE_ATTRIBUTES))
            for child in part._modules.values():
                self._take(child, depth, numbers=numbers)
            for hook in (*part._forward_pre_hooks.values(), *part._forward_hooks.values()):
                for named in _named_by(hook):
                    self._take(named, min(depth, _DEPTH_OF_CALL), numbers=False)
            held = [part._buffers, *(value for name, value in part.__dict__.items() if name not in MODULE_ATTRIBUTES)]
        else:
            attributes = getattr(part, "__dict__", None)
            if not isinstance(attributes, dict):
                return
            self._put_back.append(_entries_of(attributes))
            held = list(attributes.values())
        for inner in held if depth else ():
            self._take(inner, depth if isinstance(inner, nn.Module) else depth - 1, numbers=numbers)

    def _take_generator(self, part: Any) -> bool:
        """Note the state of a generator of random numbers; return whether it is one."""
        if isinstance(part, torch.Generator):
            self._put_back.append(partial(part.set_state, part.get_state()))
            self._reseed.append(part.manual_seed)
        elif isinstance(part, np.random.Generator):
            bits, state = part.bit_generator, copy.deepcopy(part.bit_generator.state)
            self._put_back.append(lambda: setattr(bits, "state", state))
            self._reseed.append(lambda seed: setattr(bits, "state", type(bits)(seed).state))
        elif isinstance(part, np.random.RandomState):
            self._put_back.append(partial(part.set_state, part.get_state()))
            self._reseed.append(lambda seed: part.seed(seed % 2**32))
        elif isinstance(part, random.Random):
            self._put_back.append(partial(part.setstate, part.getstate()))
            self._reseed.append(part.seed)
        else:
            return False
        return True


def _is_ours(part: object) -> bool:
    # A call may name the run that records it, whose notes are not the policy's.
    return type(part).__module__.startswith("vla_attention.capture.torch_policies.")


def _entries_of(holder: Any, kept: frozenset[str] = frozenset()) -> Callable[[], None]:
    """Return what puts the entries of a list, queue, set or dictionary back; kept: names that stay as they are."""
    if isinstance(holder, dict):
        entries = {name: value for name, value in holder.items() if name not in kept}

        def put_back() -> None:
            for name in [name for name in holder if name not in entries and name not in kept]:
                del holder[name]
            holder.update(entries)

        return put_back
    values = list(holder)

    def fill() -> None:
        if len(holder) == len(values) and all(a is b for a, b in zip(holder, values, strict=True)):
            return
        holder.clear()
        (holder.update if isinstance(holder, set) else holder.extend)(values)

    return fill


def _numbers_of(part: Any) -> Callable[[], None]:
    """Return what puts the numbers of a tensor or an array back, if they were written to."""
    if isinstance(part, np.ndarray):
        values = part.copy()

        def fill() -> None:
            if part.flags.writeable and part.tobytes() != values.tobytes():
                part[...] = values

        return fill
    saved, inference = part.detach().clone(), part.is_inference()
    written = None if inference else part._version
    plain = type(part) is Tensor and part.layout is torch.strided and not part.is_meta

    def put_back() -> None:
        # The version counts neither what is written through `.data` nor the statistics of batch norms.
        if not inference and part._version == written and (not plain or torch.equal(part.detach(), saved)):
            return
        with torch.inference_mode(inference), torch.no_grad():
            part.detach().copy_(saved)

    return put_back


def _named_by(call: Callable[..., Any], depth: int = _DEPTH_OF_CALL) -> Iterator[object]:
    """What a callable names: arguments that it holds, `self`, the variables around it, and global ones.

    Functions that it names name more, down to `depth`.
    """
    if isinstance(call, partial):
        yield from (*call.args, *call.keywords.values())
        yield from _named_by(call.func, depth)
        return
    if isinstance(call, types.MethodType):
        yield call.__self__
        call = call.__func__
    if not isinstance(call, types.FunctionType):
        yield call
        return
    named = [cell.cell_contents for cell in call.__closure__ or () if _is_filled(cell)]
    named += [call.__globals__[name] for name in call.__code__.co_names if name in call.__globals__]
    for value in named:
        if not isinstance(value, types.FunctionType):
            yield value
        elif depth:
            yield from _named_by(value, depth - 1)


def _is_filled(cell: types.CellType) -> bool:
    try:
        return cell.cell_contents is not cell
    except ValueError:
        return False
