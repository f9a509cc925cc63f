"""The recorder: it collects the planned rows of one site during one replan, and their contributions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.recording.attention import RowCollector, RowSink, UpdateSink
from vla_attention.capture.recording.contributions import Projection, gram_matrix, keys_of_parts, part_contributions
from vla_attention.capture.store.recorded_rows import RecordedRows
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.segments import segment_members, segments_of
from vla_attention.schemas.stores.store_format import Recording

#: Copies with more numbers than this move to the CPU immediately instead of waiting on the device.
_LARGE_COPY = 2**20


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

    The recorder copies only the planned heads and the action queries, so no array of the size query x query outlives a
    call. The copies stay on the device until `finish` moves them all at once, because one transfer per block would
    stall a GPU. Large copies (all queries of a Cosmos policy) are moved immediately, because they would fill the GPU's
    memory.

    parts: (key, part) bool, disjoint parts of the keys whose contributions are recorded, or None for rows only.
    pools: (pool, action query) weights of the means that `queries = "steps"` records.
    """

    plan: RecordingPlan
    num_keys: int
    parts: NDArray[np.bool_] | None = None
    pools: NDArray[np.float64] | None = None
    _rows: dict[tuple[int, int], list[Tensor]] = field(default_factory=dict, init=False, repr=False)
    _grams: dict[tuple[int, int], list[Tensor]] = field(default_factory=dict, init=False, repr=False)
    _keys_of_parts: list[slice | Tensor] | None = field(default=None, init=False, repr=False)
    #: Rows (head, action query, key) of all heads, kept until the update of the same call arrives.
    _awaited: Tensor | None = field(default=None, init=False, repr=False)

    def wants(self, layer: int, denoise_step: int) -> bool:
        """Return whether the plan contains this block at this denoise step."""
        return layer in self.plan.layers and denoise_step in self.plan.denoise_steps

    def sink(self, layer: int, denoise_step: int, action_queries: slice) -> RowSink | None:
        """Return the function that takes the rows of this call, or None if the plan does not contain them."""
        if not self.wants(layer, denoise_step):
            return None

        def take(rows: Tensor) -> None:
            self._take(layer, denoise_step, rows, action_queries)

        return take

    def update_sink(self, layer: int, denoise_step: int, action_queries: slice) -> UpdateSink | None:
        """Return the function that takes the update of this call, or None if contributions are not recorded."""
        if self.parts is None or not self.wants(layer, denoise_step):
            return None
        members = self.parts

        def take(values: Tensor, project: Projection, update: Tensor) -> None:
            if self._awaited is None:
                raise SiteNotRecorded(f"Layer {layer} passed on its update before its rows.")
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
                    f"The queries of site '{self.plan.site}' have no weights per action step; record their mean."
                )
            chosen = torch.matmul(torch.from_numpy(self.pools).to(chosen), chosen)
        if chosen.numel() > _LARGE_COPY:
            chosen = chosen.cpu()
        self._rows.setdefault((layer, denoise_step), []).append(chosen)

    def finish(self) -> RecordedRows:
        """Return the rows of the whole plan; raise `SiteNotRecorded` if a call is missing or was recorded twice."""
        rows = self._stacked(self._rows, "rows")
        contribution = None if self.parts is None else self._stacked(self._grams, "updates")
        return RecordedRows(rows, rows.sum(axis=-1, dtype=np.float64).astype(np.float32), contribution)

    def _stacked(self, collected: dict[tuple[int, int], list[Tensor]], what: str) -> NDArray[np.float32]:
        """Stack the tensors of all calls into (layer, denoise, ...), and move them off the device in one transfer."""
        cells = [(layer, step) for layer in self.plan.layers for step in self.plan.denoise_steps]
        faults = []
        for layer, step in cells:
            times = len(collected.get((layer, step), ()))
            if times != 1:
                faults.append(f"layer {layer} at denoise step {step} {f'{times} times' if times else 'never'}")
        if faults:
            raise SiteNotRecorded(
                f"The model must pass on the {what} of site '{self.plan.site}' exactly once for each of {len(cells)} "
                f"pairs of layer and denoise step, but passed on {'; '.join(faults[:6])}"
                f"{' ...' if len(faults) > 6 else ''}."
            )
        stacked: NDArray[np.float32] = torch.stack([collected[cell][0] for cell in cells]).cpu().numpy()
        return stacked.reshape(len(self.plan.layers), len(self.plan.denoise_steps), *stacked.shape[1:])


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
        own = recording.of_site(site)
        plan = RecordingPlan(own.layers, own.denoise_steps, own.heads, own.queries, site.name)
        roles = key_role[site.name]
        parts = segment_members(site, roles[None], segments_of(site, roles))[0] if recording.contributions else None
        recorders[site.name] = AttentionRecorder(plan, site.num_keys, parts, pools)
    return recorders
