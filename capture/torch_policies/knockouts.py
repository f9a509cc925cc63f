"""Knockouts in a policy of the caller: which keys, and what is added to the logits of each call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.interventions.factors import SiteEdit, logit_bias
from vla_attention.capture.interventions.resolution import selectors_of
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.recording.attention import CallKeys
from vla_attention.capture.torch_policies.attention_calls import CallShape
from vla_attention.capture.torch_policies.call_order import CallPlace
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.capture.torch_policies.replan_inputs import EpisodeFacts
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.selector_parser import atoms_of, parse_selector
from vla_attention.schemas.interventions import AttentionScale, Interventions, KeyKnockout
from vla_attention.schemas.layout import SiteLayout


def check_interventions(interventions: Interventions, layout: PolicyLayout) -> None:
    """Raise `BadArgument` for interventions that need more than an additive mask, or places that the layout lacks."""
    if interventions.changes_input or interventions.noise is not None:
        raise BadArgument(
            f"Cannot record with {interventions.describe()}: prompt, pictures and noise are given to the policy by "
            "your own code; change them there, and give only knockouts and factors of attention."
        )
    counts = {"layer": layout.num_layers, "head": layout.num_heads, "denoise step": layout.num_denoise_steps}
    for edit in (*interventions.keys, *interventions.attention):
        for (what, count), chosen in zip(counts.items(), (edit.layers, edit.heads, edit.denoise_steps), strict=True):
            # Without a denoising loop there is one step; the calls of an autoregressive policy are its tokens.
            if chosen is not None and (chosen[-1] >= count or (what == "denoise step" and count == 1)):
                raise BadArgument(
                    f"There is no {what} {chosen[-1]} for {edit.describe()}; '{layout.name}' has {count}: leave "
                    f"{what}s out, or give 0 to {count - 1}."
                )
        if not isinstance(edit, (KeyKnockout, AttentionScale)):
            raise BadArgument(
                f"Cannot record with {edit.describe()}: only what is added to the logits of a call can be changed, a "
                "knockout or a factor."
            )
        if edit.queries != "action":
            raise BadArgument(
                f"Cannot record with {edit.describe()}: a layout knows the action queries of a call only; use the "
                "queries 'action' (--knockout-queries action)."
            )
        if isinstance(edit, KeyKnockout) and edit.random_seed is not None:
            raise BadArgument(
                f"Cannot record with {edit.describe()}: which keys the policy masks is known only after the call; name "
                "the keys of the control, for instance with patch:CAMERA[rows,columns]."
            )


def changes_of_episode(
    interventions: Interventions, sites: Sequence[SiteLayout], facts: EpisodeFacts, *, allow_empty: bool
) -> RunChanges:
    """Return what changes the calls of an episode.

    sites: of the store. allow_empty: a group without a key changes nothing.

    Raises:
        SelectorError: a name exists neither in the instruction nor in the scene.
    """
    words: list[str] = []
    if allow_empty:  # words that the instruction lacks are no mistake
        atoms = (atom for text in selectors_of(interventions) for atom in atoms_of(parse_selector(text)))
        words = [atom.argument for atom in atoms if atom.kind == "word"]
    changes = RunChanges(interventions, dict(enumerate([facts.instruction, *words])), allow_empty)
    if interventions.changes_attention:
        changes.check_names(sites, facts.objects)
    return changes


@dataclass
class CallBias:
    """What edits add to the logits of the attention calls of one row. Without edits, zeros.

    edits: by site. present: site -> (key,) bool, the keys that the policy call has.
    """

    layout: PolicyLayout
    edits: Mapping[str, Sequence[SiteEdit]]
    present: Mapping[str, NDArray[np.bool_]]
    _known: dict[tuple[Any, ...], NDArray[np.float32]] = field(default_factory=dict)

    def __call__(self, place: CallPlace, shape: CallShape) -> NDArray[np.float32] | None:
        """Return what is added, (head or 1, query, key). Calls to which the same is added get the same array."""
        rule = self.layout.rules[place.rule]
        if place.site is None and not rule.is_prefix:
            return None
        edits = self.edits.get(place.site or rule.tokens or "", ())
        if place.site:
            edits = [edit for edit in edits if edit.queries != "prefix" and edit.is_at(place.block, place.step)]
        else:
            edits = [edit for edit in edits if edit.queries != "action"]
        if self.edits and not edits:
            return None
        token = -1 if place.keys is None else place.step
        sizes = shape.heads, shape.queries, shape.keys, place.queries.start, place.queries.stop, token
        call = place.rule, place.site, tuple(id(edit) for edit in edits), *sizes
        if call not in self._known:
            count = shape.keys - (self.layout.site(place.site).sinks if place.site else 0)
            if place.site is None:
                keys = CallKeys.of_prefix(self._tokens(rule.tokens or "", shape))
            else:
                # The keys of the call's own queries are the last ones, of a site that has keys of actions.
                has_actions = any(span.kind == "action" for span in self.layout.site(place.site).keys.spans)
                own = slice(count - shape.queries, count) if has_actions else None
                keys = CallKeys(place.queries, own if count >= shape.queries else None, place.keys)
            bias = self._known[call] = logit_bias(edits, (shape.heads, shape.queries, shape.keys), keys)
            bias[..., count:] = 0
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
