"""The recorder: it collects the planned rows of one site during one replan, and their contributions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.recording.attention import PieceSink, RowCollector, RowSink, UpdateSink
from vla_attention.capture.recording.call_contributions import CallContributions, Cell, KeyFacts
from vla_attention.capture.recording.contributions import Projection
from vla_attention.capture.store.replan_records import RecordedRows
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.segments import segment_members, segments_of
from vla_attention.schemas.stores.store_format import Recording

#: Rows of a replan with more bytes than this are moved to the processor call by call.
_LARGEST_BUFFER = 2**29


class SiteNotRecorded(RuntimeError):
    """The model did not pass on a planned row, or passed it on more than once."""


@dataclass(frozen=True)
class RecordingPlan:
    """Which rows of one site are recorded at every replan.

    layers, denoise_steps, heads: indices; their order is the order of the recorded axes.
    queries: "mean" (over the action queries, in float32), "steps" (weighted means, one per action step and dimension)
        or "all".

    Raises:
        BadArgument: indices are missing, negative or repeated, or `queries` is none of the three.
    """

    layers: tuple[int, ...]
    denoise_steps: tuple[int, ...]
    heads: tuple[int, ...]
    queries: Literal["mean", "steps", "all"]
    site: str

    def __post_init__(self) -> None:
        for name in ("layers", "denoise_steps", "heads"):
            chosen = getattr(self, name)
            if not chosen or min(chosen) < 0 or len(set(chosen)) != len(chosen):
                raise BadArgument(
                    f"The {name} of site '{self.site}' must be one or more different indices from 0 up, not {chosen}."
                )
        if self.queries not in ("mean", "steps", "all"):
            raise BadArgument(
                f"The queries of site '{self.site}' must be 'mean', 'steps' or 'all', not '{self.queries}'."
            )


@dataclass
class AttentionRecorder(RowCollector):
    """Collects the rows of one site during one replan (batch 1). Every replan needs a new one.

    The recorder keeps only the planned heads and the action queries, so no array of the size query x query outlives a
    call. Each call writes into one buffer on the device, and `finish` moves this buffer and the contributions to the
    processor in one copy through pinned memory: nothing in the loop of the model waits for a GPU. Rows that would fill
    the GPU's memory (all queries of a Cosmos policy) are moved call by call.

    parts: (key, part) bool, disjoint parts of the keys whose contributions are recorded, or None for rows only.
    pools: (pool, action query) weights of the means that `queries = "steps"` records.
    """

    plan: RecordingPlan
    num_keys: int
    parts: NDArray[np.bool_] | None = None
    pools: NDArray[np.float64] | None = None
    _cells: dict[Cell, int] = field(init=False, repr=False)
    _buffer: Tensor | None = field(default=None, init=False, repr=False)
    _slots: tuple[Tensor, ...] = field(default=(), init=False, repr=False)
    _prepared_for: torch.device | None = field(default=None, init=False, repr=False)
    #: The shape of rows that were found right.
    _shape: tuple[int, ...] = field(default=(), init=False, repr=False)
    _num_queries: int = field(default=1, init=False, repr=False)
    #: The planned heads and the weights of the pools on the device; None for all heads in their order.
    _heads: Tensor | None = field(default=None, init=False, repr=False)
    _pools: Tensor | None = field(default=None, init=False, repr=False)
    _rows_seen: Counter[Cell] = field(default_factory=Counter, init=False, repr=False)
    _updates_seen: Counter[Cell] = field(default_factory=Counter, init=False, repr=False)
    _contributions: CallContributions | None = field(default=None, init=False, repr=False)
    #: Rows (1, head, action query, key) of all heads and the value products, kept until the update of the call arrives.
    _awaited: Tensor | None = field(default=None, init=False, repr=False)
    _pieces: Sequence[Tensor] | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        pairs = [(layer, step) for layer in self.plan.layers for step in self.plan.denoise_steps]
        self._cells = {pair: number for number, pair in enumerate(pairs)}
        if self.parts is not None:
            self._contributions = CallContributions(self.parts, pairs)

    def wants(self, layer: int, denoise_step: int) -> bool:
        """Return whether the plan contains this block at this denoise step."""
        return (layer, denoise_step) in self._cells

    def begin_call(self, allowed: Tensor, lasting: slice, pieces: Sequence[slice] | None) -> None:
        """Move to the device what the calls need there, and keep what the model says about pieces of its keys."""
        self._prepare(allowed.device)
        if self._contributions is not None and pieces is not None:
            self._contributions.facts = KeyFacts(allowed.numpy(), lasting, tuple(pieces))

    def sink(self, layer: int, denoise_step: int, action_queries: slice) -> RowSink | None:
        """Return the function that takes the rows of this call, or None if the plan does not contain them."""
        if not self.wants(layer, denoise_step):
            return None

        def take(rows: Tensor) -> None:
            self._take((layer, denoise_step), rows, action_queries)

        return take

    def piece_sink(self, layer: int, denoise_step: int, action_queries: slice) -> PieceSink | None:
        """Return the function that takes the value products of this call, or None if contributions are not recorded."""
        if self.parts is None or not self.wants(layer, denoise_step):
            return None

        def take(pieces: Sequence[Tensor]) -> None:
            of_all = _of_queries(pieces[0], 2, action_queries) is pieces[0]
            self._pieces = pieces if of_all else [_of_queries(piece, 2, action_queries) for piece in pieces]

        return take

    def update_sink(self, layer: int, denoise_step: int, action_queries: slice) -> UpdateSink | None:
        """Return the function that takes the update of this call, or None if contributions are not recorded."""
        contributions = self._contributions
        if contributions is None or not self.wants(layer, denoise_step):
            return None

        def take(values: Tensor, projection: Projection, update: Tensor) -> None:
            if self._awaited is None:
                raise SiteNotRecorded(f"Layer {layer} passed on its update before its rows.")
            cell = (layer, denoise_step)
            update = _of_queries(update, 1, action_queries)
            contributions.take(cell, self._awaited, self._pieces, values, projection, update)
            self._updates_seen[cell] += 1
            self._awaited = self._pieces = None

        return take

    def _take(self, cell: Cell, rows: Tensor, action_queries: slice) -> None:
        if rows.shape != self._shape:
            self._check_shape(rows)
        chosen = _of_queries(rows, 2, action_queries)
        if self.parts is not None:
            self._awaited = chosen
        if self._buffer is None:
            self._buffer = self._allocate(chosen)
            self._slots = torch.split(self._buffer, 1)
        slot = self._slots[self._cells[cell]]
        self._rows_seen[cell] += 1
        if self._heads is not None:
            chosen = chosen.index_select(1, self._heads)
        if self.plan.queries == "mean":
            if slot.device == chosen.device:
                torch.sum(chosen, dim=2, keepdim=True, out=slot)  # `on_device` divides all at once
            else:
                slot.copy_(chosen.sum(dim=2, keepdim=True))
        elif self._pools is not None:
            slot.copy_(torch.matmul(self._pools, chosen))
        else:
            slot.copy_(chosen)

    def _check_shape(self, rows: Tensor) -> None:
        """Raise an error unless rows (batch, head, query, key) are those of this site and have the planned heads."""
        batch, heads, _, keys = rows.shape
        if batch != 1:
            raise ValueError(f"rows are recorded for a batch of 1, not of {batch}")
        if keys != self.num_keys:
            raise ValueError(f"site '{self.plan.site}' has {self.num_keys} keys, but the model gave rows of {keys}")
        if max(self.plan.heads) >= heads:
            raise BadArgument(f"Head {max(self.plan.heads)} does not exist: the model's heads are 0 to {heads - 1}.")
        self._shape = rows.shape

    def _prepare(self, device: torch.device) -> None:
        """Move the planned heads, the weights of the pools and the keys of the parts to a device."""
        self._heads = torch.tensor(self.plan.heads, device=device)
        if self.plan.queries == "steps":
            self._pools = torch.from_numpy(self._given_pools()).float().to(device)
        if self._contributions is not None:
            self._contributions.prepare(device)
        self._prepared_for = device

    def _allocate(self, of_actions: Tensor) -> Tensor:
        """Return the buffer (cell, head, query, key).

        of_actions: (1, head, action query, key), the first rows that were taken.
        """
        _, heads, queries, _ = of_actions.shape
        self._num_queries = queries
        device = of_actions.device
        if self._prepared_for != device:
            self._prepare(device)
        if self.plan.heads == tuple(range(heads)):
            self._heads = None
        if self.plan.queries == "mean":
            queries = 1
        elif self._pools is not None:
            queries = len(self._pools)
        shape = (len(self._cells), len(self.plan.heads), queries, self.num_keys)
        large = math.prod(shape) * of_actions.element_size() > _LARGEST_BUFFER
        return torch.empty(shape, device="cpu" if large else device)

    def finish(self) -> RecordedRows:
        """Return the rows of the whole plan; raise `SiteNotRecorded` if a call is missing or was recorded twice."""
        with torch.inference_mode():
            moved = [array.numpy() for array in to_processor(self.on_device())]
        axes = (len(self.plan.layers), len(self.plan.denoise_steps))
        rows, *grams = (array.reshape(*axes, *array.shape[1:]) for array in moved)
        return RecordedRows.summed(rows, grams[0] if grams else None)

    def on_device(self) -> list[Tensor]:
        """Return the rows (cell, head, query, key) and, if recorded, the Gram matrices, where the model made them.

        It is called once, after the model.
        """
        self._check(self._rows_seen, "rows")
        assert self._buffer is not None
        if self.plan.queries == "mean":
            self._buffer.div_(self._num_queries)
        if self._contributions is None:
            return [self._buffer]
        self._check(self._updates_seen, "updates")
        return [self._buffer, self._contributions.finish()]

    def _given_pools(self) -> NDArray[np.float64]:
        if self.pools is None:
            raise BadArgument(
                f"The queries of site '{self.plan.site}' have no weights per action step; record their mean."
            )
        return self.pools

    def _check(self, seen: Counter[Cell], what: str) -> None:
        """Raise `SiteNotRecorded` unless every planned call passed on its tensors once."""
        faults = []
        for layer, step in self._cells:
            times = seen[layer, step]
            if times != 1:
                faults.append(f"layer {layer} at denoise step {step} {f'{times} times' if times else 'never'}")
        if faults:
            raise SiteNotRecorded(
                f"The model must pass on the {what} of site '{self.plan.site}' exactly once for each of "
                f"{len(self._cells)} pairs of layer and denoise step, but passed on {'; '.join(faults[:6])}"
                f"{' ...' if len(faults) > 6 else ''}."
            )


def _of_queries(tensor: Tensor, axis: int, queries: slice) -> Tensor:
    """Return the entries of some queries; the tensor itself if these are all."""
    length = tensor.shape[axis]
    start, stop, _ = queries.indices(length)
    return tensor if (start, stop) == (0, length) else tensor.narrow(axis, start, stop - start)


def to_processor(tensors: Sequence[Tensor]) -> list[Tensor]:
    """Return the tensors in the processor's memory: all that are on a GPU in one copy, through pinned memory."""
    on_gpu = [tensor for tensor in tensors if tensor.device.type == "cuda"]
    if not on_gpu:
        return list(tensors)
    packed = torch.cat([tensor.reshape(-1) for tensor in on_gpu])
    pinned = torch.empty(packed.shape, dtype=packed.dtype, pin_memory=True)
    pinned.copy_(packed, non_blocking=True)
    torch.cuda.current_stream(packed.device).synchronize()
    moved = iter(torch.split(pinned, [tensor.numel() for tensor in on_gpu]))
    return [next(moved).view(tensor.shape) if tensor.device.type == "cuda" else tensor for tensor in tensors]


def make_recorders(
    recording: Recording,
    sites: Sequence[SiteLayout],
    key_role: Mapping[str, NDArray[np.uint8]],
    pools: NDArray[np.float64] | None = None,
) -> dict[str, AttentionRecorder]:
    """Return new recorders for one replan, by site. Contributions are those of the replan's own segments.

    key_role: site -> (key,) codes of the roles at this replan.
    pools: (pool, action query) weights of the means that `queries = "steps"` records.
    """
    recorders: dict[str, AttentionRecorder] = {}
    for site in sites:
        of_site = recording.of_site(site)
        plan = RecordingPlan(of_site.layers, of_site.denoise_steps, of_site.heads, of_site.queries, site.name)
        roles = key_role[site.name]
        parts = segment_members(site, roles[None], segments_of(site, roles))[0] if recording.contributions else None
        recorders[site.name] = AttentionRecorder(plan, site.num_keys, parts, pools)
    return recorders
