"""Knockouts in a policy of the caller: which keys, and what is added to the logits of each call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from vla_attention.capture.interventions.attention_edits import (
    SiteEdit,
    log_factors,
    stays_at_step,
    stays_in_prefix,
)
from vla_attention.capture.interventions.resolution import (
    ReplanPlace,
    check_selectors,
    has_empty_group,
    make_editors,
    run_vocabularies,
    selectors_of,
    site_tokens,
)
from vla_attention.capture.torch_policies.attention_calls import CallShape
from vla_attention.capture.torch_policies.call_order import CallPlace
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.capture.torch_policies.replan_inputs import ReplanInputs
from vla_attention.capture.torch_policies.replan_text import ReplanText
from vla_attention.capture.torch_policies.site_recorder import ReplanRecorder
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.selector_parser import atoms_of, parse_selector
from vla_attention.schemas.groupings.vocabulary import SceneObject, Vocabulary
from vla_attention.schemas.interventions import AttentionScale, Interventions, KeyKnockout
from vla_attention.schemas.layout import Prompt, SiteLayout

if TYPE_CHECKING:
    from vla_attention.capture.torch_policies.recorded_episodes import Episode
    from vla_attention.capture.torch_policies.session import RecordedRun


def interventions_of(
    knockout: str | Sequence[str] | Interventions | None,
    keep: str | None,
    layers: Sequence[int] | None,
    heads: Sequence[int] | None,
    denoise_steps: Sequence[int] | None,
    weight: float,
    layout: PolicyLayout,
) -> Interventions:
    """Return the interventions of a session; raise `BadArgument` for those that need more than an additive mask."""
    places = {
        "layers": _places_of_layout("layer", layers, layout.num_layers),
        "heads": _places_of_layout("head", heads, layout.num_heads),
        "denoise_steps": _places_of_layout("denoise step", denoise_steps, layout.num_denoise_steps),
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


def _places_of_layout(what: str, numbers: Sequence[int] | None, count: int) -> tuple[int, ...] | None:
    if numbers is None:
        return None
    for number in numbers:
        if not 0 <= number < count:
            raise BadArgument(f"There is no {what} {number} for a knockout; expected 0 to {count - 1}.")
    return tuple(sorted(set(numbers)))


def _check(interventions: Interventions) -> None:
    if interventions.changes_input or interventions.noise is not None:
        raise BadArgument(
            f"Cannot record with {interventions.describe()}: prompt, pictures and noise are given to the policy by "
            "your own code; change them there, and give only knockouts and factors of attention."
        )
    for edit in (*interventions.keys, *interventions.attention):
        if not isinstance(edit, (KeyKnockout, AttentionScale)):
            raise BadArgument(
                f"Cannot record with {edit.describe()}: only what is added to the logits of a call can be changed, a "
                "knockout or a factor."
            )
        if edit.queries != "action":
            raise BadArgument(
                f"Cannot record with {edit.describe()}: a layout knows the action queries of a call only; use the "
                "queries 'action'."
            )
        if isinstance(edit, KeyKnockout) and edit.random_seed is not None:
            raise BadArgument(
                f"Cannot record with {edit.describe()}: which keys the policy masks is known only after the call; name "
                "the keys of the control, for instance with patch:CAMERA[rows,columns]."
            )


@dataclass(frozen=True)
class SessionKnockouts:
    """Makes the edits of every replan of a session. allow_empty: a group without a key changes nothing."""

    interventions: Interventions
    allow_empty: bool = False

    @property
    def any(self) -> bool:
        """Whether attention is changed at all."""
        return self.interventions.changes_attention

    def check_names(self, sites: Sequence[SiteLayout], instruction: str, objects: Sequence[SceneObject]) -> None:
        """Raise `SelectorError` for a selector with a name that does not exist in an episode of this instruction."""
        if self.any:
            check_selectors(self.interventions, self._vocabularies(sites, instruction, objects))

    def _vocabularies(
        self, sites: Sequence[SiteLayout], instruction: str, objects: Sequence[SceneObject]
    ) -> dict[str, Vocabulary]:
        """The names of an episode; where groups may be empty, words that its instruction lacks are no mistake."""
        words: list[str] = []
        if self.allow_empty:
            atoms = (atom for text in selectors_of(self.interventions) for atom in atoms_of(parse_selector(text)))
            words = [atom.argument for atom in atoms if atom.kind == "word"]
        return run_vocabularies(sites, [instruction, *words], objects)

    def edits(
        self,
        sites: Sequence[SiteLayout],
        key_role: Mapping[str, NDArray[np.uint8]],
        prompt: Prompt,
        objects: Sequence[SceneObject],
        coverage: Mapping[str, NDArray[np.float32]],
        place: ReplanPlace,
    ) -> dict[str, Sequence[SiteEdit]]:
        """Return the edits of one replan by site; errors as `RunChanges.editors`."""
        tokens = site_tokens(sites, key_role, prompt, objects, coverage)
        vocabularies = self._vocabularies(sites, prompt.instruction_text, objects)
        has_empty_group(self.interventions, tokens, vocabularies, place, allow_empty=self.allow_empty)
        editors = make_editors(self.interventions, tokens, vocabularies, place)
        return {site: editor.edits for site, editor in editors.items()}


def edits_at(edits: Sequence[SiteEdit], place: CallPlace) -> list[SiteEdit]:
    """Return the edits that change one call of a site."""
    return [
        edit
        for edit in edits
        if edit.queries != "prefix"
        and (edit.layers is None or place.block in edit.layers)
        and (edit.denoise_steps is None or place.step in edit.denoise_steps)
        and not (edit.values == 1).all()
    ]


def logit_bias(
    edits: Sequence[SiteEdit], place: CallPlace, shape: CallShape, own_keys: slice | None = None
) -> NDArray[np.float32]:
    """Return what edits add to the logits of one call of a site, (head or 1, query, key).

    own_keys: the keys of the call's own queries, where it has them; others than action queries keep theirs.
    """
    factors = []
    for edit in edits:
        values = edit.values if place.keys is None else edit.values[place.keys]
        stays = stays_at_step(edit, shape.queries, place.queries, own_keys, shape.keys)
        factors.append(np.where(stays, 1.0, values))
    return _log_of(edits, factors, shape)


def prefix_bias(edits: Sequence[SiteEdit], tokens: NDArray[np.int64], shape: CallShape) -> NDArray[np.float32]:
    """Return what edits add to the logits of a call whose queries and keys are the site's keys `tokens`."""
    factors = [np.where(stays_in_prefix(edit, tokens), 1.0, edit.values[tokens]) for edit in edits]
    return _log_of(edits, factors, shape)


def _log_of(edits: Sequence[SiteEdit], factors: Sequence[NDArray[np.float64]], shape: CallShape) -> NDArray[np.float32]:
    """Sum the logarithms of factors (query, key), -infinity where they are 0, over edits: (head or 1, query, key)."""
    heads = shape.heads if any(edit.heads is not None for edit in edits) else 1
    total = np.zeros((heads, shape.queries, shape.keys), dtype=np.float32)
    for edit, of_edit in zip(edits, factors, strict=True):
        chosen = slice(None) if edit.heads is None else list(edit.heads)
        total[chosen] += np.where(of_edit == 0, -np.inf, log_factors(of_edit)).astype(np.float32)
    return total


def with_name(interventions: Interventions, name: str) -> Interventions:
    """Return the interventions with the name of their condition."""
    return replace(interventions, name=name) if name else interventions


@dataclass
class ReplanEdits:
    """What knockouts add to the logits of the calls of one replan; the keys are looked up at its first call."""

    run: RecordedRun
    episodes: Mapping[int, tuple[Episode, ReplanInputs]]
    text: ReplanText
    recorder: ReplanRecorder | None = None
    _of_row: dict[int, dict[str, Any]] = field(default_factory=dict)
    _known: dict[tuple[Any, ...], NDArray[np.float32]] = field(default_factory=dict)

    def bias(self, row: int, place: CallPlace, shape: CallShape) -> NDArray[np.float32] | None:
        """Return what is added to the logits of a call in one row of the batch, (head or 1, query, key).

        Calls to which the same is added get the same array.
        """
        if place.site is None:
            return None
        if row not in self._of_row:
            self._of_row[row] = self._edits(row)
        edits = edits_at(self._of_row[row].get(place.site, ()), place)
        if not edits:
            return None
        # Where the keys of calls differ, they differ from token to token.
        token = -1 if place.keys is None else place.step
        sizes = shape.heads, shape.queries, shape.keys, place.queries.start, place.queries.stop, token
        call = row, place.site, tuple(id(edit) for edit in edits), *sizes
        if call not in self._known:
            self._known[call] = logit_bias(edits, place, shape)
        return self._known[call]

    def _edits(self, row: int) -> dict[str, Any]:
        episode, inputs = self.episodes[row]
        prompt = self.text.prompt(row, None)
        sites = self.run._sites
        assert self.recorder is not None
        present = self.recorder.order.present
        roles = {site.name: self.text.roles(row, site, prompt, present.get(site.name), None) for site in sites}
        place = ReplanPlace(episode.facts.task_id, episode.facts.episode_index, episode.num_replans)
        return dict(
            self.run.knockouts.edits(
                self.run.attributes.sites, roles, prompt, episode.facts.objects, inputs.coverage, place
            )
        )
