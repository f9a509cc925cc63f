"""Knockouts in a policy of the caller: which keys, and what is added to the logits of each call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.interventions.attention_edits import SiteEdit, log_factors
from vla_attention.capture.interventions.resolution import (
    ReplanPlace,
    check_not_empty,
    check_selectors,
    empty_replans,
    make_editors,
    run_vocabularies,
    site_tokens,
)
from vla_attention.capture.torch_policies.attention_calls import CallShape
from vla_attention.capture.torch_policies.call_order import CallPlace
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.interventions import AttentionScale, Interventions, KeyKnockout
from vla_attention.schemas.layout import Prompt, SiteLayout


class CannotIntervene(BadArgument):
    """An intervention that cannot be made in a policy of the caller."""


def interventions_of(
    knockout: str | Sequence[str] | Interventions | None,
    keep: str | None,
    layers: Sequence[int] | None,
    heads: Sequence[int] | None,
    denoise_steps: Sequence[int] | None,
    weight: float,
    layout: PolicyLayout,
) -> Interventions:
    """Return the interventions of a session; raise `CannotIntervene` for those that need more than an additive mask."""
    places = {
        "layers": _numbers("layer", layers, layout.num_layers),
        "heads": _numbers("head", heads, layout.num_heads),
        "denoise_steps": _numbers("denoise step", denoise_steps, layout.num_denoise_steps),
    }
    if isinstance(knockout, Interventions):
        if keep is not None or any(chosen is not None for chosen in places.values()):
            raise BadArgument("Give knockouts as Interventions, or by selectors with layers and heads, not both.")
        _check(knockout)
        return knockout
    selectors = [knockout] if isinstance(knockout, str) else list(knockout or ())
    named = [(selector, False) for selector in selectors] + ([(keep, True)] if keep is not None else [])
    keys = [
        KeyKnockout(
            selector,
            keep=others,
            weight=weight,
            layers=places["layers"],
            heads=places["heads"],
            # One step without a denoising loop; the calls of an autoregressive policy are its tokens.
            denoise_steps=places["denoise_steps"] if layout.num_denoise_steps > 1 else None,
        )
        for selector, others in named
    ]
    if not keys and any(chosen is not None for chosen in places.values()):
        raise BadArgument("knockout_layers, knockout_heads and knockout_denoise_steps need a knockout or keep.")
    return Interventions(keys=tuple(keys))


def _numbers(what: str, numbers: Sequence[int] | None, count: int) -> tuple[int, ...] | None:
    if numbers is None:
        return None
    for number in numbers:
        if not 0 <= number < count:
            raise BadArgument(f"There is no {what} {number} for a knockout; expected 0 to {count - 1}.")
    return tuple(sorted(set(numbers)))


def _check(interventions: Interventions) -> None:
    if interventions.changes_input or interventions.noise is not None:
        raise CannotIntervene(
            f"Cannot record with {interventions.describe()}: prompt, pictures and noise are given to the policy by "
            "your own code; change them there, and give only knockouts and factors of attention."
        )
    for edit in (*interventions.keys, *interventions.attention):
        if not isinstance(edit, (KeyKnockout, AttentionScale)):
            raise CannotIntervene(
                f"Cannot record with {edit.describe()}: only what is added to the logits of a call can be changed, a "
                "knockout or a factor."
            )
        if edit.queries != "action":
            raise CannotIntervene(
                f"Cannot record with {edit.describe()}: a layout knows the action queries of a call only; use the "
                "queries 'action'."
            )
        if isinstance(edit, KeyKnockout) and edit.random_seed is not None:
            raise CannotIntervene(
                f"Cannot record with {edit.describe()}: which keys the policy masks is known only after the call; name "
                "the keys of the control, for instance with patch:CAMERA[rows,columns]."
            )


@dataclass
class SessionKnockouts:
    """Makes the edits of every replan of a session.

    num_replans, num_empty: replans so far, and those in which some group had no key.
    """

    interventions: Interventions
    allow_empty: bool = False
    num_replans: int = field(default=0, init=False)
    num_empty: int = field(default=0, init=False)

    @property
    def any(self) -> bool:
        """Whether attention is changed at all."""
        return self.interventions.changes_attention

    def check_names(self, sites: Sequence[SiteLayout], instruction: str, objects: Sequence[SceneObject]) -> None:
        """Raise `SelectorError` for a selector with a name that does not exist in an episode of this instruction."""
        if self.any:
            check_selectors(self.interventions, run_vocabularies(sites, [instruction], objects))

    def edits(
        self,
        sites: Sequence[SiteLayout],
        key_role: Mapping[str, NDArray[np.uint8]],
        prompt: Prompt,
        objects: Sequence[SceneObject],
        coverage: Mapping[str, NDArray[np.float32]],
        place: ReplanPlace,
    ) -> dict[str, Sequence[SiteEdit]]:
        """Return the edits of one replan by site; errors as `AttentionChanges.editors`."""
        self.num_replans += 1
        tokens = site_tokens(sites, key_role, prompt, objects, coverage)
        vocabularies = run_vocabularies(sites, [prompt.instruction_text], objects)
        if not self.allow_empty:
            check_not_empty(self.interventions, tokens, vocabularies, place)
        elif any(empty.any() for empty in empty_replans(self.interventions, tokens, vocabularies).values()):
            self.num_empty += 1
        editors = make_editors(self.interventions, tokens, vocabularies, place)
        return {site: editor.edits for site, editor in editors.items()}


def edits_at(edits: Sequence[SiteEdit], place: CallPlace) -> list[SiteEdit]:
    """Return the edits that change one call."""
    return [
        edit
        for edit in edits
        if (edit.layers is None or place.block in edit.layers)
        and (edit.denoise_steps is None or place.step in edit.denoise_steps)
        and not (edit.values == 1).all()
    ]


def logit_bias(edits: Sequence[SiteEdit], place: CallPlace, shape: CallShape) -> NDArray[np.float32]:
    """Return what edits add to the logits of one call, (head or 1, query, key).

    The logarithm of a key's factor, and -infinity where it is 0, at the action queries.
    """
    heads = shape.heads if any(edit.heads is not None for edit in edits) else 1
    total = np.zeros((heads, shape.queries, shape.keys), dtype=np.float32)
    for edit in edits:
        values = edit.values if place.keys is None else edit.values[place.keys]
        added = np.where(values == 0, -np.inf, log_factors(values)).astype(np.float32)
        chosen = slice(None) if edit.heads is None else list(edit.heads)
        total[chosen, place.queries] += added
    return total


def with_name(interventions: Interventions, name: str) -> Interventions:
    """Return the interventions with the name of their condition."""
    return replace(interventions, name=name) if name else interventions
