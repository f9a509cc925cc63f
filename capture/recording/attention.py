"""The one attention function of every policy, and the recorder that collects its rows.

A row is the post-softmax probability of one query over all keys of its site. Rows leave `attend` in float32, before the
cast to the compute precision: probabilities rounded to bfloat16 sum to 1 only within 0.2 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from vla_attention.capture.recording.contributions import Projection, gram_matrix, keys_of_parts, part_contributions
from vla_attention.capture.store.recorded_rows import RecordedRows
from vla_attention.schemas.errors import BadArgument

#: What the reference puts in place of the logits of masked keys: so low that their probability is exactly 0.
MASKED_LOGIT = -2.3819763e38

#: Numbers of one call's rows from which on they do not wait on the device.
_LARGE_ROWS = 2**20

RowSink = Callable[[Tensor], None]
#: Takes a call's values (batch, kv_head, key, dim), its projection to the residual stream, and the update (batch, query, width).
UpdateSink = Callable[[Tensor, Projection, Tensor], None]


def attend(
    query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None, scale: float, *, rows_to: RowSink | None = None
) -> Tensor:
    """Return softmax(scale · query · keyᵀ, masked) · value, and hand the probabilities to `rows_to`.

    Scaled dot-product attention (Vaswani et al. 2017, eq. 1) with grouped queries: head h reads the key/value head
    h // (heads / kv_heads). Logits and softmax are float32 whatever the inputs are; the probabilities are cast to the
    dtype of `value` for the value product only. The arithmetic does not depend on `rows_to`.

    Args:
        query: (batch, head, query, dim).
        key: (batch, kv_head, key, dim).
        value: (batch, kv_head, key, dim).
        mask: (batch, query or 1, key) bool, True = may be attended to, or None. A masked key gets exactly 0; a query
            without any allowed key gets a uniform row, as in the reference.
        scale: factor of the logits.
        rows_to: called once with the float32 probabilities (batch, head, query, key).

    Returns:
        (batch, head, query, dim) in the dtype of `value`.
    """
    batch, heads, queries, dim = query.shape
    kv_heads, keys = key.shape[1], key.shape[2]
    if heads % kv_heads:
        raise ValueError(f"{heads} query heads cannot share {kv_heads} key heads evenly")
    # The heads that share a key head become extra queries of it: one product, and the keys are never repeated.
    stacked = (query.float() * scale).reshape(batch, kv_heads, heads // kv_heads * queries, dim)
    logits = torch.matmul(stacked, key.float().transpose(-1, -2)).view(batch, heads, queries, keys)
    if mask is not None:
        logits.masked_fill_(~mask[:, None], MASKED_LOGIT)
    rows = torch.softmax(logits, dim=-1)
    if rows_to is not None:
        rows_to(rows)
    mixed = torch.matmul(rows.to(value.dtype).view(batch, kv_heads, -1, keys), value)
    return mixed.view(batch, heads, queries, value.shape[-1])


class RowCollector(Protocol):
    """Whatever wants to see rows: a model asks it, for every block and denoise step, where the rows shall go."""

    def sink(self, layer: int, denoise_step: int, action_queries: slice) -> RowSink | None:
        """Return the function that takes the rows (batch, head, query, key) of this call, or None for "not wanted"."""
        ...

    def update_sink(self, layer: int, denoise_step: int, action_queries: slice) -> UpdateSink | None:
        """Return the function that takes, after the rows, what this call added to the residual stream, or None."""
        return None


class SiteNotRecorded(RuntimeError):
    """Rows that were asked for never came out of the model, or came out more than once."""


@dataclass(frozen=True)
class RecordingPlan:
    """Which rows of one site are recorded at every replan.

    `layers`, `denoise_steps` and `heads` are indices, kept in the order given; `queries` is "mean" (over the action
    queries, in float32), "steps" (weighted means, one per action step and dimension) or "all".
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
    """Collect the rows of one site during one replan (batch 1): make a new one for every replan.

    Only the wanted heads and action queries are copied, so nothing query x query sized outlives a call. The copies
    stay on the device until `finish`, which moves them at once: a transfer per block would stall a GPU. Large ones (all
    queries of a Cosmos policy) are moved as they come: they would fill it.

    parts: (key, part) bool, disjoint parts of the keys whose contributions are wanted, or None for rows only.
    pools: (pool, action query), the weights of the means that the plan's queries "steps" stand for.
    """

    plan: RecordingPlan
    num_keys: int
    parts: np.ndarray | None = None
    pools: np.ndarray | None = None
    _rows: dict[tuple[int, int], list[Tensor]] = field(default_factory=dict, init=False, repr=False)
    _grams: dict[tuple[int, int], list[Tensor]] = field(default_factory=dict, init=False, repr=False)
    _keys_of_parts: list[slice | Tensor] | None = field(default=None, init=False, repr=False)
    #: All heads' rows of the call whose update is awaited.
    _awaited: Tensor | None = field(default=None, init=False, repr=False)

    def wants(self, layer: int, denoise_step: int) -> bool:
        """Say whether the plan contains this block at this denoise step."""
        return layer in self.plan.layers and denoise_step in self.plan.denoise_steps

    def sink(self, layer: int, denoise_step: int, action_queries: slice) -> RowSink | None:
        """Return the function that takes the rows of this call, or None when the plan does not ask for them.

        `action_queries` are the positions of the action queries on the query axis of the rows that will come.
        """
        if not self.wants(layer, denoise_step):
            return None

        def take(rows: Tensor) -> None:
            self._take(layer, denoise_step, rows, action_queries)

        return take

    def update_sink(self, layer: int, denoise_step: int, action_queries: slice) -> UpdateSink | None:
        """Return the function that takes the update of this call, or None when contributions are not asked for."""
        if self.parts is None or not self.wants(layer, denoise_step):
            return None
        members = self.parts

        def take(values: Tensor, project: Projection, update: Tensor) -> None:
            if self._awaited is None:
                raise SiteNotRecorded(f"Layer {layer} gave an update before its rows.")
            if self._keys_of_parts is None:
                self._keys_of_parts = keys_of_parts(members, values.device)
            each = part_contributions(self._awaited, values[0], self._keys_of_parts, project)
            gram = gram_matrix(each, update[0, action_queries])
            self._grams.setdefault((layer, denoise_step), []).append(gram)
            self._awaited = None

        return take

    def _take(self, layer: int, denoise_step: int, rows: Tensor, action_queries: slice) -> None:
        batch, heads, _, keys = rows.shape
        if batch != 1:
            raise ValueError(f"rows are recorded for a batch of 1, not of {batch}")
        if keys != self.num_keys:
            raise ValueError(f"site '{self.plan.site}' has {self.num_keys} keys, but the model gave rows of {keys}")
        if max(self.plan.heads) >= heads:
            raise BadArgument(f"Head {max(self.plan.heads)} does not exist: the model's heads are 0 to {heads - 1}.")
        of_actions = rows[0, :, action_queries].detach()
        if self.parts is not None:
            self._awaited = of_actions
        wanted = torch.tensor(self.plan.heads, device=rows.device)
        chosen = of_actions.index_select(0, wanted)
        if self.plan.queries == "mean":
            chosen = chosen.mean(dim=1, keepdim=True)
        elif self.plan.queries == "steps":
            if self.pools is None:
                raise BadArgument(
                    f"The queries of site '{self.plan.site}' do not stand for action steps; record their mean."
                )
            chosen = torch.matmul(torch.from_numpy(self.pools).to(chosen), chosen)
        if chosen.numel() > _LARGE_ROWS:
            chosen = chosen.cpu()
        self._rows.setdefault((layer, denoise_step), []).append(chosen)

    def finish(self) -> RecordedRows:
        """Return the rows of the whole plan; raise `SiteNotRecorded` when a call is missing or came twice."""
        rows = self._stacked(self._rows, "rows")
        contribution = None if self.parts is None else self._stacked(self._grams, "updates")
        return RecordedRows(rows, rows.sum(axis=-1, dtype=np.float64).astype(np.float32), contribution)

    def _stacked(self, collected: dict[tuple[int, int], list[Tensor]], what: str) -> np.ndarray:
        """Stack what was collected into (layer, denoise, ...), moved off the device at once."""
        cells = [(layer, step) for layer in self.plan.layers for step in self.plan.denoise_steps]
        faults = []
        for layer, step in cells:
            times = len(collected.get((layer, step), ()))
            if times != 1:
                faults.append(f"layer {layer} at denoise step {step} {'never' if not times else f'{times} times'}")
        if faults:
            raise SiteNotRecorded(
                f"Site '{self.plan.site}' should have given {what} once for each of {len(cells)} pairs of layer and "
                f"denoise step, but came: {'; '.join(faults[:6])}{' ...' if len(faults) > 6 else ''}."
            )
        stacked = torch.stack([collected[cell][0] for cell in cells]).cpu().numpy()
        return stacked.reshape(len(self.plan.layers), len(self.plan.denoise_steps), *stacked.shape[1:])
