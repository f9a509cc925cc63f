"""What is known about one attention call of a policy, and who is told about it.

`watch_attention` (watch.py) makes one of every call. The policy's own kernel computes the output; rows are computed
beside it, for the wanted queries only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import torch
from msgspec import Struct
from torch import Tensor

from vla_attention.capture.torch_policies.output_ways import OutputWay
from vla_attention.schemas.errors import BadArgument

#: How a policy computes attention. `sdpa`: `scaled_dot_product_attention`. `softmax`: a softmax by hand whose result is
#: multiplied with values. `multihead`: `multi_head_attention_forward`, which `nn.MultiheadAttention` calls. `flex`:
#: `flex_attention`. transformers' attention interface calls one of these.
Kind = Literal["sdpa", "softmax", "multihead", "flex"]
#: Logits this far below the highest one of their row, or below 0, are of masked keys: masks are written as -inf, as the
#: lowest number of a dtype, as -1e9 or -1e4.
MASKED_BELOW = -5000.0
#: Keys this far below the highest one for every head are masked too: -100 is in use (Swin), and nothing that is read is
#: so far below for all heads at once.
MASK_DISTANCE = 80.0
#: Probabilities below this are none: such a mask leaves 1e-35 at most.
NO_MASS = 1e-30
#: Largest difference of numbers that are computed twice, relative to the largest of them, by the least precise dtype. A
#: float32 kernel leaves 1e-6, one of bfloat16 a few of its roundings; rows with a wrong mask are off by far more.
TOLERANCE = {"float32": 1e-3, "float64": 1e-3, "float16": 2e-2, "bfloat16": 6e-2}
#: Largest difference of a row's sum from 1, beside rounding.
_SUM_TOLERANCE = 1e-3


class RowsRefused(BadArgument):
    """Rows were wanted of an attention call whose keys or heads are not those that a layout can name."""


class CallShape(Struct, frozen=True):
    """What is known before the kernel of a call runs.

    Attributes:
        module: path of the innermost module of the watched policy whose forward is running, "" for the policy itself.
        kind: how attention is computed.
        number: position among all attention calls of the watched block, from 0.
        batch, heads, kv_heads, queries, keys: sizes of the axes. Before a softmax by hand has met its values,
            `kv_heads` is `heads`.
        dtype: of the tensors that the kernel gets, such as `bfloat16`.
    """

    module: str
    kind: Kind
    number: int
    batch: int
    heads: int
    kv_heads: int
    queries: int
    keys: int
    dtype: str

    @property
    def torch_dtype(self) -> torch.dtype:
        """Torch's own name of the dtype."""
        dtype: torch.dtype = getattr(torch, self.dtype)
        return dtype

    def __str__(self) -> str:
        heads = f"{self.heads} heads" if self.heads == self.kv_heads else f"{self.heads}/{self.kv_heads} heads"
        return f"{self.module or '(policy)'}: {self.kind}, {self.queries} x {self.keys}, {heads}, {self.dtype}"


@dataclass(frozen=True)
class AttentionCall:
    """One attention call, right after its kernel ran. Its tensors may be overwritten in place later.

    Attributes:
        shape: module, kind and sizes.
        values: (batch, kv_head, key, dim).
        output: what the policy's own kernel computed, (batch, head, query, dim), before any projection.
        rows_of: queries, rows of the batch -> float32 probabilities (batch, head, query, key).
        allowed_of: queries -> (batch, head or 1, query, key) bool, see `allowed`.
        laid_out: numbers (batch, head, query, dim) -> the same in the axes that the policy got its output in.
        multiplied: the dtype of the probabilities that met the values; None: the kernel's own.
        asked: the shape that the watcher was asked about before a softmax by hand, if its product has another one.
        refused: why rows and values of this call cannot be recorded, in words that follow "it"; "" where they can.
    """

    shape: CallShape
    values: Tensor
    output: Tensor
    rows_of: Callable[[slice, slice], Tensor]
    allowed_of: Callable[[slice], Tensor]
    laid_out: Callable[[Tensor], Tensor]
    multiplied: torch.dtype | None = None
    asked: CallShape | None = None
    refused: str = ""

    @property
    def value(self) -> Tensor:
        """The values (batch, kv_head, key, dim); errors as `rows`."""
        self._check_refused()
        return self.values

    def rows(self, queries: slice = slice(None), batch: slice = slice(None)) -> Tensor:
        """Return the probabilities of these queries, (batch, head, query, key) float32, exact zeros where masked.

        Raises:
            RowsRefused: the call's keys or heads are in an order that nothing tells.
        """
        self._check_refused()
        with exact():
            return self.rows_of(queries, batch)

    def _check_refused(self) -> None:
        if self.refused:
            refuse_rows(self.shape, self.refused)

    def allowed(self, queries: slice = slice(None)) -> Tensor:
        """Return (batch, head or 1, query, key) bool: keys that the policy's own mask lets the query see.

        The axis of heads has length 1 where all of them have the same mask.
        """
        with exact():
            return self.allowed_of(queries)

    @property
    def heads_may_be_queries(self) -> bool:
        """Whether nothing in a product by hand tells the two: as many of both, and heads that share their values."""
        shape = self.shape
        return shape.kind == "softmax" and 1 < shape.heads == shape.queries and self.values.shape[1] < shape.heads

    @property
    def precision(self) -> str:
        """The least precise dtype of what is multiplied and of its result: a softmax may be of higher precision."""
        dtypes = [self.value.dtype, self.output.dtype, self.shape.torch_dtype]
        dtypes += [] if self.multiplied is None else [self.multiplied]
        return str(max(dtypes, key=lambda dtype: torch.finfo(dtype).eps)).removeprefix("torch.")

    def product_error(self, rows: Tensor, queries: slice = slice(None)) -> float:
        """Return the largest |rows V - output| of these queries, relative to the largest |output| among them.

        rows: (batch, head, query, key) of the same queries. Rows that are those of the kernel give
        rounding errors: some 1e-7 where it computes in float32, some 1e-3 to 1e-2 where in bfloat16.
        """
        with exact():
            value = self.value.float()
            size, heads, count, keys = rows.shape
            # Heads that share a value head become extra queries of that head, without copies of the values.
            stacked = rows.reshape(size, value.shape[1], heads // value.shape[1] * count, keys)
            mixed = torch.matmul(stacked, value).reshape(size, heads, count, value.shape[3])
            output = self.output[:, :, queries].float()
            difference = (mixed - output).abs()
            if not difference.numel():
                return 0.0
            largest, scale = float(difference.max()), float(output.abs().max())
            return largest / scale if scale > 0 else (0.0 if largest == 0 else float("inf"))

    def unfit(self, rows: Tensor, error: float) -> str:
        """Return why rows cannot be stored, in words that follow "its rows"; "" where they can.

        rows: (batch, head, query, key). error: their `product_error`.
        """
        allowed = TOLERANCE.get(self.precision, TOLERANCE["float32"])
        if error > allowed:
            return (
                f"give a P·V that differs from the kernel's output by {error:.2g} of its largest number; allowed is "
                f"{allowed:g} for {self.precision}. The call ({self.shape.kind}) does something else than "
                "softmax(q kᵀ + mask) v. If the policy is in training mode, its dropout does: call policy.eval(). "
                "Otherwise report it with the library's version"
            )
        sums = rows.sum(dim=-1)
        # A query without any key has a row of zeros.
        wrong = ((sums - 1).abs() > max(allowed, _SUM_TOLERANCE)) & (sums != 0)
        if bool(wrong.any()):
            return (
                f"sum to {float(sums[wrong][0]):.4g} and not to 1 when they are multiplied with the values: the module "
                "changes them after the softmax, as dropout (call policy.eval()) and factors do, or its softmax has "
                "keys without values (trained sinks: name them in the layout, va.RecordedSite(sinks=...)). Such rows "
                "cannot be stored"
            )
        return ""


def refuse_rows(shape: CallShape, why: str) -> None:
    """Raise `RowsRefused` for a call; why: in words that follow "it"."""
    raise RowsRefused(f"The attention call {shape} cannot be recorded: it {why}.")


class Watcher:
    """Is told about every attention call of a watched block, in order. This one takes and changes nothing.

    changes: whether it is asked for changes at all. whole: whether every function of the block is watched; see
    `WatchedPlaces`. number: of the block among those of its kind that computed attention, from 0. modules: after the
    block, the ids of the policy's modules that ran. unmet: softmaxes that met no values, and the last function that
    their result was followed to.
    """

    changes: Any = False
    whole: bool = True
    number: int = 0
    modules: Set[int] = frozenset()
    unmet: Mapping[int, tuple[CallShape, str]] = MappingProxyType({})

    def change(self, shape: CallShape) -> Tensor | None:
        """Return logits to add before the softmax, broadcastable to (batch, head, query, key), or None for no change.

        Asked before the kernel runs. -inf takes a key away.
        """

    def passes(self, shape: CallShape) -> bool:
        """Return whether a call whose kernel has run is not wanted: nothing is made of its tensors then."""
        return False

    def sinks(self, shape: CallShape) -> int:
        """Return how many keys of a softmax, the last ones, have no values."""
        return 0

    def saw(self, call: AttentionCall) -> OutputWay | None:
        """Take what is wanted of a call, right after its kernel; in order. Return whether its output is followed."""

    def refuse(self, shape: CallShape, why: str) -> None:
        """Learn that a call that was seen has no rows, as its output's way shows."""
        refuse_rows(shape, why)


def exact() -> AbstractContextManager[object]:
    """Compute without gradients, and in the dtypes that are written, whatever autocast the policy runs under."""
    devices = [device for device in ("cpu", "cuda") if torch.is_autocast_enabled(device)]
    return _without_autocast(devices) if devices else torch.no_grad()


@contextmanager
def _without_autocast(devices: Sequence[str]) -> Iterator[None]:
    with torch.no_grad(), ExitStack() as stack:
        for device in devices:
            stack.enter_context(torch.autocast(device, enabled=False))
        yield
