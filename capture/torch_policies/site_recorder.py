"""The recorder of one replan: it watches the attention calls of a policy and keeps the rows of the action queries."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.recording.finite_numbers import not_finite
from vla_attention.capture.store.replan_records import RecordedRows
from vla_attention.capture.torch_policies.attention_calls import AttentionCall, CallShape
from vla_attention.capture.torch_policies.call_order import CallOrder, CallPlace, KnownCalls
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused
from vla_attention.capture.torch_policies.key_caches import LOAD_WITH_DYNAMIC_CACHE, first_values, slid
from vla_attention.capture.torch_policies.output_ways import OutputWay
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, RecordedSite
from vla_attention.capture.torch_policies.replan_contributions import EarlyRoles, ReplanContributions, spread
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.segments import Segment, segment_members, segments_of
from vla_attention.schemas.stores.store_format import Recording

#: Copies with more numbers than this move to the CPU immediately instead of waiting on the device.
_LARGE_COPY = 2**20

#: What a row of the batch adds to the logits of a call (head or 1, query, key); None for nothing. The arrays live as
#: long as the recorder, and are the same for calls to which the same is added.
LogitBias = Callable[[int, CallPlace, CallShape], NDArray[np.float32] | None]


class RowsDoNotMatch(UserError, ArithmeticError):
    """Rows whose product with the values is not what the policy's own kernel gave."""


@dataclass(frozen=True)
class SiteRows:
    """What one replan of one episode gave at one site.

    rows: with what uniform attention gives.
    present, valid: (key,) bool; keys that some recorded call had, and that some action query could see.
    early_roles: (key,) the roles for which contributions were made, which know of no masks; None without contributions.
    """

    rows: RecordedRows
    present: NDArray[np.bool_]
    valid: NDArray[np.bool_]
    early_roles: NDArray[np.uint8] | None = None


@dataclass
class _Collected:
    """Of one site: tensors by (block, denoise step), each (row, head, query, key); autoregressive: several.

    uniform: what uniform attention gives in the place of `rows`, (row, head or 1, query, key). Equal ones are one
    tensor, of `kinds`.
    """

    rows: dict[tuple[int, int], list[Tensor]] = field(default_factory=dict)
    uniform: dict[tuple[int, int], list[Tensor]] = field(default_factory=dict)
    kinds: list[Tensor] = field(default_factory=list)
    #: By block: the first values of the last generated token's call, see `key_caches`.
    first_values: dict[int, Tensor] = field(default_factory=dict)


class ReplanRecorder:
    """Watches the calls of one replan (`Watcher`). Every replan needs a new one.

    Args:
        known: the layout, and what was found out about its calls.
        policy: the name of the policy's class, for errors.
        recording: what of them is recorded.
        batch: batch size that every call of the sites must have.
        rows: the rows of the batch that are recorded.
        early_roles: the roles of keys before the masks are known, for contributions.
        bias: what knockouts add to the logits.
        where: the replan in words.
    """

    def __init__(
        self,
        known: KnownCalls,
        policy: str,
        recording: Recording,
        batch: int,
        rows: Sequence[int],
        early_roles: EarlyRoles,
        bias: LogitBias | None = None,
        where: str = "",
    ) -> None:
        self.layout = layout = known.layout
        self.recordings = {name: chosen for name, chosen in recordings_of(recording, layout).items() if chosen}
        self.batch = batch
        self.rows = tuple(rows)
        self.order = CallOrder(known, policy)
        self.contributions = ReplanContributions(self.order, self.rows, early_roles)
        self.bias = bias
        self._where = where
        self.largest_error = 0.0
        #: Whether the output of the first recorded call is followed to see whether the rows of the batch are apart.
        self.asks_of_batch = False
        self._changes: dict[tuple[int, ...], Tensor] = {}
        self._collected = {site.name: _Collected() for site in layout.sites}

    @property
    def changes(self) -> bool:
        """Whether logits are changed at all."""
        return self.bias is not None

    @property
    def saw_attention(self) -> bool:
        """Whether any attention call ran."""
        return bool(self.order.seen)

    def change(self, shape: CallShape) -> Tensor | None:
        """Return what is added to the logits of a call, (batch, head or 1, query, key), or None for nothing."""
        if self.bias is None or (place := self.changed_place(shape)) is None or shape.batch != self.batch:
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
        # What is asked about may turn out to be no attention: what does not fit here is no problem yet.
        problems = dict(self.order.problems)
        place = self.order.place(shape)
        self.order.problems = problems
        if place is None or (place.site is None and not self.layout.rules[place.rule].is_prefix):
            return None
        return place

    def passes(self, shape: CallShape) -> bool:
        """Return whether a call that has run is not recorded; it is counted then, and `saw` not called."""
        place = self.order.place(shape)
        if place is not None and place.site is not None and self._wanted(place):
            return False
        self.order.ran(shape, place)
        return True

    def _wanted(self, place: CallPlace) -> bool:
        recording = self.recordings.get(place.site or "")
        step = 0 if self.layout.autoregressive else place.step
        return recording is not None and place.block in recording.layers and step in recording.denoise_steps

    def saw(self, call: AttentionCall) -> OutputWay | None:
        """Keep the rows of a call, if it is recorded; its output is followed for the contributions."""
        shape = call.shape
        place = self.order.place(shape)
        self.order.ran(shape, place)
        if place is None:
            return None
        if self.bias is not None and call.asked is not None:
            self._check_changed(call.asked, shape, place)
        if place.site is None or not self._wanted(place):
            return None
        site, recording = self.order.known.sites[place.site], self.recordings[place.site]
        if shape.batch != self.batch:
            self.order.problems[
                f"a call of site '{site.name}' has a batch of {shape.batch}, and the replan one of {self.batch} "
                "(several environments in one call, and guidance with and without the instruction: run.episodes)"
            ] = None
            return None
        heads = site.keys.heads or self.layout.num_heads
        if shape.heads != heads:
            self.order.problems[f"a call of site '{site.name}' has {shape.heads} heads; the layout has {heads}"] = None
            return None
        step = 0 if self.layout.autoregressive else place.step
        with torch.no_grad():
            return self._take(call, place, site, recording, (place.block, step))

    def _check_changed(self, asked: CallShape, shape: CallShape, place: CallPlace) -> None:
        """Raise `ChangeRefused` if a knockout of a call could not be made: the softmax showed other axes."""
        if self.bias is None or all(self.bias(row, place, shape) is None for row in self.rows):
            return
        site = place.site or self.layout.rules[place.rule].tokens
        raise ChangeRefused(
            f"The attention call {shape} of site '{site}' cannot be changed: its softmax has {asked.heads} heads "
            f"and {asked.queries} x {asked.keys} queries and keys, and not those of its product with the values. Leave "
            "the call out of the knockout (knockout_layers)."
        )

    def _take(
        self, call: AttentionCall, place: CallPlace, site: RecordedSite, recording: Recording, cell: tuple[int, int]
    ) -> OutputWay | None:
        collected, queries = self._collected[site.name], place.queries
        rows = call.rows(queries)
        error = call.product_error(rows, queries)
        if not math.isfinite(error) and not bool(torch.isfinite(call.output).all() & torch.isfinite(rows).all()):
            block = f"block {place.block} of site '{site.name}' (module '{call.shape.module}')"
            raise not_finite(self._where, f"They begin before or at denoise step {place.step}, {block}", self.remedy)
        self.largest_error = max(self.largest_error, error)
        if problem := call.unfit(rows, error):
            raise RowsDoNotMatch(
                f"The rows of site '{place.site}', block {place.block}, step {place.step} (module "
                f"'{call.shape.module}') {problem}."
            )
        if self.layout.autoregressive:
            self._check_cache(call, place)
        seen = call.allowed(queries)
        uniform = seen / seen.sum(dim=-1, keepdim=True).clamp(min=1)
        way, by_part = None, recording.contributions
        if by_part or self.asks_of_batch:
            self.asks_of_batch = False
            way = self.contributions.way(call, rows, place.keys, place, site, cell, by_part=by_part)
        keys = None if place.keys is None else torch.from_numpy(place.keys).to(rows.device)
        if keys is not None:
            rows, uniform = spread(rows, keys, site.keys.num_keys), spread(uniform, keys, site.keys.num_keys)
        chosen = self._chosen(rows, recording)
        collected.rows.setdefault(cell, []).append(chosen.cpu() if chosen.numel() > _LARGE_COPY else chosen)
        collected.uniform.setdefault(cell, []).append(_kind_of(self._chosen(uniform, recording), collected.kinds))
        return way

    def _chosen(self, values: Tensor, recording: Recording) -> Tensor:
        """What is recorded (row, head or 1, query, key) of values (batch, head or 1, query, key)."""
        if len(self.rows) < self.batch:
            values = values.index_select(0, torch.tensor(self.rows, device=values.device))
        heads = values.shape[1]
        if heads > 1 and recording.heads != tuple(range(heads)):
            values = values.index_select(1, torch.tensor(recording.heads, device=values.device))
        if recording.queries == "mean" and not self.layout.autoregressive:
            values = values.mean(dim=2, keepdim=True)
        return values

    def _check_cache(self, call: AttentionCall, place: CallPlace) -> None:
        """Note a cache whose first key has left since the token before: its keys are not those of the layout."""
        first_of_block = self._collected[place.site or ""].first_values
        before, first_of_block[place.block] = first_of_block.get(place.block), first_values(call)
        if before is not None and call.shape.queries == 1 and slid(before, first_of_block[place.block]):
            self.order.problems[
                f"the caches of site '{place.site}' lose their first key from token to token (a sliding window), so "
                f"that no key has a place of its own: {LOAD_WITH_DYNAMIC_CACHE}"
            ] = None

    def finish(self) -> list[dict[str, SiteRows]]:
        """Return for each recorded row of the batch what its sites gave.

        Raises:
            CallsDoNotFit: the calls are not those of the layout.
        """
        self.order.check(self._where)
        unknown = self.contributions.unknown() is not None
        rows_of_sites: list[dict[str, SiteRows]] = [{} for _ in self.rows]
        for name, recording in self.recordings.items():
            site, collected = self.layout.site(name), self._collected[name]
            cells = [(block, step) for block in recording.layers for step in recording.denoise_steps]
            # Moved off the device in one transfer, (cell, row of the batch, head, query, key).
            stacked = torch.stack([self._joined(collected.rows[cell], recording) for cell in cells]).cpu().numpy()
            uniform = self._uniform(collected, cells, recording)
            for position, row in enumerate(self.rows):
                rows = np.ascontiguousarray(stacked[:, position])
                rows = rows.reshape(len(recording.layers), len(recording.denoise_steps), *rows.shape[1:])
                contribution = None
                if recording.contributions and not unknown:
                    gram = self.contributions.grams(name, cells, row)
                    contribution = gram.reshape(*rows.shape[:2], *gram.shape[1:])
                uniform_rows = np.ascontiguousarray(uniform[:, :, position])
                rows_of_sites[position][site.name] = SiteRows(
                    RecordedRows.summed(rows, contribution, uniform_rows),
                    self.order.present[site.name],
                    np.asarray((uniform_rows > 0).any(axis=(0, 1, 2, 3))),
                    self.contributions.roles_of(name, row),
                )
        return rows_of_sites

    def _uniform(
        self, collected: _Collected, cells: Sequence[tuple[int, int]], recording: Recording
    ) -> NDArray[np.float32]:
        """What uniform attention gives, (layer or 1, denoise or 1, row of the batch, head or 1, query, key)."""
        calls = [tuple(id(tensor) for tensor in collected.uniform[cell]) for cell in cells]
        first = dict(zip(calls, cells, strict=True))
        kinds = {call: self._joined(collected.uniform[cell], recording).cpu() for call, cell in first.items()}
        if len(kinds) == 1:
            (only,) = kinds.values()
            return only.numpy()[None, None]
        heads = max(kind.shape[1] for kind in kinds.values())
        each = torch.stack([kinds[call].expand(-1, heads, -1, -1) for call in calls]).numpy()
        result: NDArray[np.float32] = each.reshape(len(recording.layers), len(recording.denoise_steps), *each.shape[1:])
        return result

    def _joined(self, tensors: Sequence[Tensor], recording: Recording) -> Tensor:
        """One tensor (row, head, query, key) of those of the calls of a block at one denoise step."""
        if len(tensors) > 1:
            heads = max(tensor.shape[1] for tensor in tensors)
            tensors = [torch.cat([tensor.expand(-1, heads, -1, -1) for tensor in tensors], dim=2)]
        if self.layout.autoregressive and recording.queries == "mean":
            return tensors[0].mean(dim=2, keepdim=True)
        return tensors[0]

    @property
    def remedy(self) -> str:
        """What to do where numbers are not finite."""
        if self.bias is None:
            return "look at the policy's input and weights, or use float32"
        return "an intervention may leave a query without any key: take a smaller group, or fewer heads or layers"


def recordings_of(recording: Recording, layout: PolicyLayout) -> dict[str, Recording | None]:
    """What is recorded of each site: of the chosen layers and heads those that it has; None where it has none."""
    recordings: dict[str, Recording | None] = {}
    for site in layout.sites:
        layers = site.keys.layers
        has_some = not layers or bool(set(layers) & set(recording.layers))
        recordings[site.name] = recording.of_site(site.keys) if has_some else None
    return recordings


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
    before, after = segments_of(site.keys, early), segments_of(site.keys, key_role)
    size = len(after) + 1
    result = np.zeros((*gram.shape[:2], size, size), dtype=np.float32)
    sources: list[int] = []
    targets: list[int] = []
    hidden = ~(site_rows.valid & site_rows.present)
    for target, segment in enumerate(after):
        members = _members(site, key_role, segment)
        if hidden[members].all():
            continue
        origins = {source for source, other in enumerate(before) if (_members(site, early, other) & members).any()}
        if len(origins) != 1 or origins & set(sources):
            raise BadArgument(
                f"The contributions of site '{site.name}' cannot be given for the roles of span '{segment.span}': the "
                "roles given differ from those that were known during the call; record without contributions."
            )
        sources.append(origins.pop())
        targets.append(target)
    sources.append(len(before))
    targets.append(len(after))
    result[..., np.ix_(targets, targets)[0], np.ix_(targets, targets)[1]] = gram[
        ..., np.ix_(sources, sources)[0], np.ix_(sources, sources)[1]
    ]
    return result


def _members(site: RecordedSite, roles: NDArray[np.uint8], segment: Segment) -> NDArray[np.bool_]:
    members: NDArray[np.bool_] = segment_members(site.keys, roles[None], (segment,))[0, :, 0]
    return members


#: Kinds of masks that a call is compared with, so that equal ones are kept once; policies have one or two.
_MOST_KINDS = 8


def _kind_of(uniform: Tensor, kinds: list[Tensor]) -> Tensor:
    """The equal one of the tensors that are kept, or this one, which is kept then."""
    for kind in kinds:
        if kind.shape == uniform.shape and torch.equal(kind, uniform):
            return kind
    if len(kinds) < _MOST_KINDS:
        kinds.append(uniform)
    return uniform
