"""What is added to the logits of a repeated call, and the watcher that adds it and records nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.interventions.attention_edits import SiteEdit
from vla_attention.capture.torch_policies.added_updates import OutputWay
from vla_attention.capture.torch_policies.attention_calls import AttentionCall, CallShape
from vla_attention.capture.torch_policies.call_order import CallPlace, KnownCalls
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused
from vla_attention.capture.torch_policies.knockouts import edits_at, logit_bias, prefix_bias
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.capture.torch_policies.site_recorder import ReplanRecorder
from vla_attention.schemas.stores.store_format import Recording


@dataclass
class RepeatBias:
    """What edits add to the logits of one repeated call, zeros where they change nothing; see `LogitBias`.

    edits: by site. present: site -> (key,) bool, the keys that the recorded call had.
    """

    layout: PolicyLayout
    edits: Mapping[str, Sequence[SiteEdit]]
    present: Mapping[str, NDArray[np.bool_]]
    _known: dict[tuple[Any, ...], NDArray[np.float32]] = field(default_factory=dict)

    def __call__(self, row: int, place: CallPlace, shape: CallShape) -> NDArray[np.float32] | None:
        """Return what is added, (head or 1, query, key). Calls to which the same is added get the same array."""
        rule = self.layout.rules[place.rule]
        if place.site is None and not rule.is_prefix:
            return None
        edits = self.edits.get(place.site or rule.tokens or "", ())
        edits = edits_at(edits, place) if place.site else [edit for edit in edits if edit.queries != "action"]
        if self.edits and not edits:
            return None
        token = -1 if place.keys is None else place.step
        sizes = shape.heads, shape.queries, shape.keys, place.queries.start, place.queries.stop, token
        call = place.rule, place.site, tuple(id(edit) for edit in edits), *sizes
        if call not in self._known:
            if place.site is None:
                self._known[call] = prefix_bias(edits, self._tokens(rule.tokens or "", shape), shape)
            else:
                self._known[call] = logit_bias(edits, place, shape, self._own_keys(place.site, shape))
        return self._known[call]

    def _tokens(self, site: str, shape: CallShape) -> NDArray[np.int64]:
        """The site's keys that are queries and keys of a pass over the prefix."""
        tokens = np.flatnonzero(self.present[site])[: shape.keys]
        actions = [span for span in self.layout.site(site).keys.spans if span.kind == "action"]
        first_action = min((span.start for span in actions), default=self.layout.site(site).keys.num_keys)
        if shape.queries != shape.keys or len(tokens) < shape.keys or (tokens >= first_action).any():
            raise ChangeRefused(
                f"The attention call {shape} is no pass over the first keys of site '{site}', of which {first_action} "
                "stand before the actions: expected as many queries as keys, and no more than these. Change the rule "
                "with these tokens in the layout."
            )
        return tokens

    def _own_keys(self, site: str, shape: CallShape) -> slice | None:
        """The keys of the call's own queries, the last ones; None for a site without keys of actions."""
        spans = self.layout.site(site).keys.spans
        if shape.keys < shape.queries or not any(span.kind == "action" for span in spans):
            return None
        return slice(shape.keys - shape.queries, shape.keys)


class RepeatWatcher(ReplanRecorder):
    """Changes the calls of a repeat and records none.

    seen: site -> (key,) bool, the keys that the site's first call could see.
    """

    def __init__(self, known: KnownCalls, policy: str, recording: Recording, bias: RepeatBias | None) -> None:
        super().__init__(known, policy, recording, 1, [0], {}, _no_roles, bias)
        self.seen: dict[str, NDArray[np.bool_]] = {}

    def change(self, shape: CallShape) -> Tensor | None:
        """See `Watcher`; a call of several rows cannot be changed."""
        if self.bias is not None and shape.batch != self.batch and self.changed_place(shape) is not None:
            raise ChangeRefused(
                f"The attention call {shape} has a batch of {shape.batch}, and effects are of calls of one row."
            )
        return super().change(shape)

    def passes(self, shape: CallShape) -> bool:
        """See `Watcher`; of the first call of each site the mask is looked at."""
        place = self.order.place(shape)
        if place is not None and place.site is not None and place.site not in self.seen:
            return False
        return super().passes(shape)

    def saw(self, call: AttentionCall) -> OutputWay | None:
        """See `Watcher`."""
        place = self.order.place(call.shape)
        if place is not None and place.site is not None and place.site not in self.seen:
            allowed = call.allowed(place.queries).any(dim=2).any(dim=1).any(dim=0).cpu().numpy()
            seen = np.zeros(self.order.known.sites[place.site].keys.num_keys, dtype=bool)
            seen[slice(None) if place.keys is None else place.keys] = allowed
            self.seen[place.site] = seen
        return super().saw(call)

    def _wanted(self, place: CallPlace) -> bool:
        return False


def _no_roles(row: int, site: Any, present: NDArray[np.bool_]) -> NDArray[np.uint8]:
    raise AssertionError("A repeated call has no contributions.")
