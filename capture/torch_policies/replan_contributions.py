"""What each part of the keys adds to the residual stream during one replan of a policy of the caller.

The mixed values of each part are kept until the call's output is added to the stream; then each part takes the way that
the output took, and the parts have to add up to what was added.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.recording.contributions import gram_matrix, keys_of_parts, part_values
from vla_attention.capture.torch_policies.added_updates import AddedUpdate, OutputWay, multiplied
from vla_attention.capture.torch_policies.attention_calls import TOLERANCE, AttentionCall
from vla_attention.capture.torch_policies.call_order import CallOrder, CallPlace
from vla_attention.capture.torch_policies.followed_outputs import difference
from vla_attention.capture.torch_policies.policy_layout import RecordedSite
from vla_attention.capture.torch_policies.policy_modules import OutputProjection
from vla_attention.schemas.segments import segment_members, segments_of

#: Row of the batch, site -> the role codes of its keys (key,), before masks are known.
EarlyRoles = Callable[[int, RecordedSite, NDArray[np.bool_]], NDArray[np.uint8]]
Cell = tuple[int, int]


@dataclass
class _SiteParts:
    """Of one site. roles, parts: by row of the batch. grams: by (block, denoise step, row), (part, part).

    between: what stands between the attention and the residual stream, beside the output projection.
    """

    roles: dict[int, NDArray[np.uint8]] = field(default_factory=dict)
    parts: dict[int, list[slice | Tensor]] = field(default_factory=dict)
    grams: dict[tuple[int, int, int], list[Tensor]] = field(default_factory=dict)
    between: set[str] = field(default_factory=set)


class ReplanContributions:
    """Collects the contributions of the recorded calls of one replan.

    Args:
        order: the calls of the replan.
        rows: the rows of the batch that are recorded.
        projections: (site, block) -> the block's output projection.
        early_roles: the roles of keys before the masks are known.
    """

    def __init__(
        self,
        order: CallOrder,
        rows: Sequence[int],
        projections: Mapping[tuple[str, int], OutputProjection],
        early_roles: EarlyRoles,
    ) -> None:
        self._order = order
        self._rows = rows
        self._projections = projections
        self._early_roles = early_roles
        self._sites = {site.name: _SiteParts() for site in order.layout.sites}
        #: Outputs that were not added to the residual stream yet, and of which call they are.
        self._on_the_way: dict[OutputWay, CallPlace] = {}
        self._unknown: list[str] = []

    def roles_of(self, site: str, row: int) -> NDArray[np.uint8] | None:
        """Return the roles (key,) for which contributions were made; None without any."""
        return self._sites[site].roles.get(row)

    def grams(self, site: str, cells: Sequence[Cell], row: int) -> NDArray[np.float32]:
        """Return the Gram matrices (cell, part + 1, part + 1) of a row; of several calls of a cell their mean."""
        grams_of_site = self._sites[site].grams
        grams: NDArray[np.float32] = (
            torch.stack([torch.stack(grams_of_site[*cell, row]).mean(dim=0) for cell in cells]).cpu().numpy()
        )
        return grams

    def way(
        self,
        call: AttentionCall,
        rows: Tensor,
        keys: Tensor | None,
        place: CallPlace,
        site: RecordedSite,
        cell: tuple[int, int],
    ) -> OutputWay:
        """Keep the mixed values of each part of the keys until the call's output is added to the residual stream."""
        site_parts, project = self._sites[site.name], self._projections[site.name, place.block]
        values = call.value if keys is None else spread(call.value, keys, site.keys.num_keys, axis=2)
        mixed = {}
        for row in self._rows:
            if row not in site_parts.roles:
                site_parts.roles[row] = roles = self._early_roles(row, site, self._order.present[site.name])
                members = segment_members(site.keys, roles[None], segments_of(site.keys, roles))[0]
                site_parts.parts[row] = keys_of_parts(members, rows.device)
            mixed[row] = part_values(rows[row], values[row], site_parts.parts[row])

        def take(update: AddedUpdate | None) -> None:
            if update is None:
                self._unknown.append(f"{_where(place)} {way.describe_loss()}")
                return
            del self._on_the_way[way]
            self._take(update, mixed, project, place, cell)

        itself = call.shape.kind == "multihead"
        way = OutputWay(project.module, project.path, call.output, place.queries, itself, take)
        self._on_the_way[way] = place
        return way

    def _take(
        self,
        update: AddedUpdate,
        mixed: Mapping[int, Tensor],
        project: OutputProjection,
        place: CallPlace,
        cell: tuple[int, int],
    ) -> None:
        """Make the Gram matrices of what was added; mixed: row -> (query, part, head · dim)."""
        site_parts, mismatches = self._sites[place.site or ""], [update.mismatch]
        for row, mixed_parts in mixed.items():
            # The last one is the whole output.
            every = torch.cat([mixed_parts, update.mixed[row][:, None]], dim=1)
            projected = project(multiplied(every, update.before, row))
            mismatches.append(difference(projected[:, -1] + project.bias(every), update.projected[row]))
            vectors = multiplied(projected, update.behind, row)
            mismatches.append(difference(vectors[:, :-1].sum(dim=1), vectors[:, -1]))
            gram = gram_matrix(vectors[:, :-1], vectors[:, -1])
            site_parts.grams.setdefault((*cell, row), []).append(gram)
        for factors, where in ((update.before, "before"), (update.behind, "behind")):
            if factors is not None:
                site_parts.between.add(f"factors {where} the projection")
        mismatch, most = float(torch.stack(mismatches).max()), TOLERANCE.get(update.precision, TOLERANCE["float32"])
        if not mismatch <= most:
            self._unknown.append(
                f"{_where(place)} the parts of the keys add up to something that differs from what was added by "
                f"{mismatch:.2g} of its largest number (allowed is {most:g} for {update.precision}): the output "
                f"projection '{project.path}' is not linear, or something changes numbers that is no function of torch"
            )

    def unknown(self) -> str | None:
        """Say why it is not known what the parts of the keys add to the residual stream; None if it is known."""
        if self._unknown:
            return self._unknown[0]
        return next((f"{_where(place)} {way.describe_loss()}" for way, place in self._on_the_way.items()), None)

    def describe(self) -> str:
        """Say what stands between the attention and the residual stream, beside the output projections."""
        between_of_sites = [
            f"{name}: {', '.join(sorted(site_parts.between)) or 'nothing but the projection'}"
            for name, site_parts in self._sites.items()
            if site_parts.grams
        ]
        return "; ".join(between_of_sites)


def _where(place: CallPlace) -> str:
    return f"in block {place.block} of site '{place.site}' (step {place.step}),"


def spread(values: Tensor, keys: Tensor, count: int, axis: int = -1) -> Tensor:
    """Values with their key axis at the places `keys` of an axis of `count`; 0 elsewhere."""
    shape = list(values.shape)
    shape[axis] = count
    result = values.new_zeros(shape)
    result.index_copy_(axis % values.ndim, keys, values)
    return result
