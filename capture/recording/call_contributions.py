"""The contributions of one site during one replan: what is kept at each call, and the Gram matrices made of it.

What a call gives is not projected while the model runs. The output projection of a block has the same weight at every
denoise step, so one product for all steps replaces ten small ones. There are three ways:

- shared: on a processor in float32, the model's own value products of its pieces of the keys are those of most parts,
  and are not made again. A part of a few keys whose values are the same at all steps (words) is projected key by key,
  once for all steps. The part that adds most at the first call is what the others leave of the blocks' updates,
  and needs no product; its rounding error is that of the update. Where the model read none of its keys, it is zero.
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
#: Vectors of contributions that are made together, in bytes.
_MOST_VECTOR_BYTES = 2**21
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
    #: (1, action query, width)
    update: Tensor
    #: later: (head, action query, key) and (kv_head, key, dim)
    rows: Tensor | None = None
    values: Tensor | None = None
    #: shared: (1, head, action query, dim) of each part that is mixed, (1, head, action query, key) of the single keys
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
    single: tuple[tuple[int, slice | Tensor], ...]
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
        # The places of each part's keys among all single keys.
        places = keys_of_parts(read[together][:, [part for part, _ in single]], torch.device("cpu"))
        return cls(
            tuple(mixed),
            tuple((part, place) for (part, _), place in zip(single, places, strict=True)),
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

    def prepare(self, device: torch.device) -> None:
        """Move the keys of the parts to a device; called before the first call is taken."""
        self._parts = keys_of_parts(self.members, device)

    def take(
        self,
        cell: Cell,
        rows: Tensor,
        pieces: Sequence[Tensor] | None,
        values: Tensor,
        projection: Projection,
        update: Tensor,
    ) -> None:
        """Take one call: rows (1, head, action query, key), values (1, kv_head, key, dim), update (1, query, width).

        pieces: (1, head, action query, dim) value products of the model's pieces, if it made any.
        """
        if self._way is None:
            self._way = self._choose(rows, pieces, values, projection, update)
        if self._way == "now":
            each = part_contributions(rows[0], values[0], self._parts, projection)
            self._grams[cell] = gram_matrix(each, update[0])
            return
        if self._way == "later":
            self._kept[cell] = _Kept(projection, update, rows[0], values[0])
            return
        assert self._shares is not None
        assert pieces is not None
        mixed = tuple(
            pieces[source] if isinstance(source, int) else _mixed(rows[0], values[0], source)
            for _, source in self._shares.mixed
        )
        single = None
        if self._shares.single_keys is not None:
            single = self._single_rows(rows)
            if cell[0] not in self._single_values:
                self._single_values[cell[0]] = values[0, :, self._shares.single_keys].clone()
        self._kept[cell] = _Kept(projection, update, mixed=mixed, single=single)

    def _single_rows(self, rows: Tensor) -> Tensor:
        """Return a copy of the rows (1, head, action query, single key)."""
        keys = self._shares.single_keys if self._shares is not None else None
        if isinstance(keys, slice):
            return torch.narrow_copy(rows, 3, keys.start, keys.stop - keys.start)
        return rows[..., keys]

    def _choose(
        self, rows: Tensor, pieces: Sequence[Tensor] | None, values: Tensor, projection: Projection, update: Tensor
    ) -> Literal["shared", "later", "now"]:
        exact = values.dtype == update.dtype == projection.weight.dtype == torch.float32
        if self.facts is not None and pieces is not None and exact and rows.device.type == "cpu":
            self._shares = _Shares.of(self.members, self.facts)
            return "shared"
        waiting = rows.numel() * rows.element_size() * len(self.cells)
        return "later" if rows.device.type != "cpu" and waiting <= _MOST_WAITING_BYTES else "now"

    def finish(self) -> Tensor:
        """Return the Gram matrices of all cells in their order, (cell, part + 1, part + 1) float32 on the device."""
        if self._way == "now":
            return torch.stack([self._grams[cell] for cell in self.cells])
        layers = list(dict.fromkeys(layer for layer, _ in self.cells))
        steps = len(self.cells) // len(layers)
        together = 1
        if self._way == "shared":  # layers together, as long as their vectors stay in the processor's cache
            one = self._kept[self.cells[0]].update
            together = max(1, _MOST_VECTOR_BYTES // (steps * (self.members.shape[1] + 1) * one.numel() * 4))
        make = self._gram_matrices_later if self._way == "later" else self._gram_matrices_shared
        count = together * steps
        return torch.cat([make(self.cells[i : i + count], steps) for i in range(0, len(self.cells), count)])

    def _gram_matrices_later(self, cells: Sequence[Cell], steps: int) -> Tensor:
        """Return the Gram matrices (cell, part + 1, part + 1) of one layer from its rows and values."""
        kept = [self._kept[cell] for cell in cells]
        rows = torch.stack([call.rows for call in kept if call.rows is not None])
        values = torch.stack([call.values for call in kept if call.values is not None])
        each = F.linear(part_values(rows, values, self._parts), kept[0].projection.weight.float())
        gates = _gates(kept)
        return gram_matrix(each if gates is None else each * gates, torch.cat([call.update for call in kept]))

    def _gram_matrices_shared(self, cells: Sequence[Cell], steps: int) -> Tensor:
        """Return the Gram matrices (cell, part + 1, part + 1) of some layers from mixed values and single keys."""
        shares = self._shares
        assert shares is not None
        kept = [self._kept[cell] for cell in cells]
        weights = [call.projection.weight for call in kept[::steps]]
        gates = _gates(kept)
        update = torch.cat([call.update for call in kept])
        rest = self._largest(kept[0]) if shares.complete else None
        mixed = [number for number in range(len(shares.mixed)) if number != rest]
        order = [shares.mixed[number][0] for number in mixed] + [part for part, _ in shares.single]
        # (cell, part, query, width); the update comes last, what the others leave of it before it
        vectors = update.new_empty(len(cells), len(order) + (rest is not None) + 1, *update.shape[1:])
        others, last = vectors[:, : len(order)], vectors[:, -1]
        if mixed:
            given = torch.cat([call.mixed[number] for call in kept for number in mixed])
            given = given.transpose(1, 2).reshape(len(weights), -1, weights[0].shape[1])
            made = torch.stack([F.linear(one, weight) for one, weight in zip(given, weights, strict=True)])
            _times(made.view(len(cells), len(mixed), *update.shape[1:]), gates, others[:, : len(mixed)])
        if shares.single:
            self._project_keys(cells, steps, weights, gates, others[:, len(mixed) :])
        if rest is not None:
            left = vectors[:, len(order)]
            torch.sub(update, others.sum(dim=1), out=left)
            for number, call in enumerate(kept):
                if _is_zero(call.mixed[rest]):  # knocked out in this call: nothing, and not what rounding leaves
                    left[number] = 0
            order.append(shares.mixed[rest][0])
        last.copy_(update)
        flat = vectors.flatten(2)
        inner = torch.matmul(flat, flat.transpose(1, 2)) / update.shape[1]
        size = self.members.shape[1] + 1
        place = torch.tensor([*order, size - 1])
        gram = inner.new_zeros(len(cells), size, size)
        gram[:, place[:, None], place] = inner
        return gram

    def _largest(self, call: _Kept) -> int | None:
        """Return the number of the mixed part with the largest mixed values of a call."""
        if not call.mixed:
            return None
        return max(range(len(call.mixed)), key=lambda number: float(call.mixed[number].square().sum()))

    def _project_keys(
        self, cells: Sequence[Cell], steps: int, weights: Sequence[Tensor], gates: Tensor | None, out: Tensor
    ) -> None:
        """Write the contributions (cell, part, query, width) of the parts of single keys."""
        assert self._shares is not None
        singles = [self._kept[cell].single for cell in cells]
        rows = torch.cat([single for single in singles if single is not None]).transpose(
            1, 2
        )  # (cell, query, head, key)
        rows = rows.transpose(2, 3)  # (cell, query, key, head)
        queries, heads = rows.shape[1], rows.shape[3]
        keys = torch.stack(
            [
                _projected(self._single_values[layer], weight, heads)
                for (layer, _), weight in zip(cells[::steps], weights, strict=True)
            ]
        )  # (layer, key, head, width)
        for number, (_, place) in enumerate(self._shares.single):
            of_keys = keys[:, place].flatten(1, 2)
            made = torch.matmul(rows[:, :, place].reshape(len(weights), -1, of_keys.shape[1]), of_keys)
            _times(made.view(len(cells), 1, queries, -1), gates, out[:, number : number + 1])


def _projected(values: Tensor, weight: Tensor, heads: int) -> Tensor:
    """Return what each head adds to the residual stream with a weight of 1 on a key, (key, head, width).

    values: (kv_head, key, dim). weight: (width, head · dim).
    """
    kv_heads, keys, dim = values.shape
    by_head = weight.view(-1, kv_heads, heads // kv_heads, dim)
    made = [
        F.linear(values[kv], by_head[:, kv].reshape(-1, dim)) for kv in range(kv_heads)
    ]  # (key, width · shared head)
    return torch.stack(made, dim=1).view(keys, kv_heads, len(weight), -1).movedim(2, 3).flatten(1, 2)


def _gates(kept: Sequence[_Kept]) -> Tensor | None:
    """Return the gates of the calls, (call, 1, 1, width) float32, or None without gates."""
    gates = [call.projection.gate for call in kept if call.projection.gate is not None]
    return torch.cat(gates).float()[:, None, None] if gates else None


def _times(made: Tensor, gates: Tensor | None, out: Tensor) -> None:
    """Write contributions (call, part, query, width) times their gates."""
    if gates is None:
        out.copy_(made)
    else:
        torch.mul(made, gates, out=out)


def _is_zero(mixed: Tensor) -> bool:
    """Return whether mixed values (1, head, query, dim) are all zero; looks at one query first, which mostly tells."""
    return not mixed[:, :, 0].any() and not mixed.any()


def _mixed(rows: Tensor, values: Tensor, keys: slice | Tensor) -> Tensor:
    """Return the mixed values (1, head, query, dim) of some keys."""
    heads, queries, _ = rows.shape
    shared = rows[..., keys].reshape(len(values), heads // len(values) * queries, -1)
    return torch.matmul(shared, values[:, keys]).view(1, heads, queries, -1)
