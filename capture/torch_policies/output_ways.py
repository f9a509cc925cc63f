"""The outputs of attention calls on their way to the residual stream, kept as functions that can be run again.

What a policy computes of an output is kept as a replay: a function of the output, for as long as it is linear in it
(copies, folds, products with other tensors, linear layers, sums). With another output, such as one part of the keys'
share, the replay gives what that part becomes. Factors that are made of the output itself, as by a norm, stay those of
the call.

The sum of such a tensor with another one as large may be the residual stream. Whether it is shows later: the stream is
added to something that is computed of it (a feed-forward layer's output, the next attention's). Where the sum itself is
scaled or projected and then added once more, it was none (a value residual, a gated branch), and the later sum is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from vla_attention.capture.torch_policies.tensor_table import TensorTable, tensors_among

#: Numbers in the axes of a call's result -> what the policy made of them, float32.
Replay = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Projected:
    """A replay that is one linear layer and folds: of an output (batch, query, head · dim) it gives weight · output.

    weight: (width, head · dim), None before the layer. bias: (width,). gate: what that is multiplied with afterwards.
    """

    weight: Tensor | None = None
    bias: Tensor | None = None
    gate: Tensor | None = None


#: Functions by their names without underscores: those of the same numbers, whatever their precision and device.
_COPIES = {
    "to", "type", "type_as", "float", "half", "bfloat16", "double", "contiguous", "clone", "detach", "cpu", "cuda",
    "requires_grad",
}  # fmt: skip
_FOLDS = {
    "view", "reshape", "flatten", "unflatten", "ravel", "squeeze", "unsqueeze", "transpose", "swapaxes", "swapdims",
    "permute", "movedim", "t", "get", "view_as", "reshape_as", "expand", "expand_as", "repeat", "repeat_interleave",
    "chunk", "split", "unbind", "narrow", "select", "index_select", "getitem", "flip", "roll", "gather",
    "take_along_dim",
}  # fmt: skip
#: Those that keep every number, and each once.
_ARRANGES = {
    "view", "reshape", "flatten", "unflatten", "ravel", "squeeze", "unsqueeze", "transpose", "swapaxes", "swapdims",
    "permute", "movedim", "view_as", "reshape_as",
}  # fmt: skip
#: What is replayed in their place: the output of the replay may lie otherwise in memory than the call's.
_RESHAPES = {"view": Tensor.reshape, "view_as": Tensor.reshape_as}
#: Sums that change what they add, or where.
_FUSED_PRODUCTS = {"addmm", "addbmm", "baddbmm"}
_FUSED_SUMS = {"addcmul", "lerp", "index_add", "scatter_add"} | _FUSED_PRODUCTS
_SUMS = {"add", "radd", "iadd", "sub", "rsub", "isub"} | _FUSED_SUMS
_MATRIX_PRODUCTS = {"linear", "matmul", "bmm", "mm", "einsum", "rmatmul", "conv1d"}
_PRODUCTS = {"mul", "rmul", "imul"} | _MATRIX_PRODUCTS
_QUOTIENTS = {"div", "truediv", "itruediv", "true_divide"}
_JOINS = {"cat", "concat", "stack", "sum", "mean", "neg"}
_STACKS, _SUMS_OF_STACKS = {"cat", "concat", "stack"}, {"sum", "mean"}
#: Functions that choose some of the numbers, by a mask or by places.
_CHOICES = {"where", "masked_fill", "index_copy", "index_put", "scatter", "slice_scatter", "select_scatter"}
#: Functions that keep the numbers of a range, and are copies where all of them are in it.
_RANGES = {"clamp", "clip", "clamp_min", "clamp_max", "nan_to_num", "hardtanh"}
#: Functions that multiply every number with a factor of its own: a norm, or a dropout.
_SCALES = {"rms_norm", "dropout"}
#: Functions that write one tensor into another.
_WRITES = {"setitem", "copy", "index_copy", "index_put", "slice_scatter", "select_scatter", "scatter", "masked_scatter"}
#: Norms, behind which the stream goes on where they stand after the sum.
_NORMS = {"rms_norm", "layer_norm", "group_norm", "instance_norm", "batch_norm", "normalize"}


#: Functions whose result has numbers of their first argument only, or none of what they are given.
_OF_THE_FIRST = _COPIES | {"view_as", "reshape_as", "expand_as"}
_OF_NONE = {
    "zeros_like", "ones_like", "empty_like", "full_like", "randn_like",
    "new_zeros", "new_ones", "new_empty", "new_full",
}  # fmt: skip


def used_tensors(name: str, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Iterator[Tensor]:
    """Yield the tensors whose numbers a function may use; name: its own without underscores."""
    given = () if name in _OF_NONE else args[:1] if name in _OF_THE_FIRST and args else (*args, *kwargs.values())
    return tensors_among(given)


@dataclass(frozen=True)
class _Taken:
    """What was kept of a sum.

    projected: whether a matrix product stands between it and the attention, or the sum before. sums: those before that
    are in it. computed: it is a sum with something that is computed of a sum before. doubtful: that one may be the
    stream as well.
    """

    kept: Any
    shape: torch.Size
    projected: bool
    sums: tuple[int, ...]
    computed: bool
    doubtful: bool


@dataclass(eq=False)
class OutputWay:
    """The output of one attention call, to be followed to the residual stream.

    Attributes:
        take: until the stream is found, makes of a replay, of its `Projected` (or None), and of what the policy added,
            what is kept of it, and whether the recorded queries are in it. It raises `NotReplayed` where the two
            differ.
        expected: the number of the sum that was the stream in calls like this one, beyond which nothing is followed;
            None: not known.
        taken: what was kept, of each sum that may be the residual stream.
        nothing: what was kept where the recorded queries are not in a sum: other tokens', or behind a gate of 0.
        lost: why it is not known what is added; "" where nothing stands against it.
        mixes_rows: whether what one row of the batch gave is added to others. turned: whether heads and queries of the
            call are exchanged.
        found: whether the residual stream is known; it is the last of `taken` then.
        changed: what was done to it first that is not linear, as "module 'x' computes tanh of".
        carried, bent: the numbers of the sums that reached another sum as they are or behind a norm, and by a function
            that is not linear, as a gate does. A sum that is bent alone is not the stream. left: whether the stream has
            left the network, and what follows is of the next denoise step.
        dtypes: of all that is followed.
    """

    take: Callable[[Replay, Projected | None, Tensor], tuple[Any, bool]] | None
    expected: int | None = None
    taken: list[_Taken] = field(default_factory=list, init=False)
    nothing: Any = field(default=None, init=False)
    lost: str = field(default="", init=False)
    mixes_rows: bool = field(default=False, init=False)
    turned: bool = field(default=False, init=False)
    found: bool = field(default=False, init=False)
    changed: str = field(default="", init=False)
    carried: set[int] = field(default_factory=set, init=False)
    bent: set[int] = field(default_factory=set, init=False)
    left: bool = field(default=False, init=False)
    dtypes: set[torch.dtype] = field(default_factory=set, init=False)

    @property
    def is_bent(self) -> bool:
        """Whether the last sum reached others by functions alone that are not linear."""
        return len(self.taken) in self.bent - self.carried

    def result(self) -> Any:
        """Return what was kept of the sum that is the residual stream; None, and `lost` says why, where none is."""
        if not self.lost and not self.taken and self.nothing is not None:
            return self.nothing
        if not self.lost and not self.taken:
            computed = f"; {self.changed} it" if self.changed else ""
            self.lost = f"what the attention gave is added to no tensor of the same shape{computed}"
        if self.lost:
            return None
        last = self.taken[-1]
        if not self.found and (last.computed or len(last.sums) < len(self.taken) - 1):
            self.lost = "what the attention gave is added to several tensors, none of which shows to be the stream"
        elif not self.found and self.is_bent:
            self.lost = "a sum with what the attention gave reaches others by functions alone that are not linear"
        return None if self.lost else last.kept


class NotReplayed(Exception):
    """A replay that gives something else than what the policy computed; the message says what.

    mixes_rows: rows of the batch add to one another's. turned: heads and queries are exchanged.
    """

    def __init__(self, message: str, *, mixes_rows: bool = False, turned: bool = False) -> None:
        super().__init__(message)
        self.mixes_rows, self.turned = mixes_rows, turned


@dataclass(frozen=True)
class _Step:
    """What a tensor is to an output.

    Attributes:
        replay: None where it is not linear in it.
        sums: the numbers of the sums that it comes from, in order, from 1.
        is_sum: whether it is the last of them, and not something computed of it.
        projected: whether a matrix product stands on its way, from the last sum on.
        factor: whether it is made of numbers such as those by which a norm divides.
        stacked: how many numbers each of the tensors has that stand beside one another in it; 0 where none do.
        projected_by: the replay as one linear layer, where it is that.
        goes_on: whether it is the last of the sums behind norms, or written into another tensor.
    """

    replay: Replay | None
    sums: tuple[int, ...] = ()
    is_sum: bool = False
    projected: bool = False
    factor: bool = False
    goes_on: bool = False
    stacked: int = 0
    projected_by: Projected | None = None


_Steps = Sequence[tuple[Tensor, _Step]]


class OutputWays:
    """Follows the outputs of attention calls in one thread.

    running: the module that is running, in words. computing: for computing beside the policy.
    entries: of the tensors that are followed; empty where none is.
    """

    def __init__(self, running: Callable[[], str], computing: Callable[[], AbstractContextManager[None]]) -> None:
        self._table: TensorTable[dict[OutputWay, _Step]] = TensorTable()
        self.entries = self._table.entries
        self._running, self._computing = running, computing

    def begin(self, way: OutputWay, result: Tensor) -> None:
        """Follow the output of a call that has just run; result: what the policy got of it."""
        self._put([result], way, _Step(lambda given: given, projected_by=Projected()))

    def note_other_use(self, way: OutputWay, probabilities: Sequence[Tensor]) -> None:
        """Follow the probabilities of a call too: keys give more through them than through the call's output."""
        self._put(probabilities, way, _Step(None))

    def follow(self, function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any], run: Callable[[], Any]) -> Any:
        """Run a function, and note what its result is to the outputs that are followed."""
        name = getattr(function, "__name__", "").strip("_")
        used = used_tensors(name, args, kwargs)
        known = [(tensor, steps) for tensor in used if (steps := self._table.get(tensor)) is not None]
        if not known:
            return run()
        call = _Call(name, function, args, kwargs)
        if call.in_place:
            with self._computing():
                call.first = args[0].clone()
        call.result = run()
        results = list(tensors_among((args[0] if name == "setitem" else call.result,)))
        for way in {way for _, steps in known for way in steps} if results else ():
            self._step(way, call, [(tensor, steps[way]) for tensor, steps in known if way in steps], results)
        return call.result

    def _step(self, way: OutputWay, call: _Call, steps: _Steps, results: Sequence[Tensor]) -> None:
        """Note what a function made of what is followed of one output."""
        from_start = any(not step.sums and not step.factor for _, step in steps)
        if way.found:
            if from_start and (call.name in _SUMS or call.name == "setitem"):
                self._lose(way, "adds something else that is computed of")
            else:
                self._put(results, way, _Step(None))
        elif call.in_place and self._shares_stream(way, call.args[0]):
            self._lose(way, "writes over a part of a sum with")
        elif call.name in _SUMS:
            self._add(way, call, steps, results[0])
        elif (call.name in _SUMS_OF_STACKS and steps[0][1].stacked == results[0].numel()) or (
            call.name in _CHOICES and any(step.is_sum for _, step in steps)
        ):
            self._sum(way, call, steps, results[0])
        else:
            sums = _sums(steps)
            projected = call.name in _MATRIX_PRODUCTS or any(step.projected for _, step in steps)
            replay = self._replay(call, steps)
            if replay is not None:
                is_sum = call.name in _COPIES | _FOLDS | _RANGES | _WRITES and any(step.is_sum for _, step in steps)
                stacked = steps[0][1].stacked if call.name in _FOLDS else 0
                if call.name in _STACKS and len(list(used_tensors(call.name, call.args, call.kwargs))) > len(steps):
                    stacked = steps[0][0].numel()
                by = call.projected(steps)
                for position, result in enumerate(results):
                    picked = replay if isinstance(call.result, Tensor) else _picked(replay, position)
                    step = _Step(picked, sums, is_sum, projected, stacked=stacked, projected_by=by)
                    self._put([result], way, step)
                return
            factor = all(step.factor for _, step in steps) or _is_norm(call.name, steps, results)
            if not way.changed and any(step.replay is not None for _, step in steps) and not factor:
                way.changed = f"{self._running()} computes {call.name} of"
            goes_on = _goes_on(call, steps)
            self._put(results, way, _Step(None, sums, goes_on=goes_on, projected=projected, factor=factor))

    def _add(self, way: OutputWay, call: _Call, steps: _Steps, result: Tensor) -> None:
        """Note a sum, which may be the residual stream."""
        sums, projected = _sums(steps), any(step.projected for _, step in steps) or call.name in _FUSED_PRODUCTS
        others = [
            tensor
            for tensor in tensors_among((*call.args, *call.kwargs.values()))
            if tensor.shape == result.shape and all(tensor is not known for known, _ in steps)
        ]
        streams = [step for _, step in steps if step.is_sum]
        rest = [step for _, step in steps if not step.is_sum]
        nonlinear = [step for step in rest if step.replay is None]
        beside = [step for step in rest if not step.sums]
        if any(step.factor for step in rest):
            factor = all(step.factor for step in rest) and not streams
            self._put([result], way, _Step(None, sums, projected=projected, factor=factor))
        elif streams and any(streams[0].sums[-1] in step.sums for step in rest):
            self._find(way, streams[0].sums[-1])
        elif nonlinear and (streams or (sums and beside) or (others and any(step.replay is None for step in beside))):
            self._lose(way)
        elif (
            len(nonlinear) > 1
            and sums
            and (sums[-1] in way.carried or (way.left and not way.is_bent) or any(step.goes_on for step in nonlinear))
        ):
            self._find(way, sums[-1])
        elif nonlinear and others and projected and not self._left(way, sums, result):
            self._lose(way, "adds something else that is computed of a sum with")
        elif nonlinear:
            of_all = () if any(not step.sums for _, step in steps) else sums
            way.left = way.left or (bool(sums) and self._left(way, sums, result))
            if not way.left:
                carried = [step for step in rest if step.sums and (step.replay is not None or step.goes_on)]
                way.carried.update(step.sums[-1] for step in carried)
                way.bent.update(number for step in nonlinear for number in step.sums)
            goes_on = len(rest) == 1 and rest[0].goes_on
            self._put([result], way, _Step(None, of_all, goes_on=goes_on, projected=projected))
        elif (others and not streams) or (streams and rest):
            self._sum(way, call, steps, result)
        else:
            self._put([result], way, _Step(self._replay(call, steps), sums, bool(streams), projected))

    def _sum(self, way: OutputWay, call: _Call, steps: _Steps, result: Tensor) -> None:
        """Take a sum with another tensor as large for the residual stream, until another one shows to be it."""
        sums, projected = _sums(steps), any(step.projected for _, step in steps)
        before = way.taken[sums[-1] - 1] if sums else None
        if before is not None and self._left(way, sums, result):
            return
        replay = self._replay(call, steps)
        if replay is None:
            way.changed = way.changed or f"{self._running()} computes {call.name} of"
            self._lose(way)
            return
        of_added, added, by = replay, result, None
        if len(steps) == 1 and call.name in _SUMS - _FUSED_SUMS and steps[0][0].shape == result.shape:
            # What is added is compared, for the stream may be many times as large.
            tensor, step = steps[0]
            factor = 1 if call.args[:1] and call.args[0] is tensor else call.kwargs.get("alpha", 1)
            added = call.first if call.first is not None and call.args[0] is tensor else tensor
            of_tensor = step.replay
            assert of_tensor is not None
            of_added, by = (of_tensor, step.projected_by) if factor == 1 else (_scaled(of_tensor, factor), None)
            added = added if factor == 1 else factor * added
        assert way.take is not None
        taken, there = None, False
        with self._computing():
            try:
                taken, there = way.take(of_added, by, added.detach())
            except NotReplayed as error:
                way.lost, way.mixes_rows, way.turned = str(error), error.mixes_rows, error.turned
            except (RuntimeError, TypeError, ValueError, IndexError) as error:
                way.lost = f"what the policy does with it cannot be computed again ({error})"
        if way.lost:
            self._lose(way)
        elif not there:
            way.nothing = taken
        else:
            computed = before is not None and not any(step.is_sum for _, step in steps)
            doubtful = computed and (not projected or (before is not None and before.projected))
            way.taken.append(_Taken(taken, result.shape, projected, sums, computed, doubtful))
            if len(way.taken) == way.expected:
                way.found, way.take = True, None
                self._change(way, lambda step: None)
                return
            self._put([result], way, _Step(replay, (*sums, len(way.taken)), is_sum=True))

    def _left(self, way: OutputWay, sums: tuple[int, ...], result: Tensor) -> bool:
        """Whether the stream has left the network in a sum: what became of it is added to noisy actions."""
        before = way.taken[sums[-1] - 1]
        return before.projected and before.shape != result.shape

    def _replay(self, call: _Call, steps: _Steps) -> Replay | None:
        with self._computing():
            return call.replay(steps)

    def _shares_stream(self, way: OutputWay, written: Tensor) -> bool:
        """Whether a tensor is a part of another one that may be the residual stream."""
        return written._is_view() and any(
            way in steps
            and steps[way].is_sum
            and (tensor := reference()) is not None
            and tensor is not written
            and tensor.untyped_storage().data_ptr() == written.untyped_storage().data_ptr()
            for reference, steps in list(self.entries.values())
        )

    def _find(self, way: OutputWay, number: int) -> None:
        """Say which sum is the residual stream. What came before it is followed on: it may be added once more."""
        if way.taken[number - 1].doubtful:
            self._lose(way, "adds a multiple of a sum with")
            return
        way.found, way.take = True, None
        del way.taken[number:]
        self._change(way, lambda step: None if number in step.sums or step.factor else _Step(None))

    def _lose(self, way: OutputWay, what: str = "") -> None:
        """Note why it is not known what is added: what the running module does, or what it did before."""
        way.take = None
        computed = f"{self._running()} {what}" if what else way.changed
        computed = computed or f"{self._running()} uses its probabilities again, beside"
        way.lost = way.lost or f"{computed} what the attention gave"
        self._change(way, lambda step: None)

    def _change(self, way: OutputWay, change: Callable[[_Step], _Step | None]) -> None:
        for _, steps in list(self.entries.values()):
            step = change(steps.pop(way)) if way in steps else None
            if step is not None:
                steps[way] = step
        self._table.keep(bool)

    def _put(self, tensors: Sequence[Tensor], way: OutputWay, step: _Step) -> None:
        for tensor in tensors:
            way.dtypes.add(tensor.dtype)
            self._table.put(tensor, {**(self._table.get(tensor) or {}), way: step})


@dataclass
class _Call:
    """A function of torch that was given tensors that are followed.

    name: without underscores. first: of a function that writes over its first argument, a copy of that.
    """

    name: str
    function: Any
    args: tuple[Any, ...]
    kwargs: Mapping[str, Any]
    first: Tensor | None = None
    result: Any = None

    @property
    def in_place(self) -> bool:
        """Whether it writes over its first argument."""
        name = getattr(self.function, "__name__", "")
        return (name.endswith("_") and not name.endswith("__")) or name.startswith("__i") or name == "__setitem__"

    def replay(self, steps: _Steps) -> Replay | None:
        """Return the result as a function of an output, None where it is not linear in it."""
        linear = {id(tensor): step.replay for tensor, step in steps if step.replay is not None}
        if not linear or any(step.replay is None and not step.factor for _, step in steps) or "out" in self.kwargs:
            return None
        (tensor, step), single = steps[0], len(linear) == 1
        factors = len(linear) < len({id(tensor) for tensor, _ in steps})
        if self.name in _RANGES and single and torch.equal(self.result, tensor):
            return step.replay
        divided = self.name in _QUOTIENTS and id(self.args[0]) in linear and not self.kwargs.get("rounding_mode")
        if self.name in _SCALES and single and step.replay is not None:
            return _scaled(step.replay, (self.result.float() / tensor.float()).nan_to_num())
        once = sum(step.replay is not None for _, step in steps) == 1  # a square is not linear
        product = single and once and (self.name in _PRODUCTS or divided)
        if not product and (factors or self.name not in _COPIES | _FOLDS | _SUMS | _JOINS | _CHOICES):
            return None
        if self.name in _COPIES:
            return step.replay
        first = (self.first, *self.args[1:]) if self.in_place and id(self.args[0]) not in linear else self.args
        given, rebuilt = _flat(first, self.kwargs)
        given = [_Followed(linear[id(value)]) if id(value) in linear else value for value in given]
        function, in_place = _RESHAPES.get(self.name, self.function), self.in_place
        if in_place and hasattr(Tensor, self.name):  # of many outputs at once, nothing can be written into one tensor
            function, in_place = getattr(Tensor, self.name), False

        def replay(output: Tensor) -> Tensor:
            values = [_filled(value, output) for value in given]
            if in_place:
                values[0] = values[0].clone()
            args, kwargs = rebuilt(values)
            result: Tensor = function(*args, **kwargs)
            return result

        return replay

    def projected(self, steps: _Steps) -> Projected | None:
        """Return what the result is of the one tensor that is followed, as one linear layer; None: something else."""
        (tensor, step), *others = steps
        by = step.projected_by
        if by is None or others or not isinstance(self.result, Tensor) or step.sums:
            return None
        same = self.result.shape == tensor.shape
        if (self.name in _COPIES | {"getitem"} and same) or (self.name in _ARRANGES and by.gate is None):
            return by
        if self.name == "linear" and by.weight is None and self.args[0] is tensor and len(self.args) > 1:
            bias = self.args[2] if len(self.args) > 2 else self.kwargs.get("bias")
            return Projected(self.args[1].detach(), None if bias is None else bias.detach())
        operands = list(tensors_among(self.args))
        if self.name == "mul" and by.weight is not None and by.gate is None and len(operands) == 2 and same:
            return Projected(by.weight, by.bias, operands[operands[0] is tensor].detach())
        return None


def _flat(
    args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> tuple[list[Any], Callable[[list[Any]], tuple[Sequence[Any], Mapping[str, Any]]]]:
    """Return the arguments of a function as a list, and a function that makes both of such a list again."""
    given, names, count = [*args, *kwargs.values()], tuple(kwargs), len(args)
    if not any(isinstance(value, list | tuple | dict) for value in given):
        return given, lambda values: (values[:count], dict(zip(names, values[count:], strict=True)))
    given, form = pytree.tree_flatten((args, dict(kwargs)))
    return given, lambda values: pytree.tree_unflatten(values, form)


def _sums(steps: _Steps) -> tuple[int, ...]:
    return tuple(sorted({number for _, step in steps for number in step.sums}))


def _is_norm(name: str, steps: _Steps, results: Sequence[Tensor]) -> bool:
    """Whether of the numbers on the last axis of a tensor one is made: by this a norm divides."""
    shape = steps[0][0].shape
    norms = (*shape[:-1], 1), tuple(shape[:-1])
    several = len(shape) > 0 and shape[-1] > 1
    return several and name not in _MATRIX_PRODUCTS and all(tuple(result.shape) in norms for result in results)


def _goes_on(call: _Call, steps: _Steps) -> bool:
    """Whether a result is a sum behind a norm, scaled by a weight for each channel, or written somewhere."""
    kept = _COPIES | _FOLDS | _SCALES | {"mul", "rmul", "imul"}
    used = used_tensors(call.name, call.args, call.kwargs)
    weighs = sum(tensor.numel() == steps[0][0].numel() for tensor in used) == 1
    norm = call.name in _NORMS | _WRITES and all(step.is_sum or step.goes_on for _, step in steps)
    return norm or (call.name in kept and weighs and all(step.goes_on for _, step in steps))


@dataclass(frozen=True)
class _Followed:
    """An argument of a function that is computed again."""

    replay: Replay


def _filled(value: Any, output: Tensor) -> Any:
    if isinstance(value, Tensor):
        return value.float() if value.is_floating_point() else value
    return value.replay(output) if isinstance(value, _Followed) else value


def _scaled(replay: Replay, factor: Any) -> Replay:
    return lambda given: replay(given) * factor


def _picked(replay: Callable[[Tensor], Any], position: int) -> Replay:
    return lambda given: replay(given)[position]
