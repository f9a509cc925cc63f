"""The contributions of one site during one replan: what is kept at each call, and the Gram matrices made of it.

What a call gives is not projected while the model runs. The output projection of a block has the same weight at every
denoise step, so one product for all steps replaces ten small ones. There are three ways:

- shared: on a processor in float32, the model's own value products of its pieces of the keys are those of most parts,
  and are not made again. A part of a few keys whose values are the same at all steps (words) is projected key by key,
  once for all steps. The part that adds most at a block's first step is what the others leave of the block's update,
  and needs no product; its rounding error is that of the update.
- later: on a GPU, rows, values and updates stay on the device until the denoise steps are done.
- now: rows that would fill the memory (all tokens of a Cosmos policy) are used at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.recording.contributions import (
    Projection,
    gram_matrix,
    keys_of_parts,
    part_contributions,
    part_values,
)

#: Rows of all calls of a replan with more bytes than this are used at once instead of waiting on the GPU.
_MOST_WAITING_BYTES = 2**29
#: A part of more keys is not projected key by key.
_MOST_SINGLE_KEYS = 24

Cell = tuple[int, int]


@dataclass(frozen=True)
class KeyFacts:
    """What a model says about its keys before the first denoise step; see `RowCollector.begin_call`."""

    allowed: NDArray[np.bool_]
    lasting: slice
    pieces: tuple[slice, ...]


@dataclass
class _Kept:
    """What is kept of one call."""

    projection: Projection
    #: (action query, width)
    update: Tensor
    #: later: (head, action query, key) and (kv_head, key, dim)
    rows: Tensor | None = None
    values: Tensor | None = None
    #: shared: (head, action query, dim) of each part that is mixed, and (head, action query, key) of the single keys
    mixed: tuple[Tensor, ...] = ()
    single: Tensor | None = None


@dataclass(frozen=True)
class _Shares:
    """How the contribution of each part is made in the shared way.

    mixed: parts whose mixed values are kept, and where they come from: the number of a piece, or the part's keys.
    single: parts that are projected key by key, with their positions among the single keys. The other parts have no key
    that is read. complete: whether the parts hold every key that is read.
    """

    mixed: tuple[tuple[int, int | slice | Tensor], ...]
    single: tuple[tuple[int, Tensor], ...]
    single_keys: slice | Tensor | None
    complete: bool

    @classmethod
    def of(cls, members: NDArray[np.bool_], facts: KeyFacts) -> _Shares:
        read = members & facts.allowed[:, None]
        pieces = np.zeros((len(members), len(facts.pieces)), dtype=bool)
        for number, piece in enumerate(facts.pieces):
            pieces[piece, number] = facts.allowed[piece]
        lasting = np.zeros(len(members), dtype=bool)
        lasting[facts.lasting] = True
        mixed: list[tuple[int, int | slice | Tensor]] = []
        single: list[tuple[int, NDArray[np.int64]]] = []
        for part in range(read.shape[1]):
            keys = np.flatnonzero(read[:, part])
            same = np.flatnonzero((pieces == read[:, part : part + 1]).all(axis=0))
            if not keys.size:
                continue
            if keys.size <= _MOST_SINGLE_KEYS and lasting[keys].all():
                single.append((part, keys))
            elif same.size:
                mixed.append((part, int(same[0])))
            else:
                mixed.append((part, keys_of_parts(read[:, part : part + 1], torch.device("cpu"))[0]))
        together = np.zeros(len(members), dtype=bool)
        for _, keys in single:
            together[keys] = True
        position = np.cumsum(together) - 1
        return cls(
            tuple(mixed),
            tuple((part, torch.from_numpy(position[keys])) for part, keys in single),
            keys_of_parts(together[:, None], torch.device("cpu"))[0] if single else None,
            bool((read.any(axis=1) | ~facts.allowed).all()),
        )


@dataclass
class CallContributions:
    """Collects what the Gram matrices of one site need during one replan; see above for the three ways.

    members: (key, part) bool. cells: the pairs of layer and denoise step that are recorded, layers first.
    """

    members: NDArray[np.bool_]
    cells: Sequence[Cell]
    facts: KeyFacts | None = None
    _way: Literal["shared", "later", "now"] | None = field(default=None, init=False)
    _shares: _Shares | None = field(default=None, init=False)
    _parts: list[slice | Tensor] = field(default_factory=list, init=False)
    _kept: dict[Cell, _Kept] = field(default_factory=dict, init=False)
    _grams: dict[Cell, Tensor] = field(default_factory=dict, init=False)
    #: layer -> values (kv_head, single key, dim)
    _single_values: dict[int, Tensor] = field(default_factory=dict, init=False)

    def take(
        self,
        cell: Cell,
        rows: Tensor,
        pieces: Sequence[Tensor] | None,
        values: Tensor,
        projection: Projection,
        update: Tensor,
    ) -> None:
        """Take one call: rows (head, action query, key), values (kv_head, key, dim), update (action query, width).

        pieces: (head, action query, dim) value products of the model's pieces, if it made any.
        """
        if self._way is None:
            self._way = self._choose(rows, pieces, values, projection, update)
        if self._way == "now":
            each = part_contributions(rows, values, self._parts, projection)
            self._grams[cell] = gram_matrix(each, update)
            return
        if self._way == "later":
            self._kept[cell] = _Kept(projection, update, rows, values)
            return
        assert self._shares is not None
        assert pieces is not None
        mixed = tuple(
            pieces[source] if isinstance(source, int) else _mixed(rows, values, source)
            for _, source in self._shares.mixed
        )
        single = None
        if self._shares.single_keys is not None:
            single = rows[..., self._shares.single_keys].clone()
            if cell[0] not in self._single_values:
                self._single_values[cell[0]] = values[:, self._shares.single_keys].clone()
        self._kept[cell] = _Kept(projection, update, mixed=mixed, single=single)

    def _choose(
        self, rows: Tensor, pieces: Sequence[Tensor] | None, values: Tensor, projection: Projection, update: Tensor
    ) -> Literal["shared", "later", "now"]:
        exact = values.dtype == update.dtype == projection.weight.dtype == torch.float32
        if self.facts is not None and pieces is not None and exact and rows.device.type == "cpu":
            self._shares = _Shares.of(self.members, self.facts)
            return "shared"
        self._parts = keys_of_parts(self.members, rows.device)
        waiting = rows.numel() * rows.element_size() * len(self.cells)
        return "later" if rows.device.type != "cpu" and waiting <= _MOST_WAITING_BYTES else "now"

    def finish(self) -> Tensor:
        """Return the Gram matrices of all cells in their order, (cell, part + 1, part + 1) float32 on the device."""
        if self._way == "now":
            return torch.stack([self._grams[cell] for cell in self.cells])
        steps: dict[int, list[_Kept]] = {}
        for cell in self.cells:
            steps.setdefault(cell[0], []).append(self._kept[cell])
        one = self._of_layer_later if self._way == "later" else self._of_layer_shared
        return torch.cat([one(layer, kept) for layer, kept in steps.items()])

    def _of_layer_later(self, layer: int, kept: Sequence[_Kept]) -> Tensor:
        """Return the Gram matrices (step, part + 1, part + 1) of one layer from its rows and values."""
        rows = torch.stack([call.rows for call in kept if call.rows is not None])
        values = torch.stack([call.values for call in kept if call.values is not None])
        each = F.linear(part_values(rows, values, self._parts), kept[0].projection.weight.float())
        gates = _gates(kept)
        return gram_matrix(each if gates is None else each * gates, torch.stack([call.update for call in kept]))

    def _of_layer_shared(self, layer: int, kept: Sequence[_Kept]) -> Tensor:
        """Return the Gram matrices (step, part + 1, part + 1) of one layer from mixed values and single keys."""
        shares = self._shares
        assert shares is not None
        weight = kept[0].projection.weight
        update = torch.stack([call.update for call in kept])
        steps, queries, width = update.shape
        rest = self._largest(kept[0]) if shares.complete else None
        mixed = [number for number in range(len(shares.mixed)) if number != rest]
        order = [shares.mixed[number][0] for number in mixed] + [part for part, _ in shares.single]
        # (step, part, query, width); the update comes last, what the others leave of it before it
        vectors = update.new_empty(steps, len(order) + (rest is not None) + 1, queries, width)
        if mixed:
            given = torch.stack([torch.stack([call.mixed[number] for number in mixed]) for call in kept])
            vectors[:, : len(mixed)] = F.linear(given.transpose(2, 3).flatten(3), weight)
        if shares.single:
            self._project_keys(layer, kept, weight, vectors[:, len(mixed) : len(order)])
        gates = _gates(kept)
        if gates is not None:
            vectors[:, : len(order)] *= gates
        if rest is not None:
            torch.sub(update, vectors[:, : len(order)].sum(dim=1), out=vectors[:, len(order)])
            order.append(shares.mixed[rest][0])
        vectors[:, -1] = update
        flat = vectors.flatten(2)
        inner = torch.matmul(flat, flat.transpose(1, 2)) / queries
        size = self.members.shape[1] + 1
        place = torch.tensor([*order, size - 1])
        gram = inner.new_zeros(steps, size, size)
        gram[:, place[:, None], place] = inner
        return gram

    def _largest(self, call: _Kept) -> int | None:
        """Return the number of the mixed part with the largest mixed values of a call."""
        if not call.mixed:
            return None
        return max(range(len(call.mixed)), key=lambda number: float(call.mixed[number].square().sum()))

    def _project_keys(self, layer: int, kept: Sequence[_Kept], weight: Tensor, out: Tensor) -> None:
        """Write the contributions of the parts of single keys, (step, part, query, width) before the gates."""
        assert self._shares is not None
        rows = torch.stack([call.single for call in kept if call.single is not None])  # (step, head, query, key)
        steps, heads, queries, _ = rows.shape
        values = self._single_values[layer]
        dim = values.shape[-1]
        of_heads = values.repeat_interleave(heads // len(values), dim=0)  # (head, key, dim)
        per_head = torch.unflatten(weight, 1, (heads, dim)).permute(1, 2, 0)  # (head, dim, width)
        projected = torch.matmul(of_heads, per_head)  # (head, key, width)
        rows = rows.transpose(1, 2)  # (step, query, head, key)
        for number, (_, keys) in enumerate(self._shares.single):
            weights = rows[..., keys].reshape(steps * queries, -1)
            out[:, number] = torch.matmul(weights, projected[:, keys].flatten(0, 1)).view(steps, queries, -1)


def _gates(kept: Sequence[_Kept]) -> Tensor | None:
    """Return the gates of the steps, (step, 1, 1, width) float32, or None without gates."""
    gates = [call.projection.gate for call in kept]
    return None if gates[0] is None else torch.stack([gate.float() for gate in gates if gate is not None])[:, None]


def _mixed(rows: Tensor, values: Tensor, keys: slice | Tensor) -> Tensor:
    """Return the mixed values (head, query, dim) of some keys."""
    heads, queries, _ = rows.shape
    shared = rows[..., keys].reshape(len(values), heads // len(values) * queries, -1)
    return torch.matmul(shared, values[:, keys]).view(heads, queries, -1)
