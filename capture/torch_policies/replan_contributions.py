"""What each part of the keys adds to the residual stream during one replan of a policy of the caller.

The mixed values of each part are kept until the call's output is added to the stream; then each part takes the way that
the output took, and the parts have to add up to what was added.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.recording.contributions import Projection, gram_matrix, keys_of_parts, part_values
from vla_attention.capture.torch_policies.attention_calls import TOLERANCE, AttentionCall
from vla_attention.capture.torch_policies.call_order import CallPlace
from vla_attention.capture.torch_policies.output_ways import NotReplayed, OutputWay, Projected, Replay
from vla_attention.capture.torch_policies.policy_layout import RecordedSite
from vla_attention.schemas.segments import segment_members, segments_of

#: Row of the batch, site -> the role codes of its keys (key,), before masks are known.
EarlyRoles = Callable[[int, RecordedSite], NDArray[np.uint8]]
Cell = tuple[int, int]
#: Largest distance from a whole number of what tells the rows of a batch apart.
_MIXED = 0.05


class ReplanContributions:
    """Collects the contributions of the recorded calls of one replan.

    Args:
        rows: the rows of the batch that are recorded.
        early_roles: the roles of keys before the masks are known.
    """

    def __init__(self, rows: Sequence[int], early_roles: EarlyRoles) -> None:
        self._rows, self._early_roles = rows, early_roles
        #: By site and row of the batch: roles (key,), for which contributions are made, and members (key, part).
        self._parts: dict[tuple[str, int], tuple[NDArray[np.uint8], NDArray[np.bool_]]] = {}
        #: By the same, and the site's keys that a call has: the keys of each part.
        self._keys: dict[tuple[str, int, bytes], list[slice | Tensor]] = {}
        self._ways: defaultdict[tuple[str, Cell], list[OutputWay]] = defaultdict(list)
        self._places: list[tuple[CallPlace, OutputWay]] = []

    def roles_of(self, site: str, row: int) -> NDArray[np.uint8] | None:
        """Return the roles (key,) for which contributions were made; None without any."""
        return self._parts[site, row][0] if (site, row) in self._parts else None

    def grams(self, site: str, cells: Sequence[Cell], row: int) -> NDArray[np.float32]:
        """Return the Gram matrices (cell, part + 1, part + 1) of a row; of several calls of a cell their mean."""
        place = self._rows.index(row)
        each = [torch.stack([way.result()[place] for way in self._ways[site, cell]]).mean(dim=0) for cell in cells]
        grams: NDArray[np.float32] = torch.stack(each).cpu().numpy()
        return grams

    def way(
        self, call: AttentionCall, rows: Tensor, place: CallPlace, site: RecordedSite, cell: Cell, *, by_part: bool,
        expected: int | None,
    ) -> OutputWay:  # fmt: skip
        """Follow the output of a call.

        rows: (batch, head, query, key) of its keys. by_part: for the contributions of each part; else all keys are one
        part, which is enough to tell whether the rows of a batch are apart. expected: as of `OutputWay`.
        """
        mixed = []
        for row in self._rows:
            parts: list[slice | Tensor] = [slice(None)]
            if by_part:
                if (site.name, row) not in self._parts:
                    roles = self._early_roles(row, site)
                    members = segment_members(site.keys, roles[None], segments_of(site.keys, roles))[0]
                    self._parts[site.name, row] = roles, members
                members = self._parts[site.name, row][1]
                given = site.name, row, b"" if place.keys is None else place.keys.tobytes()
                if given not in self._keys:
                    members = members if place.keys is None else members[place.keys]
                    self._keys[given] = keys_of_parts(members, rows.device)
                parts = self._keys[given]
            mixed.append(part_values(rows[row], call.value[row], parts))

        def take(replay: Replay, by: Projected | None, added: Tensor) -> tuple[list[Tensor], bool]:
            found = self._projected(call, mixed, place.queries, by, added, way.dtypes)
            return found or self._added(call, mixed, place.queries, replay, added, way.dtypes)

        way = OutputWay(take, expected)
        self._ways[site.name, cell].append(way)
        self._places.append((place, way))
        return way

    def _projected(
        self, call: AttentionCall, mixed: Sequence[Tensor], queries: slice, by: Projected | None, added: Tensor,
        dtypes: Iterable[torch.dtype],
    ) -> tuple[list[Tensor], bool] | None:  # fmt: skip
        """Return what `_added` does, by one product for all parts; None where that does not give what was added.

        mixed: of each row, (query, part, head · dim).
        """
        shape = call.shape
        if by is None or by.weight is None or call.heads_may_be_queries:
            return None
        size = shape.batch, shape.queries, by.weight.shape[0]
        if added.shape != size or by.weight.shape[1] != mixed[0].shape[-1]:
            return None
        project, allowed, grams, there = Projection(by.weight, None), _allowed(call, dtypes), [], False
        constant = 0.0 if by.bias is None else by.bias.float()
        gate = None if by.gate is None else by.gate.float().expand(size)
        for row, parts in zip(self._rows, mixed, strict=True):
            of_row = 1.0 if gate is None else gate[row, queries]
            each = project(parts)  # (query, part, width)
            if not isinstance(of_row, float):
                each.mul_(of_row[:, None])
            total, theirs = each.sum(dim=1), added[row, queries].float()
            mismatch = (total + constant * of_row - theirs).abs().amax()
            # Relative to what the keys give: a large bias is no part of it.
            if not float(mismatch) <= allowed * float(total.abs().amax()):
                return None
            there = there or bool(total.any()) or not bool(parts.any())
            grams.append(gram_matrix(each, total))
        return grams, there

    def _added(
        self, call: AttentionCall, mixed: Sequence[Tensor], queries: slice, replay: Replay, added: Tensor,
        dtypes: Iterable[torch.dtype],
    ) -> tuple[list[Tensor], bool]:  # fmt: skip
        """Return the Gram matrix of each recorded row, and whether the action queries are in what was added.

        mixed: of each row, (query, part, head · dim). added: what the policy added.
        """
        shape = call.shape
        # (part, head, query, dim)
        mixed = [parts.view(*parts.shape[:2], shape.heads, -1).permute(1, 2, 0, 3) for parts in mixed]
        if call.heads_may_be_queries:
            self._check_axes(call, mixed[0].sum(dim=0), queries, replay)
        most = max(len(parts) for parts in mixed)
        # The last one is nothing: what is added whatever the attention gives. The last but one tells rows apart.
        given = mixed[0].new_zeros(most + 2, shape.batch, shape.heads, shape.queries, mixed[0].shape[-1])
        for number, (row, parts) in enumerate(zip(self._rows, mixed, strict=True), start=1):
            given[: len(parts), row, :, queries] = parts
            given[most, row, :, queries] = number * parts.sum(dim=0)
        if len(mixed) == 1:
            given = torch.cat([given[:most], given[-1:]])
        given = torch.vmap(lambda output: replay(call.laid_out(output)))(given).flatten(1, -2)
        each = given[:most] - given[-1]
        total = each.sum(dim=0)
        places = total.abs().amax(dim=-1) > 0
        each, total = each[:, places], total[places]
        theirs = added.float().flatten(0, -2)[places]
        scale = theirs.abs().amax() if theirs.numel() else theirs.new_ones(())
        mismatch = float((total + given[-1, places] - theirs).abs().amax() / scale) if theirs.numel() else 0.0
        allowed = _allowed(call, dtypes)
        if not mismatch <= allowed:
            raise NotReplayed(
                f"the parts of the keys add up to something that differs from what was added by {mismatch:.2g} of its "
                f"largest number (allowed is {allowed:g}): what is done with the attention's "
                "output is not linear, or something changes numbers that is no function of torch"
            )
        owners = torch.ones(len(total), device=total.device)
        if len(mixed) > 1:
            owners = ((given[most, places] - given[-1, places]) * total).sum(-1) / total.square().sum(-1)
            if len(owners) and float((owners - owners.round()).abs().amax()) > _MIXED:
                raise NotReplayed("what is added to one row of the batch comes from several of them", mixes_rows=True)
        count, grams = len(range(*queries.indices(shape.queries))), []
        for number, parts in enumerate(mixed, start=1):
            of_row = owners.round() == number
            vectors = torch.cat([each[: len(parts), of_row], total[None, of_row]]).flatten(1)
            grams.append(vectors @ vectors.T / count)
        return grams, bool(places.any()) or not any(bool(parts.any()) for parts in mixed)

    def _check_axes(self, call: AttentionCall, mixed: Tensor, queries: slice, replay: Replay) -> None:
        """Raise `NotReplayed` if a query of a call goes to more tokens than a head does: they are exchanged then.

        mixed: (head, query, dim) of the first row.
        """
        shape, row = call.shape, self._rows[0]
        given = mixed.new_zeros(3, shape.batch, shape.heads, shape.queries, mixed.shape[-1])
        given[0, row, :, queries.indices(shape.queries)[0]] = mixed[:, 0]
        given[1, row, 0, queries] = mixed[0]
        made = torch.vmap(lambda output: replay(call.laid_out(output)))(given).flatten(1, -2)
        of_query, of_head = ((made[:2] - made[2]).abs().amax(dim=-1) > 0).sum(dim=1).tolist()
        if of_query > of_head:
            raise NotReplayed("its heads and queries are exchanged, as the tokens show to which they go", turned=True)

    @property
    def turned(self) -> bool:
        """Whether heads and queries of some call are exchanged."""
        return any(way.turned for _, way in self._places)

    def rows_apart(self) -> bool | None:
        """Whether each row of the batch adds to its own tokens alone; None where that is not known."""
        ways = [way for _, way in self._places]
        if any(way.mixes_rows for way in ways):
            return False
        return True if any(way.result() is not None for way in ways) else None

    def unknown(self) -> str | None:
        """Say why it is not known what the parts of the keys add to the residual stream; None if it is known."""
        for place, way in self._places:
            if way.result() is None:
                return f"in block {place.block} of site '{place.site}' (step {place.step}), {way.lost}"
        return None

    def sums(self) -> dict[tuple[str, int], int | None]:
        """Return by site and block which sum was the stream; None where it was not the same in all calls."""
        sums: dict[tuple[str, int], int | None] = {}
        for place, way in self._places:
            number = len(way.taken) if way.result() is not None and way.taken else None
            key = place.site or "", place.block
            sums[key] = number if sums.get(key, number) == number else None
        return sums

    def compare_sums(self, known: Mapping[tuple[str, int], int]) -> None:
        """Lose the contributions of blocks whose stream is another sum than it was in other calls."""
        for place, way in self._places:
            number = known.get((place.site or "", place.block))
            if number is not None and way.result() is not None and way.taken and len(way.taken) != number:
                way.lost = (
                    f"the residual stream is the sum number {len(way.taken)} with what the attention gave, and was "
                    f"number {number} in the calls before: the policy computes something else than in its first calls"
                )


def _allowed(call: AttentionCall, dtypes: Iterable[torch.dtype]) -> float:
    """The largest difference, relative to the largest number, of what is computed twice in a call and behind it."""
    names = [call.precision, *(str(dtype).removeprefix("torch.") for dtype in dtypes)]
    return max(TOLERANCE.get(name, 0.0) for name in names)
