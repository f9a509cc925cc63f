"""Following the output of an attention call from function to function, until a policy adds it to its residual stream.

The way leads to the output projection that the layout names, and from what this returns to an addition. On it the
output may be copied, cast, folded and transposed, multiplied and divided, and normalised by an RMS norm. With the
factors of the call all of that is linear: parts of the output take the same way, and add up to what was added. Where
something else is done to it, it is not followed any further.

It is added to the residual stream where the other summand is older than the attention call, or made of an older tensor
by copies, factors and sums. The sum with a younger tensor, that of a parallel feed-forward layer, is followed too, but
may only be added to the stream as it is. What is multiplied with a gate and then added to another older tensor was not
the stream, but the sum of two branches.

The output must pass no other way: where a tensor that is made of it (by an adapter beside the projection, say) meets it
on its way, or the stream later, more than the projection gave is added.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from vla_attention.capture.torch_policies.added_updates import AddedUpdate, OutputWay, factors_between
from vla_attention.capture.torch_policies.attention_calls import TOLERANCE
from vla_attention.capture.torch_policies.softmax_axes import Axes, in_order
from vla_attention.capture.torch_policies.tensor_functions import (
    PRODUCTS,
    QUOTIENTS,
    SAME_NUMBERS,
    SUMS,
    TensorTable,
    axes_after,
    no_dropout,
    tensors_among,
)
from vla_attention.capture.torch_policies.watched_block import WatchedBlock

_RMS_NORMS = {torch.nn.functional.rms_norm, torch.rms_norm}
#: Functions whose result is as old as what they are given.
_AGELESS = {
    *SAME_NUMBERS, *PRODUCTS, *QUOTIENTS, *SUMS, Tensor.__getitem__, Tensor.expand, Tensor.expand_as, Tensor.chunk,
    torch.chunk, Tensor.split, torch.split, Tensor.narrow, torch.narrow, Tensor.unbind, torch.unbind,
}  # fmt: skip
#: How many arguments of a function count: of type_as and view_as one, of zeros_like none, whose numbers are not used.
_COUNTING = {
    **dict.fromkeys((*SAME_NUMBERS, Tensor.expand_as), 1),
    **dict.fromkeys((torch.zeros_like, torch.ones_like, torch.empty_like, torch.full_like, torch.randn_like), 0),
    **dict.fromkeys((Tensor.new_zeros, Tensor.new_ones, Tensor.new_empty, Tensor.new_full, Tensor.new_tensor), 0),
}  # fmt: skip
#: Numbers that are all smaller are taken for zeros.
_TINY = 1e-30
#: For sentences: a tensor that is made of an output, and is none of the steps of its way.
_ANOTHER_WAY = "something else that is computed of what the attention gave"


@dataclass(frozen=True)
class _Place:
    """Where a tensor is on its way.

    Attributes:
        way: whose.
        sizes: of the output (batch, head, query, dim), or of what the projection returned, (batch, token, width).
        axes: how its axes are made of these, which may be divided; None: unknown.
        tokens: the action queries on the axis of queries or tokens.
        scaled: whether it was multiplied since the attention, or since the projection.
        joined: what was added, where it is the sum with a younger tensor.
    """

    way: OutputWay
    sizes: tuple[int, ...]
    axes: Axes | None
    tokens: slice
    scaled: bool = False
    joined: AddedUpdate | None = None

    @property
    def behind(self) -> bool:
        """Whether it is behind the projection."""
        return len(self.sizes) == 3

    @property
    def start(self) -> Tensor:
        """The numbers of the action queries before anything was multiplied, (batch, query, number) float32."""
        if not self.behind:
            return self.way.mixed
        assert self.way.projected is not None
        return self.way.projected

    def numbers(self, tensor: Tensor) -> Tensor | None:
        """Return the numbers of the action queries in the tensor, (batch, query, number) float32; None: unknown."""
        if self.axes is None:
            return None
        ordered = in_order(tensor.detach(), self.axes.parts, range(len(self.axes.sizes)), self.axes.sizes)
        ordered = ordered.reshape(self.sizes)
        ordered = ordered if self.behind else ordered.transpose(1, 2).flatten(2)
        return ordered[:, self.tokens].to(torch.float32, copy=True)


@dataclass(frozen=True)
class _Stream:
    """A tensor that is taken for the residual stream after the outputs of `ways` were added, that of `way` last.

    scaled: it was multiplied. summed: something else was added to it since.
    """

    way: OutputWay
    ways: frozenset[OutputWay]
    scaled: bool = False
    summed: bool = False


class OutputFollower:
    """Follows the outputs of attention calls in one thread; true while it follows any."""

    def __init__(self, block: WatchedBlock) -> None:
        self._block = block
        self._places: TensorTable[_Place] = TensorTable()
        self._streams: TensorTable[_Stream] = TensorTable()
        #: Of tensors that were made of outputs in any way: of which.
        self._derived: TensorTable[frozenset[OutputWay]] = TensorTable()
        #: The outputs that were not added yet.
        self._ways: list[OutputWay] = []
        #: When tensors were made, of those that were since outputs are followed.
        self._made: TensorTable[int] = TensorTable()
        self._clock = 0

    def __bool__(self) -> bool:
        return bool(self._places) or bool(self._streams)

    def begin(self, way: OutputWay, result: Tensor) -> None:
        """Follow the output of a call that has just run; result: what the policy got of it."""
        known = set(self._ways)
        for tensor in self._streams.tensors():
            if (stream := self._streams.get(tensor)) is not None:
                self._streams.put(tensor, replace(stream, summed=True))
                known |= stream.ways
        self._derived.keep(lambda ways: not ways.isdisjoint(known))
        self._derived.drop(result)
        if not self._ways:
            self._made.keep(lambda age: False)
        self._clock += 1
        way.began = self._clock
        self._ways.append(way)
        with self._block.computing():
            if way.projects:
                self._enter(way, result, (1, 0), way.queries)
            else:
                axes = None if way.output is None else _axes_of_output(result, way.output)
                self._put(result, _Place(way, way.sizes, axes, way.queries))
            way.output = None

    def awaits(self, module: nn.Module) -> bool:
        """Return whether an output is on its way to a projection."""
        return any(way.projection is module and way.projected is None for way in self._ways)

    def project(self, module: nn.Module, given: Tensor, result: Tensor) -> None:
        """Note what a projection was given and what it returned."""
        place_of_given = self._places.get(given)
        with self._block.computing():
            for way in self._ways:
                if way.projection is module and way.projected is None:
                    place = place_of_given if place_of_given is not None and place_of_given.way is way else None
                    self._project(way, place, given, result)

    def _project(self, way: OutputWay, place: _Place | None, given: Tensor, result: Tensor) -> None:
        way.dtypes.add(given.dtype)
        if torch._C._functorch.is_functorch_wrapped_tensor(given):
            way.misfit = "runs inside of torch.vmap, where tensors have no numbers"
            return
        if place is None or not place.scaled:
            # Whatever was done to it, these may be its numbers: other code than torch's may have moved them.
            order_and_tokens = _token_order(given, way.mixed, way)
            if order_and_tokens is None:
                way.misfit = "gets other numbers than the attention gave, or in another order"
                return
            self._enter(way, result, *order_and_tokens)
            return
        numbers = place.numbers(given)
        if numbers is None or place.axes is None:
            way.misfit = "gets what the attention gave scaled, and in an order of axes that is not known"
            return
        way.before = factors_between(place.start, numbers)
        # Which axis is the outer one. Scaled numbers cannot be compared with the output to tell the order of batch and
        # token; a wrong order shows in what the projection returns.
        outer = next((axis for part in place.axes.parts for axis in part if place.axes.sizes[axis] != 1), 0)
        self._enter(way, result, (0, 1) if outer == 0 or place.sizes[0] == 1 else (1, 0), way.queries)

    def _enter(self, way: OutputWay, result: Tensor, order: tuple[int, int], tokens: slice) -> None:
        """Follow what a projection returned; order: of its axes for batch (0) and token (1), before the width."""
        batch, width = way.sizes[0], result.shape[-1]
        sizes = batch, result.numel() // max(1, batch * width), width
        place = _Place(way, sizes, Axes(sizes, (order, (2,))).refolded(result.shape), tokens)
        numbers = place.numbers(result)
        if numbers is None:
            way.misfit = f"returns the shape {tuple(result.shape)}, in which the action queries are not known"
            return
        way.dtypes.add(result.dtype)
        way.projected = numbers
        self._put(result, place)

    def follow(self, function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any], run: Callable[[], Any]) -> Any:
        """Run a function, and follow what it makes of the tensors that are followed."""
        operands = (*args, *kwargs.values())
        given = list(tensors_among(operands[: _COUNTING.get(function, len(operands))]))
        followed = [(tensor, place) for tensor in given if (place := self._places.get(tensor)) is not None]
        if not followed and self._streams:
            return self._follow_stream(function, given, run)
        if len(followed) != 1:
            result = self._derive(function, given, run)
            self._left(function, given, [place for _, place in followed], result)
            return result
        tensor, place = followed[0]
        addition = None
        if place.behind and function in SUMS:
            with self._block.computing():  # before the tensor is written over
                addition = self._addition(args, kwargs, tensor, place)
        result = self._derive(function, given, run)
        if addition is None:
            if not self._moved(function, args, kwargs, tensor, place, result):
                self._left(function, given, [place], result)
            if any(place.way in self._ways_of(other) for other in given if other is not tensor):
                place.way.computed = f"{self._block.running_module} adds {_ANOTHER_WAY} to"
        elif addition.to_stream:
            self._finish(place.way, addition.added, given, result)
        else:
            self._put(result, replace(place, joined=addition.added))
        return result

    def _derive(self, function: Any, given: Sequence[Tensor], run: Callable[[], Any]) -> Any:
        """Run a function, and note of which outputs its result is made; given: its tensors."""
        ways = frozenset[OutputWay]().union(*map(self._ways_of, given))  # before one of them is written over
        result = run()
        if ways:
            for tensor in _written(function, given, result):
                self._derived.put(tensor, ways)
        return result

    def _ways_of(self, tensor: Tensor) -> frozenset[OutputWay]:
        """Return the outputs of which a tensor is made."""
        place, ways = self._places.get(tensor), self._derived.get(tensor) or frozenset()
        return ways if place is None else ways | {place.way}

    def _moved(
        self,
        function: Any,
        args: tuple[Any, ...],
        kwargs: Mapping[str, Any],
        tensor: Tensor,
        place: _Place,
        result: Any,
    ) -> bool:
        """Follow what a function made of a followed tensor; returns whether it can be followed."""
        first = args[0] if args else kwargs.get("input", kwargs.get("self"))
        if not isinstance(result, Tensor) or result.numel() != tensor.numel():
            return False
        if function in PRODUCTS or (function in QUOTIENTS and first is tensor and not kwargs.get("rounding_mode")):
            if result.shape != tensor.shape or place.joined is not None:
                return False
            by_one = any(isinstance(given, int | float) and given == 1 for given in args[1:2])
            self._put(result, replace(place, scaled=place.scaled or not by_one))
        elif first is not tensor:
            return False
        elif function in SAME_NUMBERS:
            axes = None if place.axes is None else axes_after(function, args, kwargs, place.axes, result)
            self._put(result, replace(place, axes=axes))
        elif no_dropout(function, args, kwargs):
            self._put(result, place)
        elif function is Tensor.__getitem__ and result.data_ptr() == tensor.data_ptr():  # axes of size 1
            axes = None if place.axes is None else place.axes.refolded(result.shape)
            self._put(result, replace(place, axes=axes))
        elif function in _RMS_NORMS and place.joined is None:
            self._put(result, replace(place, scaled=True))
        else:
            return False
        return True

    def _addition(
        self, args: tuple[Any, ...], kwargs: Mapping[str, Any], tensor: Tensor, place: _Place
    ) -> _Addition | None:
        """Return what a sum adds of a followed tensor to another one as large; None for other sums."""
        operands = (*args, *(kwargs[name] for name in ("input", "other") if name in kwargs))
        if len(operands) != 2:
            return None
        first, second = operands
        other = second if first is tensor else first
        factor = 1 if first is tensor else kwargs.get("alpha", 1)
        if not isinstance(other, Tensor) or other.numel() != tensor.numel() or place.way in self._ways_of(other):
            return None
        to_stream = self._may_be_stream(other, tensor, place.way) and not self._ways_of(other)
        if place.joined is not None:
            return None if factor != 1 else _Addition(place.joined, to_stream)
        numbers, way = place.numbers(tensor), place.way
        scaled = place.scaled or factor != 1
        if scaled and numbers is None:
            return None
        way.dtypes.add(tensor.dtype)
        factors = None
        if scaled and numbers is not None:
            factors = factors_between(place.start, numbers * factor)
        elif numbers is not None:
            way.mismatches.append(difference(numbers, place.start))
        return _Addition(way.added(factors), to_stream)

    def _finish(self, way: OutputWay, added: AddedUpdate, given: Sequence[Tensor], stream: Tensor) -> None:
        """End a way: its output was added to the residual stream; given: the summands."""
        before, again = self._streams_among(given)
        self._ways.remove(way)
        for tensor in self._places.tensors():
            if (place := self._places.get(tensor)) is not None and place.way is way:
                self._derived.put(tensor, self._ways_of(tensor))  # that it is added once more is another way
                self._places.drop(tensor)
        self._streams.put(stream, _Stream(way, before | {way}))
        self._derived.drop(stream)
        with self._block.computing():
            way.take(added)
        self._lose_again(again)

    def _follow_stream(self, function: Any, given: Sequence[Tensor], run: Callable[[], Any]) -> Any:
        """Run a function, and see whether the block adds more than the output to what was taken for the stream."""
        streams = [(tensor, stream) for tensor in given if (stream := self._streams.get(tensor)) is not None]
        _, again = self._streams_among(given)
        result = self._derive(function, given, run)
        if isinstance(result, Tensor) and any(result is tensor for tensor in given) and (ways := self._ways_of(result)):
            again |= ways.intersection(self._streams_among(self._streams.sharing(result))[0])  # a part written over
        self._left(function, given, [], result)
        self._lose_again(again)
        for tensor, stream in streams:
            if again or not isinstance(result, Tensor) or result.numel() != tensor.numel():
                continue
            if function in SAME_NUMBERS:
                self._streams.put(result, stream)
            elif function in PRODUCTS or function in QUOTIENTS:
                self._streams.put(result, replace(stream, scaled=stream.scaled or len(given) > 1))
            elif function in SUMS:
                with_older = any(self._may_be_stream(other, tensor, stream.way) for other in given)
                if stream.scaled and not stream.summed and with_older:
                    self._lose(stream.way, f"{self._block.running_module} adds a multiple of a sum with")
                else:
                    self._streams.put(result, replace(stream, summed=True))
        return result

    def _streams_among(self, given: Sequence[Tensor]) -> tuple[frozenset[OutputWay], frozenset[OutputWay]]:
        """Return the outputs that are in streams among tensors, and those of them that the tensors bring once more."""
        streams = [stream.ways for tensor in given if (stream := self._streams.get(tensor)) is not None]
        ways = frozenset[OutputWay]().union(*streams)
        return ways, ways.intersection(frozenset[OutputWay]().union(*map(self._ways_of, given)))

    def _lose_again(self, ways: frozenset[OutputWay]) -> None:
        """Take back that outputs were added to the residual stream: they are added to it in another way, too."""
        for way in ways:
            self._lose(way, f"{self._block.running_module} adds {_ANOTHER_WAY} to a sum with")

    def _lose(self, way: OutputWay, computed: str) -> None:
        """Take back that an output was added to the residual stream; computed: what was instead."""
        self._streams.keep(lambda stream: way not in stream.ways)
        way.computed = computed
        with self._block.computing():
            way.take(None)

    def _may_be_stream(self, other: object, tensor: Tensor, way: OutputWay) -> bool:
        """Return whether a summand is as large as a followed tensor, and older than the attention call."""
        return (
            isinstance(other, Tensor)
            and other is not tensor
            and other.numel() == tensor.numel()
            and (self._made.get(other) or 0) <= way.began
        )

    def _put(self, tensor: Tensor, place: _Place) -> None:
        place.way.computed = ""
        self._places.put(tensor, place)

    def _left(self, function: Any, given: Sequence[Tensor], places: Sequence[_Place], result: Any) -> None:
        """Note that what a function made is not followed; given: its tensors, places: of those that are followed."""
        made, written = list(tensors_among((result,))), _written(function, given, result)
        for tensor in written:
            self._places.drop(tensor)
        for place in places:
            if any(tensor.numel() >= place.start.numel() for tensor in written):
                of_what = "of" if place.joined is None else "of a sum with"
                place.way.computed = (
                    f"{self._block.running_module} computes {getattr(function, '__name__', function)} {of_what}"
                )
        # A sum with the residual stream is the stream, and as old as its oldest summand of full size. What copies and
        # factors make is as old as the youngest tensor that they were given; all else is new.
        ages = [self._made.get(tensor) or 0 for tensor in given]
        if function in SUMS and not places and made:
            whole = [age for age, tensor in zip(ages, given, strict=True) if tensor.numel() == made[0].numel()]
            ages = [min(whole, default=0)]
        if function in _AGELESS and not places:
            age = max(ages, default=0)
        else:
            self._clock += 1
            age = self._clock
        if age:
            for tensor in made:
                self._made.put(tensor, age)


def _written(function: Any, given: Sequence[Tensor], result: Any) -> list[Tensor]:
    """The tensors that a function wrote or made."""
    if getattr(function, "__name__", "") == "__setitem__":
        return list(given[:1])
    return list(tensors_among((result,)))


@dataclass(frozen=True)
class _Addition:
    """A sum with a followed tensor: what it adds, and whether to the residual stream."""

    added: AddedUpdate
    to_stream: bool


def difference(one: Tensor, other: Tensor) -> Tensor:
    """Return the largest difference from another tensor, relative to its largest number; a tensor without axes."""
    if not one.numel():
        return one.new_zeros(())
    return (one - other).abs().amax() / other.abs().amax().clamp(min=_TINY)


def _axes_of_output(result: Tensor, output: Tensor) -> Axes | None:
    """Return the axes of what a policy got as the output (batch, head, query, dim) of a call; None: unknown."""
    sizes = tuple(output.shape)
    for parts in (((0,), (1,), (2,), (3,)), ((0,), (2,), (1,), (3,)), ((0, 1), (2,), (3,))):
        if tuple(result.shape) == tuple(math.prod(sizes[axis] for axis in part) for part in parts):
            ordered = in_order(result.detach(), parts, (0, 1, 2, 3), sizes)
            if (ordered.data_ptr(), ordered.stride()) == (output.data_ptr(), output.stride()) or torch.equal(
                ordered, output
            ):
                return Axes(sizes, parts)
    return None


def _token_order(given: Tensor, numbers: Tensor, way: OutputWay) -> tuple[tuple[int, int], slice] | None:
    """Return in which order what a projection is given has the axes of batch (0) and token (1), and its action queries.

    numbers: those of the action queries, (batch, query, number). None: the projection is given others.
    """
    batch, _, queries, _ = way.sizes
    size = numbers.shape[-1]
    count, rest = divmod(given.numel(), max(1, batch * size))
    if rest or not count:
        return None
    start, stop, _ = way.queries.indices(queries)
    flat = given.detach().reshape(-1, size)
    most = TOLERANCE.get(way.precision, TOLERANCE["float32"])
    for order in ((0, 1), (1, 0)):
        tokens = flat.view(batch, count, size) if order == (0, 1) else flat.view(count, batch, size).transpose(0, 1)
        # The projection may be given the tokens of one expert only, the first or the last ones.
        for left_out in dict.fromkeys((0, queries - count, start)):
            if not 0 <= left_out <= start or stop - left_out > count:
                continue
            chosen = slice(start - left_out, stop - left_out)
            candidate = tokens[:, chosen].float()
            if torch.equal(candidate, numbers) or float(difference(candidate, numbers)) <= most:
                return order, chosen
    return None
