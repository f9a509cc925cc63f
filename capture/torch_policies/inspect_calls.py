"""`va.inspect`: a table of the attention calls that a policy makes in one call of the user's."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import chain, pairwise
from typing import Any

from msgspec import structs
from torch import Tensor

from vla_attention.capture.policies.random_numbers import RandomNumbers
from vla_attention.capture.torch_policies.attention_calls import TOLERANCE, AttentionCall, CallShape, Watcher
from vla_attention.capture.torch_policies.key_caches import KeyCaches
from vla_attention.capture.torch_policies.policy_modules import blocks_without_calls, find_policy
from vla_attention.capture.torch_policies.unseen_attention import no_attention
from vla_attention.capture.torch_policies.watch import watch_attention
from vla_attention.schemas.errors import BadArgument

#: How many queries of a call the product of rows and values is checked for.
_CHECKED_QUERIES = 64
#: About how many queries of a call the first row of a batch is compared for: they are kept from all calls.
_COMPARED_QUERIES = 4
#: Rows of a table on a screen.
_SCREEN = 40
#: From this many numbers of keys on, those of one module are written as a range.
_RANGE = 4


#: Below a table all of whose calls have several rows of a batch.
_BATCH = (
    "Calls with a batch are recorded with run.episodes([...]), an episode for each row; where some rows are none, as "
    "those that guidance computes without the instruction, with rows=... and batch=..."
)
#: The error of rows times values, and why recording refuses the call.
_Check = tuple[float, str]


class NoAttention(BadArgument):
    """A policy whose call computed no attention that can be seen."""


class OtherCalls(BadArgument):
    """Two policy calls that were to be compared, and made other attention calls."""


@dataclass(frozen=True)
class CallRow:
    """Attention calls of the same shape, in modules whose paths differ in numbers only.

    Attributes:
        modules: paths of the modules, in the order of their first calls.
        shape: of the first of them.
        keys: the smallest and the largest number of keys.
        times: how often each module made such a call, the least and the most.
        product_error: the largest error of rows times values, relative to the kernel's output.
        refused: why recording refuses these calls at a site, in words; "" where it does not.
    """

    modules: tuple[str, ...]
    shape: CallShape
    keys: tuple[int, int]
    times: tuple[int, int]
    product_error: float
    refused: str = ""

    @property
    def pattern(self) -> str:
        """The paths as one: `layers.{0..17}.self_attn`."""
        return folded_paths(self.modules)


@dataclass(frozen=True)
class CallTable:
    """All attention calls of one call of a policy.

    Attributes:
        policy: name of its class.
        calls: the shapes, in order.
        errors: of rows times values, one for every call; empty where they were not looked at, and then not shown.
        refused: for every call why recording refuses it, see `CallRow`; empty where it was not looked at.
        silent: paths of repeated blocks that ran and made no call, where others like them did.
    """

    policy: str
    calls: tuple[CallShape, ...]
    errors: tuple[float, ...] = ()
    refused: tuple[str, ...] = ()
    silent: tuple[str, ...] = ()

    @property
    def rows(self) -> tuple[CallRow, ...]:
        """The calls, those of the same shape in modules of one pattern folded into one row."""
        count = len(self.calls)
        checks = zip(self.errors or (float("nan"),) * count, self.refused or ("",) * count, strict=True)
        # Of each module and shape: number of keys -> the checks of its calls.
        counts: dict[CallShape, dict[int, list[_Check]]] = {}
        for call, check in zip(self.calls, checks, strict=True):
            counts.setdefault(structs.replace(call, number=0, keys=0), {}).setdefault(call.keys, []).append(check)
        folded: dict[tuple[Any, ...], list[tuple[CallShape, list[_Check]]]] = {}
        for shape, by_keys in counts.items():
            ranges = {(keys, keys): found for keys, found in by_keys.items()}
            # A module with many numbers of keys, such as a decoder with a cache, gets one row.
            if len(by_keys) >= _RANGE:
                ranges = {(min(by_keys), max(by_keys)): list(chain.from_iterable(by_keys.values()))}
            pattern = structs.replace(shape, module=re.sub(r"\d+", "{}", shape.module))
            for keys, found in ranges.items():
                folded.setdefault((pattern, keys, any(why for _, why in found)), []).append((shape, found))
        return tuple(_row(keys, modules) for (_, keys, _), modules in folded.items())

    def __str__(self) -> str:
        rows = self.rows
        heading = ("module", "kind", "queries x keys", "heads", "dtype", "calls", "P·V error")
        shown = len(heading) if self.errors else len(heading) - 1
        lines = aligned([line[:shown] for line in (heading, *(_cells(row) for row in rows[:_SCREEN]))])
        if len(rows) > _SCREEN:
            lines.append(f"... and {len(rows) - _SCREEN} further rows: see `.rows`")
        cells = [(_cells(row), row.refused) for row in rows if row.refused]
        lines += [f"Recording refuses {pattern}, {sizes}: {refused}." for (pattern, _, sizes, *_), refused in cells]
        if cells:
            lines.append("Calls that hold no action queries are left out by a rule without a site.")
        if self.silent:
            lines.append(
                f"Ran without an attention call: {folded_paths(self.silent)} (linear attention, state spaces, "
                "convolutions). What keys give through these is neither recorded nor cut off by a knockout."
            )
        batch = sorted({call.batch for call in self.calls})
        if batch and batch[0] > 1 and self.errors:
            lines.append(_BATCH)
        total = f"{len(self.calls)} attention calls of {self.policy}, batch {_listed(batch)}"
        return "\n".join([total, *lines])

    __repr__ = __str__


@dataclass
class _Shapes(Watcher):
    """A watcher that keeps shapes and errors, and why calls would be refused."""

    calls: list[CallShape] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    caches: KeyCaches = field(default_factory=KeyCaches)
    #: By module: of every call its number and the rows of the first row of its batch, (head, query, key), where wanted.
    first_rows: dict[str, list[tuple[int, Tensor | None]]] | None = None

    def saw(self, call: AttentionCall) -> None:
        step = max(1, -(-call.shape.queries // _CHECKED_QUERIES))
        queries = slice(None, None, step)
        if self.first_rows is not None:
            compared = slice(None, None, max(1, call.shape.queries // _COMPARED_QUERIES))
            rows = None if call.refused else call.rows(compared, slice(0, 1))[0].cpu()
            self.first_rows.setdefault(call.shape.module, []).append((len(self.calls), rows))
        self.calls.append(call.shape)
        if call.refused:
            self.errors.append(float("nan"))
            self.refused.append(f"it {call.refused}")
            return
        rows = call.rows(queries)
        error = call.product_error(rows, queries)
        self.errors.append(error)
        unfit = call.unfit(rows, error) if math.isfinite(error) else "or its output hold NaN or infinite numbers"
        cache = self.caches.problem(call, call.shape.module)
        self.refused.append(f"its rows {unfit}" if unfit else cache)

    def refuse(self, shape: CallShape, why: str) -> None:
        self.errors[shape.number], self.refused[shape.number] = float("nan"), f"it {why}"


def inspect(policy: object, call: Callable[[], object], *, first_row: Callable[[], object] | None = None) -> CallTable:
    """Return a table of every attention call that `call()` makes in `policy`; printed, it fits a screen.

    policy: an `nn.Module`, or an object that holds modules. call: runs it once, as
    `lambda: policy.select_action(batch)`.
    The P·V error is the largest difference of rows times values from what the policy's own kernel computed, relative to
    its largest output: rounding errors say that the rows are those of the kernel. `refused` stands there for calls that
    recording refuses, and the reason below the table.

    first_row: where `call` has a batch, the same call with the first row of its inputs alone, noise included. Calls
    whose first row is not what this call gives, as where heads are folded outside of the batch, are refused. Modules
    that are called another number of times for one row (a vision tower, once for each picture) are not compared.

    Raises:
        NoAttention: no attention was seen.
        OtherCalls: `first_row` makes other attention calls.
        UserError: see `watch_attention`.
    """
    shapes = _Shapes(first_rows=None if first_row is None else {})
    random = RandomNumbers()
    with watch_attention(policy, shapes):
        call()
    if not shapes.calls:
        raise NoAttention(no_attention(policy, shapes.unmet))
    if first_row is not None:
        alone = _Shapes(first_rows={})
        random.again()
        with watch_attention(policy, alone):
            first_row()
        _compare_first_rows(shapes, alone)
    found = find_policy(policy)
    silent = blocks_without_calls(found.modules, shapes.modules, [call.module for call in shapes.calls])
    return CallTable(
        type(found.policy).__name__, tuple(shapes.calls), tuple(shapes.errors), tuple(shapes.refused), tuple(silent)
    )


def _compare_first_rows(shapes: _Shapes, alone: _Shapes) -> None:
    """Refuse calls whose first row is another one without the other rows of the batch."""
    of_all, of_one = shapes.first_rows or {}, alone.first_rows or {}
    as_often = [module for module in of_all if len(of_all[module]) == len(of_one.get(module, ()))]
    pairs = [pair for module in as_often for pair in zip(of_all[module], of_one[module], strict=True)]
    if not pairs or of_all.keys() != of_one.keys():
        raise OtherCalls(
            f"The call given as first_row made {len(alone.calls)} attention calls in {len(of_one)} modules, and that "
            f"of all rows {len(shapes.calls)} in {len(of_all)}: both must be the same policy call."
        )
    for (number, rows), (other, expected) in pairs:
        if rows is None or expected is None or shapes.refused[number]:
            continue
        if rows.shape != expected.shape:
            shapes.refused[number] = (
                f"the first row of its batch has the shape {tuple(rows.shape)} (head, query, key), and in the call of "
                f"one row {tuple(expected.shape)}: nothing tells batch from heads. Record one environment at a time"
            )
            continue
        difference = float((rows - expected).abs().max()) if rows.numel() else 0.0
        if not difference <= TOLERANCE.get(alone.calls[other].dtype, TOLERANCE["float32"]):
            shapes.refused[number] = (
                f"the first row of its batch differs by {difference:.2g} from that of the call of one row: the heads "
                "are folded outside of the batch, or the two calls had other inputs. Record one environment at a time"
            )


def _row(keys: tuple[int, int], modules: Sequence[tuple[CallShape, Sequence[_Check]]]) -> CallRow:
    times, found = [len(checks) for _, checks in modules], [check for _, checks in modules for check in checks]
    return CallRow(
        modules=tuple(shape.module for shape, _ in modules),
        shape=modules[0][0],
        keys=keys,
        times=(min(times), max(times)),
        product_error=max(error for error, _ in found),
        refused=next((why for _, why in found if why), ""),
    )


def aligned(lines: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table as text."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]


def _cells(row: CallRow) -> tuple[str, ...]:
    keys, times = (str(low) if low == high else f"{low}..{high}" for low, high in (row.keys, row.times))
    shape = row.shape
    heads = str(shape.heads) if shape.heads == shape.kv_heads else f"{shape.heads} on {shape.kv_heads}"
    calls = f"{len(row.modules)} x {times}" if len(row.modules) > 1 else times
    pattern = row.pattern or "(policy)"
    error = "refused" if row.refused else f"{row.product_error:.0e}"
    return pattern, shape.kind, f"{shape.queries} x {keys}", heads, shape.dtype, calls, error


def folded_paths(paths: Sequence[str]) -> str:
    """Return paths that differ in their numbers as one, as `layers.{0..17}.self_attn`.

    Several numbers that differ are written so where every combination is there; else the paths follow one another.
    """
    if len(paths) == 1:
        return paths[0]
    numbers = [[int(number) for number in re.findall(r"\d+", path)] for path in paths]
    columns = [sorted(set(column)) for column in zip(*numbers, strict=True)]
    if math.prod(map(len, columns)) != len(paths):
        return ", ".join(paths)
    written = iter(_listed(column) if len(column) == 1 else f"{{{_listed(column)}}}" for column in columns)
    return re.sub(r"\d+", lambda match: next(written), paths[0])


def _listed(numbers: Sequence[int]) -> str:
    """Return numbers as text: `0..17`, `0,2..16` for every second, or one after the other."""
    steps = {after - before for before, after in pairwise(numbers)}
    if len(numbers) > 2 and len(steps) == 1:
        step = steps.pop()
        return f"{numbers[0]}..{numbers[-1]}" if step == 1 else f"{numbers[0]},{numbers[1]}..{numbers[-1]}"
    return ",".join(str(number) for number in numbers)
