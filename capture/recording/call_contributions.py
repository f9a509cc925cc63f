"""The contributions of one site during one replan: what is kept at each call, and the Gram matrices made of it.

There are three ways:

- shared: on a processor in float32, the model's own value products of its pieces of the keys are those of most parts,
  and are not made again; `shared_contributions.py` projects all steps at once.
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
from vla_attention.capture.recording.shared_contributions import KeyFacts, SharedLayer, Shares, gram_matrices

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
