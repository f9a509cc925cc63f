"""The arithmetic of interventions on attention: logits are changed between the mask and the softmax.

With the weight before normalising u_k = exp(logit_k) of key k:

- A factor f_k: u_k becomes f_k · u_k; log f_k is added to the logit. A knockout of a key of weight w has f = 1 - w.
  Where f = 0 the logit becomes `MASKED_LOGIT`, so that the probability is exactly 0.
- Uniform inside a group of weights w: u_k becomes (1 - w_k) · u_k + w_k · Σ w u / Σ w. The sum of u stays, and with
  weights of 0 and 1 every key of the group gets the mean of the group's u. Masked keys are no members.

Queries other than the action queries keep their own key as it was, in the prefix too: a token that no other reads any
more still reads itself, as nothing is passed on by that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.recording.attention import MASKED_LOGIT, CallKeys, FactorEditor, LogitChange, log_factors
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Queries

#: Logits below this are of masked keys.
_LOWEST_LOGIT = MASKED_LOGIT / 2


class QueryWithoutKeys(BadArgument):
    """An intervention that takes away every key of a query."""


@dataclass(frozen=True)
class SiteEdit:
    """One intervention on the keys of one site in one replan.

    Attributes:
        group: the intervention in words, for errors.
        kind: `factor`: `values` (key,) float64 are the keys' factors. `uniform`: they are weights in the group, 0 to 1.
        queries: whose attention changes, see `KeyKnockout`.
        readers: the keys whose tokens are the changed queries of the prefix, (key,) bool; None for all of them.
        layers, heads, denoise_steps: where attention changes; None is everywhere.
    """

    group: str
    kind: Literal["factor", "uniform"]
    values: NDArray[np.float64]
    queries: Queries = "action"
    readers: NDArray[np.bool_] | None = None
    layers: tuple[int, ...] | None = None
    heads: tuple[int, ...] | None = None
    denoise_steps: tuple[int, ...] | None = None

    @property
    def changes_nothing(self) -> bool:
        """Whether no key has another factor than 1, or a weight in the group."""
        return bool((self.values == (1.0 if self.kind == "factor" else 0.0)).all())

    def is_at(self, layer: int, denoise_step: int | None) -> bool:
        """Whether something changes in a layer and denoise step; in every step for None."""
        if self.changes_nothing or (self.layers is not None and layer not in self.layers):
            return False
        return denoise_step is None or self.denoise_steps is None or denoise_step in self.denoise_steps

    def reaches(self, call: CallKeys) -> bool:
        """Whether some query of a call is one whose attention changes."""
        if call.in_prefix:
            return self.queries != "action"
        has_actions = call.action_queries.stop > call.action_queries.start
        return self.queries == "all" or (self.queries == "action" and has_actions)

    def values_at(self, call: CallKeys) -> NDArray[np.float64]:
        """The values of a call's keys, (key,)."""
        return self.values if call.numbers is None else self.values[call.numbers]

    def changed(self, queries: int, call: CallKeys) -> NDArray[np.bool_]:
        """Where the edit may change something in a call with so many queries, (query, key)."""
        is_action = np.zeros(queries, dtype=bool)
        is_action[call.action_queries] = True
        changed = np.ones((queries, len(self.values_at(call))), dtype=bool)
        if self.queries == "action":
            changed[~is_action] = False
        elif call.own_keys is not None:
            changed[np.arange(queries), np.arange(call.own_keys.start, call.own_keys.stop)] = is_action
        if call.in_prefix and self.readers is not None:
            changed[~self.readers[call.numbers]] = False
        return changed

    def factors(self, queries: int, call: CallKeys) -> NDArray[np.float64]:
        """The factors of a call with so many queries, (query, key); of an edit that has factors."""
        return np.where(self.changed(queries, call), self.values_at(call), 1.0)


@dataclass(frozen=True)
class _Operands:
    """What one edit does to the logits of one kind of call, on the model's device; None where nothing is to be done.

    Axes (head or 1, query or 1, key). bias: added to the logits. dead: keys that become `MASKED_LOGIT`. members:
    weights in a group that is made uniform.
    """

    bias: Tensor | None = None
    dead: Tensor | None = None
    members: Tensor | None = None


@dataclass(eq=False)
class SiteEditor(FactorEditor):
    """Applies the edits of one site during one replan, one after the other. Every replan needs a new one.

    The changes that it returns may write to the logits that they are given.
    """

    site: str
    edits: Sequence[SiteEdit]
    #: By the edit's number and the kind of call, which are the same at every layer and denoise step.
    _operands: dict[tuple[int, object], _Operands] = field(default_factory=dict, init=False, repr=False)
    #: Queries (batch, head, query) that a call left without keys, where that was, and by which groups. They stay on the
    #: device until the end: a GPU would wait for each that is read.
    _lost: list[tuple[Tensor, str, str]] = field(default_factory=list, init=False, repr=False)

    def change(self, layer: int, denoise_step: int | None, call: CallKeys) -> LogitChange | None:
        """See `AttentionEditor`."""
        numbers = [
            number for number, edit in enumerate(self.edits) if edit.is_at(layer, denoise_step) and edit.reaches(call)
        ]
        if not numbers:
            return None
        where = f"layer {layer}, denoise step {denoise_step}"
        return self._change(numbers, call, f"the prefix's layer {layer}" if denoise_step is None else where)

    def finish(self) -> None:
        """See `AttentionEditor`."""
        if self._lost and bool(torch.stack([lost.any() for lost, *_ in self._lost]).cpu().any()):
            for lost, where, why in self._lost:
                check_keys_left(lost, where, why)

    @property
    def changes_prefix(self) -> bool:
        """See `FactorEditor`."""
        return any(edit.queries != "action" for edit in self._everywhere())

    def factors(self, queries: int, call: CallKeys) -> NDArray[np.float64] | None:
        """See `FactorEditor`."""
        found = [edit.factors(queries, call) for edit in self._everywhere() if edit.reaches(call)]
        return np.prod(found, axis=0) if found else None

    def _everywhere(self) -> list[SiteEdit]:
        """The edits, if all are factors at every layer, head and denoise step."""
        for edit in self.edits:
            if edit.kind != "factor" or any((edit.layers, edit.heads, edit.denoise_steps)):
                raise ValueError(f"{edit.group}: no factor that is the same at all layers, heads and denoise steps")
        return [edit for edit in self.edits if not edit.changes_nothing]

    def _change(self, numbers: Sequence[int], call: CallKeys, where: str) -> LogitChange:
        own = None if call.own_keys is None else call.own_keys.start
        kind = (call.in_prefix, call.action_queries.start, call.action_queries.stop, own)

        def change(logits: Tensor) -> Tensor:
            had_keys = logits.amax(-1) > _LOWEST_LOGIT
            for number in numbers:
                if (number, kind) not in self._operands:
                    self._operands[number, kind] = _operands_of(self.edits[number], call, logits)
                logits = _applied(self._operands[number, kind], logits)
            groups = "; ".join(self.edits[number].group for number in numbers)
            lost = had_keys & (logits.amax(-1) <= _LOWEST_LOGIT)
            self._lost.append((lost, f"site '{self.site}', {where}", f": {groups}"))
            return logits

        return change


def check_keys_left(lost: Tensor, where: str, why: str = "") -> None:
    """Raise `QueryWithoutKeys` if there are queries that had keys and have none any more, (batch, head, query) bool."""
    if bool(lost.any()):
        batch, head, query = (int(i) for i in lost.nonzero()[0])
        row = f", batch row {batch}" if len(lost) > 1 else ""
        raise QueryWithoutKeys(
            f"An intervention leaves a query without any key at {where}{row}, head {head}, query {query}"
            f"{why}. Take a smaller group, a weight below 1, or fewer heads or layers."
        )


def _operands_of(edit: SiteEdit, call: CallKeys, logits: Tensor) -> _Operands:
    """Return the operands of an edit in a call with these logits (batch, head, query, key)."""
    heads, queries, _ = logits.shape[1:]
    changes = edit.changed(queries, call)[None]
    if edit.heads is not None:
        changes = changes & np.isin(np.arange(heads), edit.heads)[:, None, None]
    # Axes along which all is the same have length 1.
    changes = changes[:, :1] if (changes == changes[:, :1]).all() else changes
    values = edit.values_at(call)
    if edit.kind == "uniform":
        return _Operands(members=torch.from_numpy(np.where(changes, values, 0.0).astype(np.float32)).to(logits.device))
    factors = np.where(changes, values, 1.0)
    bias = torch.from_numpy(log_factors(factors)).to(logits.device) if not np.isin(factors, (0.0, 1.0)).all() else None
    dead = torch.from_numpy(factors == 0).to(logits.device) if (factors == 0).any() else None
    return _Operands(bias, dead)


def _applied(operands: _Operands, logits: Tensor) -> Tensor:
    """Return the logits (batch, head, query, key) after an edit."""
    if operands.members is not None:
        return make_uniform(logits, operands.members)
    if operands.bias is not None:
        logits.add_(operands.bias)
    if operands.dead is not None:
        logits.masked_fill_(operands.dead, MASKED_LOGIT)
    return logits


def logit_bias(edits: Sequence[SiteEdit], sizes: tuple[int, int, int], call: CallKeys) -> NDArray[np.float32]:
    """Return what edits that have factors add to the logits of a call, (head or 1, query, key); -inf for a factor 0.

    sizes: heads, queries and keys of the call. One head stands for all where no edit has heads of its own.
    """
    heads, queries, keys = sizes
    bias = np.zeros((heads if any(edit.heads is not None for edit in edits) else 1, queries, keys), np.float32)
    for edit in edits:
        factors = edit.factors(queries, call)
        added = np.where(factors == 0, -np.inf, log_factors(factors)).astype(np.float32)
        chosen = np.isin(np.arange(len(bias)), edit.heads)[:, None, None] if edit.heads is not None else True
        bias = bias + np.where(chosen, added, np.float32(0))
    return bias


def make_uniform(logits: Tensor, weights: Tensor) -> Tensor:
    """Replace the weights before normalising by their mean inside of a group, which keeps its sum.

    logits: (..., query, key) float32. weights: (..., key) float32 in 0..1, the keys' weights in the group.
    """
    members = torch.where(logits > _LOWEST_LOGIT, weights, 0.0)
    inside = members > 0
    # Relative to the group's largest weight, so that a group of small weights does not become 0.
    highest = torch.where(inside, logits, MASKED_LOGIT).amax(-1, keepdim=True)
    relative = torch.where(inside, torch.exp(logits - highest), 0.0)
    total = (members * relative).sum(-1, keepdim=True)
    mean = total / members.sum(-1, keepdim=True).clamp(min=torch.finfo(torch.float32).tiny)
    mixed = (1 - members) * relative + members * mean
    return torch.where(inside, torch.log(mixed) + highest, logits)
