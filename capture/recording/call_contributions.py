"""The contributions of one site during one replan: what is kept at each call, and the Gram matrices made of it.

There are three ways:

- shared: on a processor in float32, the model's own value products of its pieces of the keys are those of most parts,
  and are not made again; `SharedLayer` projects all steps at once.
- later: on a GPU, rows, values and updates stay on the device until the denoise steps are done.
- now: rows that would fill the memory (all tokens of a Cosmos policy) are used at once.

In the shared way, the model multiplies values by pieces of its keys (`RowCollector.begin_call`), and most parts are a
piece. What a call gives is copied, and not kept where the model made it: its next call then finds the memory that it
used before. The output projection of a block has the same weight at every denoise step, so that one product for all
steps replaces ten small ones. A part of a few keys whose values are the same at all steps (words) is projected key by
key, once for all steps. The part that adds most at the first call is what the others leave of the blocks' updates, and
needs no product; its rounding error is that of the update. Where the model read none of its keys, it is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
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

#: A part of more keys is not projected key by key.
_MOST_SINGLE_KEYS = 24

#: Squared norms below this part of the largest one are looked at: rounding leaves 1e-12 of it.
_NEXT_TO_NOTHING = 1e-9

_PROCESSOR = torch.device("cpu")


@dataclass(frozen=True)
class KeyFacts:
    """What a model says about its keys before the first denoise step; see `RowCollector.begin_call`."""

    allowed: NDArray[np.bool_]
    lasting: slice
    pieces: tuple[slice, ...]


@dataclass(frozen=True)
class Shares:
    """How the contribution of each part is made.

    size: number of parts. mixed: parts whose mixed values are kept, and where they come from: the number of a piece, or
    the part's keys. single: parts that are projected key by key, with their places among the single keys. The other
    parts have no key that is read. complete: whether the parts hold every key that is read.
    """

    size: int
    mixed: tuple[tuple[int, int | slice | Tensor], ...]
    single: tuple[tuple[int, slice | Tensor], ...]
    single_keys: slice | Tensor | None
    num_single_keys: int
    complete: bool

    @classmethod
    def of(cls, members: NDArray[np.bool_], facts: KeyFacts) -> Shares:
        """Return the shares of parts, members (key, part) bool."""
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
                mixed.append((part, keys_of_parts(read[:, part : part + 1], _PROCESSOR)[0]))
        together = np.zeros(len(members), dtype=bool)
        for _, keys in single:
            together[keys] = True
        # The places of each part's keys among all single keys.
        places = keys_of_parts(read[together][:, [part for part, _ in single]], _PROCESSOR)
        return cls(
            read.shape[1],
            tuple(mixed),
            tuple((part, place) for (part, _), place in zip(single, places, strict=True)),
            keys_of_parts(together[:, None], _PROCESSOR)[0] if single else None,
            int(together.sum()),
            bool((read.any(axis=1) | ~facts.allowed).all()),
        )

    def mixed_values(self, rows: Tensor, pieces: Sequence[Tensor], values: Tensor) -> list[Tensor]:
        """Return the mixed values (1, head, query, dim) of the mixed parts; arguments as in `SharedLayer.take`."""
        return [
            pieces[source] if isinstance(source, int) else _mixed(rows[0], values[0], source)
            for _, source in self.mixed
        ]

    @property
    def one_is_left(self) -> bool:
        """Whether the last mixed part is what the others leave of the updates."""
        return self.complete and bool(self.mixed)

    @property
    def order(self) -> list[int]:
        """The parts in the order of the vectors: mixed, single, the one that is left."""
        made = self.mixed[: len(self.mixed) - self.one_is_left]
        return [part for part, _ in (*made, *self.single, *self.mixed[len(made) :])]

    def largest_last(self, mixed: Sequence[Tensor]) -> Shares:
        """Return the same shares with the mixed part last whose mixed values are largest; mixed: those of a call."""
        if not mixed:
            return self
        largest = max(range(len(mixed)), key=lambda number: float(mixed[number].square().sum()))
        others = tuple(source for number, source in enumerate(self.mixed) if number != largest)
        return replace(self, mixed=(*others, self.mixed[largest]))


class SharedLayer:
    """Keeps what the calls of a layer give, and makes their Gram matrices.

    `take` is called once for each denoise step, in any order, then `inner_products`.
    """

    def __init__(self, shares: Shares, steps: int, rows: Tensor, values: Tensor, projection: Projection) -> None:
        """Make the memory for the calls, from the tensors of one."""
        self._shares, self._weight = shares, projection.weight
        _, heads, queries, _ = rows.shape
        self.num_queries, keys = queries, shares.single_keys
        #: (kv_head, single key, dim)
        self._values = None if keys is None else values[0, :, keys].clone()
        #: (step, mixed part, head, query, dim) and (step, head, query, single key), and their entries by step.
        self._mixed = values.new_empty(steps, len(shares.mixed), heads, queries, values.shape[-1])
        self._single = values.new_empty(steps, heads, queries, shares.num_single_keys)
        self._to_mixed, self._to_single = self._mixed.unbind(), torch.split(self._single, 1)
        #: By step: (1, query, width), and (1, width) or None without gates.
        self._updates: list[Tensor | None] = [None] * steps
        self._gates: list[Tensor | None] = [None] * steps

    def take(self, step: int, rows: Tensor, mixed: list[Tensor], projection: Projection, update: Tensor) -> None:
        """Take one call.

        step: its number here, from 0. rows: (1, head, query, key). mixed: from `Shares.mixed_values`. update: (1,
        query, width).
        """
        if mixed:
            torch.cat(mixed, out=self._to_mixed[step])
        keys = self._shares.single_keys
        if isinstance(keys, slice):
            torch.narrow_copy(rows, 3, keys.start, keys.stop - keys.start, out=self._to_single[step])
        elif keys is not None:
            torch.index_select(rows, 3, keys, out=self._to_single[step])
        self._updates[step], self._gates[step] = update, projection.gate

    def inner_products(self) -> Tensor:
        """Return the inner products (step, part + 1, part + 1) float32, summed over queries.

        The parts stand in the order of the shares, then the update; those without a key that is read are left out.
        """
        shares = self._shares
        updates = [update for update in self._updates if update is not None]
        gates = [gate for gate in self._gates if gate is not None]
        parts, mixed = len(shares.order), len(shares.mixed) - shares.one_is_left
        vectors = updates[0].new_empty(parts + 1, len(updates), *updates[0].shape[1:])  # (part, step, query, width)
        made, update = vectors[: parts - shares.one_is_left], vectors[-1]
        torch.cat(updates, out=update)
        if mixed:
            given = self._mixed[:, :mixed].permute(1, 0, 3, 2, 4).reshape(-1, self._weight.shape[1])
            torch.mm(given, self._weight.t(), out=made[:mixed].view(len(given), -1))
        if shares.single:
            self._project_keys(made[mixed:].flatten(1, 2))
        if gates:
            made.mul_(torch.cat(gates)[:, None])
        if shares.one_is_left:
            torch.sub(update, made.sum(dim=0), out=vectors[-2])
        flat = vectors.flatten(2).transpose(0, 1)  # (step, part, query · width)
        return torch.bmm(flat, flat.transpose(1, 2))

    def left_nothing(self, step: int) -> bool:
        """Return whether the last mixed part, which is what the others leave, was knocked out at a step."""
        return not self._mixed[step, -1].any()

    def _project_keys(self, out: Tensor) -> None:
        """Write the contributions (part, step · query, width) of the parts of single keys, without gates."""
        assert self._values is not None
        heads, width = self._single.shape[1], out.shape[-1]
        by_head = self._weight.view(width, heads, -1).permute(1, 2, 0)  # (head, dim, width)
        kv_heads, count, dim = self._values.shape
        values = self._values[:, None].expand(kv_heads, heads // kv_heads, count, dim).reshape(heads, count, dim)
        keys = torch.bmm(values, by_head).transpose(0, 1).reshape(-1, width)  # (key · head, width)
        rows = self._single.permute(0, 2, 3, 1).reshape(-1, len(keys))  # (step · query, key · head)
        for (_, place), of_part in zip(self._shares.single, out.unbind(), strict=True):
            if isinstance(place, slice):
                of_keys = slice(place.start * heads, place.stop * heads)
                torch.mm(rows[:, of_keys], keys[of_keys], out=of_part)
            else:
                numbers = (place[:, None] * heads + torch.arange(heads)).flatten()
                torch.mm(rows[:, numbers], keys[numbers], out=of_part)


def _mixed(rows: Tensor, values: Tensor, keys: slice | Tensor) -> Tensor:
    """Return the mixed values (1, head, query, dim) of some keys."""
    heads, queries, _ = rows.shape
    shared = rows[..., keys].reshape(len(values), heads // len(values) * queries, -1)
    return torch.matmul(shared, values[:, keys]).view(1, heads, queries, -1)


def gram_matrices(shares: Shares, layers: Sequence[SharedLayer]) -> Tensor:
    """Return the Gram matrices (layer · step, part + 1, part + 1) float32 of all parts and the update."""
    inner = torch.cat([layer.inner_products() for layer in layers]) / layers[0].num_queries
    if shares.one_is_left:
        squares = inner.diagonal(dim1=1, dim2=2)
        steps = len(inner) // len(layers)
        for cell in (squares[:, -2] <= _NEXT_TO_NOTHING * squares.amax(dim=1)).nonzero()[:, 0].tolist():
            if layers[cell // steps].left_nothing(cell % steps):  # and not what rounding leaves
                inner[cell, -2], inner[cell, :, -2] = 0, 0
    place = torch.tensor([*shares.order, shares.size])
    gram = inner.new_zeros(len(inner), shares.size + 1, shares.size + 1)
    gram[:, place[:, None], place] = inner
    return gram


#: Rows of all calls of a replan with more bytes than this are used at once instead of waiting on the GPU.
_MOST_WAITING_BYTES = 2**29

Cell = tuple[int, int]


@dataclass(frozen=True)
class _Kept:
    """What is kept of one call in the way `later`.

    rows: (head, action query, key). values: (kv_head, key, dim). update: (1, action query, width).
    """

    rows: Tensor
    values: Tensor
    projection: Projection
    update: Tensor


@dataclass
class CallContributions:
    """Collects what the Gram matrices of one site need during one replan; see above for the three ways.

    members: (key, part) bool. cells: the pairs of layer and denoise step that are recorded, layers first.
    """

    members: NDArray[np.bool_]
    cells: Sequence[Cell]
    facts: KeyFacts | None = None
    _way: Literal["shared", "later", "now"] | None = field(default=None, init=False)
    _parts: list[slice | Tensor] = field(default_factory=list, init=False)
    _kept: dict[Cell, _Kept] = field(default_factory=dict, init=False)
    _grams: dict[Cell, Tensor] = field(default_factory=dict, init=False)
    _shares: Shares | None = field(default=None, init=False)
    _layers: dict[int, SharedLayer] = field(default_factory=dict, init=False)
    _step_numbers: dict[int, int] = field(init=False)

    def __post_init__(self) -> None:
        self._step_numbers = {step: number for number, step in enumerate(dict.fromkeys(step for _, step in self.cells))}

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
        if self._way == "shared":
            assert pieces is not None
            self._share(cell, rows, pieces, values, projection, update)
        elif self._way == "later":
            self._kept[cell] = _Kept(rows[0], values[0], projection, update)
        else:
            each = part_contributions(rows[0], values[0], self._parts, projection)
            self._grams[cell] = gram_matrix(each, update[0])

    def _choose(
        self, rows: Tensor, pieces: Sequence[Tensor] | None, values: Tensor, projection: Projection, update: Tensor
    ) -> Literal["shared", "later", "now"]:
        exact = values.dtype == update.dtype == projection.weight.dtype == torch.float32
        if self.facts is not None and pieces is not None and exact and rows.device.type == "cpu":
            return "shared"
        waiting = rows.numel() * rows.element_size() * len(self.cells)
        return "later" if rows.device.type != "cpu" and waiting <= _MOST_WAITING_BYTES else "now"

    def _share(
        self,
        cell: Cell,
        rows: Tensor,
        pieces: Sequence[Tensor],
        values: Tensor,
        projection: Projection,
        update: Tensor,
    ) -> None:
        if self._shares is None:
            assert self.facts is not None
            shares = Shares.of(self.members, self.facts)
            self._shares = shares.largest_last(shares.mixed_values(rows, pieces, values))
        layer, step = cell
        if layer not in self._layers:
            self._layers[layer] = SharedLayer(self._shares, len(self._step_numbers), rows, values, projection)
        mixed = self._shares.mixed_values(rows, pieces, values)
        self._layers[layer].take(self._step_numbers[step], rows, mixed, projection, update)

    def finish(self) -> Tensor:
        """Return the Gram matrices of all cells in their order, (cell, part + 1, part + 1) float32 on the device."""
        if self._way == "now":
            return torch.stack([self._grams[cell] for cell in self.cells])
        layers = dict.fromkeys(layer for layer, _ in self.cells)
        if self._way == "shared":
            assert self._shares is not None
            return gram_matrices(self._shares, [self._layers[layer] for layer in layers])
        return torch.cat([self._gram_matrices([(layer, step) for step in self._step_numbers]) for layer in layers])

    def _gram_matrices(self, cells: Sequence[Cell]) -> Tensor:
        """Return the Gram matrices (cell, part + 1, part + 1) of one layer from what is kept of its calls."""
        kept = [self._kept[cell] for cell in cells]
        rows, values = torch.stack([call.rows for call in kept]), torch.stack([call.values for call in kept])
        each = F.linear(part_values(rows, values, self._parts), kept[0].projection.weight.float())
        gates = [call.projection.gate for call in kept if call.projection.gate is not None]
        if gates:
            each = each * torch.cat(gates).float()[:, None, None]
        return gram_matrix(each, torch.cat([call.update for call in kept]))
