"""The recorder of one replan: it watches the attention calls of a policy and keeps the rows of the action queries."""

from __future__ import annotations

import math
import warnings
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from msgspec import structs
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.recording.finite_numbers import not_finite
from vla_attention.capture.store.replan_records import RecordedRows
from vla_attention.capture.torch_policies.attention_calls import NO_MASS, AttentionCall, CallShape
from vla_attention.capture.torch_policies.call_order import CallOrder, CallPlace, KnownCalls
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused
from vla_attention.capture.torch_policies.key_caches import KeyCaches
from vla_attention.capture.torch_policies.output_ways import OutputWay
from vla_attention.capture.torch_policies.policy_layout import RecordedSite
from vla_attention.capture.torch_policies.replan_contributions import ReplanContributions
from vla_attention.schemas.errors import BadArgument, Note, UserError, listing
from vla_attention.schemas.segments import segment_members, segments_of
from vla_attention.schemas.stores.store_format import Recording

#: Copies with more numbers than this move to the CPU immediately instead of waiting on the device.
_LARGE_COPY = 2**20


class RowsDoNotMatch(UserError, ArithmeticError):
    """Rows whose product with the values is not what the policy's own kernel gave."""


@dataclass(frozen=True)
class SiteRows:
    """What one replan of one episode gave at one site.

    rows: with what uniform attention gives.
    valid: (key,) bool; keys that some action query could see in a recorded call.
    early_roles: (key,) the roles for which contributions were made, which know of no masks; None without contributions.
    """

    rows: RecordedRows
    valid: NDArray[np.bool_]
    early_roles: NDArray[np.uint8] | None = None


#: Of the calls of a site, by (block, denoise step): tensors (row, head, query, key); autoregressive: several.
_OfCalls = dict[tuple[int, int], list[Tensor]]


class ReplanRecorder(CallOrder):
    """Keeps the rows of the calls of one replan. Every replan needs a new one.

    Args:
        known: the layout, and what was found out about its calls.
        policy: the name of the policy's class, for errors.
        recording: what of them is recorded.
        batch: batch size that every call of the sites must have.
        rows: the rows of the batch that are recorded.
        where: the replan in words.
    """

    def __init__(
        self,
        known: KnownCalls,
        policy: str,
        recording: Recording,
        batch: int,
        rows: Sequence[int],
        where: str,
    ) -> None:
        super().__init__(known, policy)
        #: By site: of the chosen layers and heads those that it has; not the sites that have none.
        self.recordings = {
            site.name: recording.of_site(site.keys) for site in self.layout.sites if site.is_in(recording.layers)
        }
        self.batch = batch
        self.rows = tuple(rows)
        self.contributions = ReplanContributions(self.rows, self.early_roles)
        self.where = where
        self.largest_error = 0.0
        #: Whether the output of the first recorded call is followed to see whether the rows of the batch are apart.
        self.asks_of_batch = False
        #: The same of the first call whose heads may be queries.
        self.asks_of_axes = False
        self._changes: dict[tuple[int, ...], Tensor] = {}
        self._caches = KeyCaches()
        #: By site: rows, and what uniform attention gives in their place, for one head where it is the same for all.
        self._rows: defaultdict[str, _OfCalls] = defaultdict(lambda: defaultdict(list))
        self._uniform: defaultdict[str, _OfCalls] = defaultdict(lambda: defaultdict(list))
        #: By site: which keys the last call saw, and what uniform attention gives for them.
        self._uniform_before: dict[str, tuple[Tensor, Tensor]] = {}

    def early_roles(self, row: int, site: RecordedSite) -> NDArray[np.uint8]:
        """Return the roles of keys before the masks are known, for contributions."""
        raise NotImplementedError

    def bias(self, row: int, place: CallPlace, shape: CallShape) -> NDArray[np.float32] | None:
        """Return what a row of the batch adds to the logits of a call (head or 1, query, key); None for nothing.

        The arrays live as long as the recorder, and are the same for calls to which the same is added.
        """

    def change(self, shape: CallShape) -> Tensor | None:
        """Return what is added to the logits of a call, (batch, head or 1, query, key), or None for nothing."""
        if (place := self.changed_place(shape)) is None or shape.batch != self.batch:
            return None
        added = {row: self.bias(row, place, shape) for row in self.rows}
        changed = [values for values in added.values() if values is not None]
        if not changed:
            return None
        # The same arrays are given for calls of the same kind, of which there may be hundreds.
        call = tuple(id(values) for values in added.values())
        if call not in self._changes:
            heads = max(len(values) for values in changed)
            total = torch.zeros(self.batch, heads, shape.queries, shape.keys)
            for row, values in added.items():
                if values is not None:
                    total[row] = torch.from_numpy(values)
            self._changes[call] = total
        return self._changes[call]

    def changed_place(self, shape: CallShape) -> CallPlace | None:
        """Return the place of a call that may be changed; None for others."""
        place = self.place(shape)
        if place is None or (place.site is None and not self.layout.rules[place.rule].is_prefix):
            return None
        return place

    def wanted(self, place: CallPlace) -> bool:
        """Return whether the rows of a call are recorded."""
        recording = self.recordings.get(place.site or "")
        step = 0 if self.layout.autoregressive else place.step
        return recording is not None and place.block in recording.layers and step in recording.denoise_steps

    def saw(self, call: AttentionCall) -> OutputWay | None:
        """See `Watcher`."""
        if self.changes and call.asked is not None and (place := self.place(call.shape)) is not None:
            self._check_changed(call.asked, call.shape, place)
        return super().saw(call)

    def _check_changed(self, asked: CallShape, shape: CallShape, place: CallPlace) -> None:
        """Raise `ChangeRefused` if a knockout of a call could not be made: the softmax showed other axes."""
        if all(self.bias(row, place, shape) is None for row in self.rows):
            return
        site = place.site or self.layout.rules[place.rule].tokens
        raise ChangeRefused(
            f"The attention call {shape} of site '{site}' cannot be changed: its softmax has {asked.heads} heads "
            f"and {asked.queries} x {asked.keys} queries and keys, and not those of its product with the values. Leave "
            "the call out of the knockout (knockout_layers)."
        )

    def take(self, call: AttentionCall, place: CallPlace, site: RecordedSite) -> OutputWay | None:
        """Keep the rows of a call; its output is followed for the contributions."""
        shape, heads = call.shape, site.keys.heads or self.layout.num_heads
        if shape.batch != self.batch:
            self.problems[
                f"a call of site '{site.name}' has a batch of {shape.batch}, and the replan one of {self.batch} "
                "(several environments in one call, and guidance with and without the instruction: run.episodes)"
            ] = None
        elif shape.heads != heads:
            self.problems[f"a call of site '{site.name}' has {shape.heads} heads; the layout has {heads}"] = None
        else:
            with torch.no_grad():
                return self._keep(call, place, site)
        return None

    def _keep(self, call: AttentionCall, place: CallPlace, site: RecordedSite) -> OutputWay | None:
        queries, recording = place.queries, self.recordings[site.name]
        cell = place.block, 0 if self.layout.autoregressive else place.step
        rows = call.rows(queries)
        if site.name not in self.known.asked_of_queries:
            self.known.asked_of_queries.add(site.name)
            self._look_at_queries(call.shape, queries, site)
        if self._is_checked(call.shape, place, site.name):
            self._check(call, rows, place)
        if self.layout.autoregressive and (problem := self._caches.problem(call, (site.name, place.block))):
            self.problems[f"of a call of site '{site.name}', {problem}"] = None
        rows = torch.threshold(rows, NO_MASS, 0.0)
        way, by_part = None, recording.contributions
        asks_of_axes = self.asks_of_axes and call.heads_may_be_queries
        if by_part or self.asks_of_batch or asks_of_axes:
            self.asks_of_batch, self.asks_of_axes = False, self.asks_of_axes and not asks_of_axes
            looked_at = self.whole or self._is_sample(place.block, site.name)
            expected = None if looked_at else self.known.sums.get((site.name, place.block))
            way = self.contributions.way(call, rows, place, site, cell, by_part=by_part, expected=expected)
        chosen = self._chosen(rows, place, site)
        large = chosen.numel() > _LARGE_COPY
        self._rows[site.name][cell].append(chosen.cpu() if large else chosen)
        uniform = self._uniform_of(call.allowed(queries), place, site)
        self._uniform[site.name][cell].append(uniform.cpu() if large else uniform)
        return way

    def _look_at_queries(self, shape: CallShape, queries: slice, site: RecordedSite) -> None:
        """Say where all queries that are recorded are words or patches: in self-attention a query is the key there."""
        if self.layout.autoregressive or not shape.queries == shape.keys == site.keys.num_keys:
            return
        chosen = range(shape.queries)[queries]
        spans = [span for span in site.keys.spans if any(span.start <= query < span.stop for query in chosen)]
        if all(span.kind in ("image", "text") for span in spans):
            warnings.warn(
                f"The queries {chosen.start} to {chosen.stop - 1} of site '{site.name}', which are recorded as the "
                f"actions', are tokens of {listing(span.name for span in spans)}. RecordedSite's second argument "
                "says which queries are actions, for instance (-50, None): the last 50.",
                Note,
                stacklevel=2,
            )

    def _is_checked(self, shape: CallShape, place: CallPlace, site: str) -> bool:
        """Whether the rows of a call are compared with what the kernel gave; see `WatchedPlaces`.

        All are in a call that is watched throughout, and those that have another shape than before; else those of one
        block, another one from call to call.
        """
        alike = structs.replace(shape, number=0)
        if self.whole or alike not in self.known.compared:
            self.known.compared.add(alike)
            return True
        return self._is_sample(place.block, site)

    def _is_sample(self, block: int, site: str) -> bool:
        """Whether a block of a site is the one that is looked at wholly in this call, another one from call to call."""
        blocks = self.known.blocks[site]
        return block == blocks[self.number % len(blocks)]

    def _check(self, call: AttentionCall, rows: Tensor, place: CallPlace) -> None:
        """Raise an error unless rows (batch, head, query, key) give what the policy's own kernel gave."""
        error = call.product_error(rows, place.queries)
        block = f"block {place.block} of site '{place.site}' (module '{call.shape.module}')"
        if not math.isfinite(error) and not bool(torch.isfinite(call.output).all() & torch.isfinite(rows).all()):
            raise not_finite(self.where, f"They begin before or at denoise step {place.step}, {block}", self.remedy)
        self.largest_error = max(self.largest_error, error)
        if problem := call.unfit(rows, error):
            raise RowsDoNotMatch(
                f"The rows of site '{place.site}', block {place.block}, step {place.step} (module "
                f"'{call.shape.module}') {problem}."
            )

    def _uniform_of(self, seen: Tensor, place: CallPlace, site: RecordedSite) -> Tensor:
        """What uniform attention gives for keys that are seen (batch, head or 1, query, key), as it is recorded."""
        before, uniform = self._uniform_before.get(site.name, (None, seen))
        if before is not seen:  # most calls of a site have the same mask
            uniform = self._chosen(seen / seen.sum(dim=-1, keepdim=True).clamp(min=1), place, site)
            self._uniform_before[site.name] = seen, uniform
        return uniform

    def _chosen(self, values: Tensor, place: CallPlace, site: RecordedSite) -> Tensor:
        """What is recorded (row, head or 1, query, key) of values (batch, head or 1, query, key of the call)."""
        recording = self.recordings[site.name]
        if place.keys is not None:
            keys = torch.from_numpy(place.keys).to(values.device)
            values = values.new_zeros(*values.shape[:-1], site.keys.num_keys).index_copy_(-1, keys, values)
        if len(self.rows) < self.batch:
            values = values.index_select(0, torch.tensor(self.rows, device=values.device))
        heads = values.shape[1]
        if heads > 1 and recording.heads != tuple(range(heads)):
            values = values.index_select(1, torch.tensor(recording.heads, device=values.device))
        if recording.queries == "mean" and not self.layout.autoregressive:
            values = values.mean(dim=2, keepdim=True)
        return values

    def finish(self) -> list[dict[str, SiteRows]]:
        """Return for each recorded row of the batch what its sites gave.

        Raises:
            CallsDoNotFit: the calls are not those of the layout.
        """
        self.check(self.where)
        if self.whole:
            self.known.learn_sums(self.contributions.sums())
        else:
            self.contributions.compare_sums(self.known.sums)
        unknown = self.contributions.unknown() is not None
        rows_of_sites: list[dict[str, SiteRows]] = [{} for _ in self.rows]
        for name, recording in self.recordings.items():
            stacked, uniform = (self._stacked(kept[name], recording) for kept in (self._rows, self._uniform))
            if (uniform == uniform[:1, :1]).all():
                uniform = uniform[:1, :1]
            for position, row in enumerate(self.rows):
                rows = np.ascontiguousarray(stacked[:, :, position])
                contribution = None
                if recording.contributions and not unknown:
                    cells = list(product(recording.layers, recording.denoise_steps))
                    gram = self.contributions.grams(name, cells, row)
                    contribution = gram.reshape(*rows.shape[:2], *gram.shape[1:])
                uniform_rows = np.ascontiguousarray(uniform[:, :, position])
                rows_of_sites[position][name] = SiteRows(
                    RecordedRows.summed(rows, contribution, uniform_rows),
                    np.asarray((uniform_rows > 0).any(axis=(0, 1, 2, 3))),
                    self.contributions.roles_of(name, row),
                )
        return rows_of_sites

    def release(self) -> None:
        """Let go of all tensors: a recorder is in cycles, and Python looks for those now and then only."""
        self._rows.clear()
        self._uniform.clear()
        self._uniform_before.clear()
        self._changes.clear()
        self.contributions = ReplanContributions(self.rows, self.early_roles)

    def _stacked(self, calls: _OfCalls, recording: Recording) -> NDArray[np.float32]:
        """What calls gave, (layer, denoise, row of the batch, head, query, key), off the device in one transfer.

        Where all gave the same tensor, layer and denoise have length 1.
        """
        each = [calls[cell] for cell in product(recording.layers, recording.denoise_steps)]
        layers, steps = len(recording.layers), len(recording.denoise_steps)
        if all(len(of_cell) == 1 and of_cell[0] is each[0][0] for of_cell in each):
            each, layers, steps = each[:1], 1, 1
        heads = max(tensor.shape[1] for of_cell in each for tensor in of_cell)
        cells = [torch.cat([tensor.expand(-1, heads, -1, -1) for tensor in of_cell], dim=2) for of_cell in each]
        if self.layout.autoregressive and recording.queries == "mean":
            cells = [cell.mean(dim=2, keepdim=True) for cell in cells]
        stacked: NDArray[np.float32] = torch.stack(cells).cpu().numpy()
        return stacked.reshape(layers, steps, *stacked.shape[1:])

    @property
    def remedy(self) -> str:
        """What to do where numbers are not finite."""
        if not self.changes:
            return "look at the policy's input and weights, or use float32"
        return "an intervention may leave a query without any key: take a smaller group, or fewer heads or layers"


def final_contribution(
    site: RecordedSite, site_rows: SiteRows, key_role: NDArray[np.uint8]
) -> NDArray[np.float32] | None:
    """The contributions by the segments of the final roles, (layer, denoise, part, part).

    They were made for segments that know of no masks. A masked key has a probability of exactly 0, so that the segments
    of masked and absent keys contribute nothing, and the others what they did with these keys.

    Raises:
        BadArgument: a segment with contributions would have to be divided.
    """
    gram, early = site_rows.rows.contribution, site_rows.early_roles
    if gram is None or early is None:
        return gram
    after = segments_of(site.keys, key_role)
    of_key, of_early_key = (
        segment_members(site.keys, roles[None], segments_of(site.keys, roles))[0] for roles in (key_role, early)
    )
    # (segment after, segment before) bool: whether they share keys, of segments with keys that can be seen.
    shared = of_key.T @ of_early_key & (of_key & site_rows.valid[:, None]).any(axis=0)[:, None]
    divided = (shared.sum(axis=1) > 1) | shared[:, shared.sum(axis=0) > 1].any(axis=1)
    if divided.any():
        raise BadArgument(
            f"The contributions of site '{site.name}' cannot be given for the roles of span "
            f"'{after[np.argmax(divided)].span}': the roles given differ from those that were known during the call; "
            "record without contributions."
        )
    # The last part is all keys.
    sources, known = [*shared.argmax(axis=1), -1], np.array([*shared.any(axis=1), True])
    return np.where(known[:, None] & known, gram[..., sources, :][..., sources], np.float32(0))
