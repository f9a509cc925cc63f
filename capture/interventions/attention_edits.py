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

from vla_attention.capture.recording.attention import MASKED_LOGIT, AttentionEditor, LogitChange
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


@dataclass
class SiteEditor(AttentionEditor):
    """Applies the edits of one site during one replan, one after the other. Every replan needs a new one."""

    site: str
    edits: Sequence[SiteEdit]
    #: Values of the edits on the model's device, by the edit's number.
    _values: dict[int, Tensor] = field(default_factory=dict, init=False, repr=False)

    def step_change(
        self, layer: int, denoise_step: int, action_queries: slice, own_keys: slice | None
    ) -> LogitChange | None:
        """Return the change of a call of a denoise step, or None if nothing changes there."""
        numbers = [
            number
            for number, edit in self._at_layer(layer)
            if edit.queries != "prefix"
            and (edit.denoise_steps is None or denoise_step in edit.denoise_steps)
            and (edit.queries == "all" or action_queries.stop > action_queries.start)
        ]
        if not numbers:
            return None
        where = f"layer {layer}, denoise step {denoise_step}"

        def change(logits: Tensor) -> Tensor:
            count, keys = logits.shape[-2:]
            is_action = torch.zeros(count, dtype=torch.bool, device=logits.device)
            is_action[action_queries] = True
            own = None
            if own_keys is not None and not bool(is_action.all()):
                own = torch.zeros(count, keys, dtype=torch.bool, device=logits.device)
                own[torch.arange(count), torch.arange(own_keys.start, own_keys.stop)] = True
                own &= ~is_action[:, None]
            changed = logits
            for number in numbers:
                whole = self.edits[number].queries == "all"
                changed = self._apply(number, changed, None, own if whole else None, None if whole else is_action)
            self._check_keys_left(numbers, logits, changed, where)
            return changed

        return change

    def prefix_change(self, layer: int, tokens: Tensor) -> LogitChange | None:
        """Return the change of a call before the first denoise step, or None if nothing changes there."""
        numbers = [number for number, edit in self._at_layer(layer) if edit.queries != "action"]
        if not numbers:
            return None

        def change(logits: Tensor) -> Tensor:
            own = torch.eye(len(tokens), dtype=torch.bool, device=logits.device)
            changed = logits
            for number in numbers:
                readers = self.edits[number].readers
                chosen = None if readers is None else torch.from_numpy(readers).to(logits.device)[tokens]
                changed = self._apply(number, changed, tokens, own, chosen)
            self._check_keys_left(numbers, logits, changed, f"the prefix's layer {layer}")
            return changed

        return change

    def _at_layer(self, layer: int) -> list[tuple[int, SiteEdit]]:
        return [
            (number, edit)
            for number, edit in enumerate(self.edits)
            if not edit.changes_nothing and (edit.layers is None or layer in edit.layers)
        ]

    def _apply(
        self, number: int, logits: Tensor, keys: Tensor | None, own: Tensor | None, queries: Tensor | None
    ) -> Tensor:
        """Apply one edit to logits (batch, head, query, key).

        keys: the site's keys on the key axis, None for all. own: (query, key) bool, places that stay as they are.
        queries: (query,) bool, the queries that change, None for all.
        """
        edit = self.edits[number]
        if number not in self._values:
            self._values[number] = torch.from_numpy(edit.values).to(logits.device)
        values = self._values[number] if keys is None else self._values[number][keys]
        if edit.kind == "factor":
            changed = scale_weights(logits, values)
        else:
            members = values.float() if own is None else torch.where(own, 0.0, values.float())
            changed = make_uniform(logits, members)
        stays = torch.zeros(1, 1, dtype=torch.bool, device=logits.device) if own is None else own
        if queries is not None:
            stays = stays | ~queries[:, None]
        if edit.heads is not None:
            stays = stays.expand(logits.shape[1], *stays.shape).clone()
            stays[[head for head in range(logits.shape[1]) if head not in edit.heads]] = True
        return torch.where(stays, logits, changed)

    def _check_keys_left(self, numbers: Sequence[int], before: Tensor, after: Tensor, where: str) -> None:
        """Raise `QueryWithoutKeys` if a query that had keys has none any more."""
        lost = (before.amax(-1) > _LOWEST_LOGIT) & (after.amax(-1) <= _LOWEST_LOGIT)
        if bool(lost.any()):
            _, head, query = (int(i) for i in lost.nonzero()[0])
            groups = "; ".join(self.edits[number].group for number in numbers)
            raise QueryWithoutKeys(
                f"An intervention leaves a query without any key at site '{self.site}', {where}, head {head}, query "
                f"{query}: {groups}. Take a smaller group, a weight below 1, or fewer heads or layers."
            )


def scale_weights(logits: Tensor, factors: Tensor) -> Tensor:
    """Multiply the weights before normalising by the keys' factors (key,), 0 or more.

    logits: (..., key) float32. A factor of 1 leaves a logit as it is, a factor of 0 makes it `MASKED_LOGIT`.
    """
    bias = torch.log(torch.where(factors > 0, factors.double(), 1.0)).float()
    return (logits + bias).masked_fill(factors == 0, MASKED_LOGIT)


def make_uniform(logits: Tensor, weights: Tensor) -> Tensor:
    """Replace the weights before normalising by their mean inside of a group, which keeps its sum.

    logits: (..., query, key) float32. weights: (key,) or (query, key) float32 in 0..1, the keys' weights in the group.
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
