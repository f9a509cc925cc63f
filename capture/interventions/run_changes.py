"""The interventions of a run, applied to the attention of one policy call after another."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from vla_attention.capture.interventions.changed_inputs import CallContext
from vla_attention.capture.interventions.factors import SiteEditor
from vla_attention.capture.interventions.prompts import changed_instruction
from vla_attention.capture.interventions.resolution import (
    ReplanPlace,
    check_selectors,
    empty_replans,
    episode_vocabularies,
    has_empty_group,
    make_editors,
    run_vocabularies,
    selectors_of,
    site_tokens,
)
from vla_attention.capture.policies.policy import PolicyInput
from vla_attention.schemas.groupings.resolve import EmptyGroup
from vla_attention.schemas.groupings.selector_parser import atoms_of, parse_selector
from vla_attention.schemas.groupings.vocabulary import SceneObject, Vocabulary
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.stores.reader import Store


@dataclass
class RunChanges:
    """What a run changes, and the editors of its policy calls' attention.

    Attributes:
        interventions: what is changed; layer numbers are block indices (`interventions_for`).
        instructions: the instructions of the suite's or store's tasks, by task id; their words may be named.
        allow_empty: leave a replan unchanged where a group has no key, and count it, instead of raising `EmptyGroup`.
        num_replans, num_empty: replans so far, and those in which some group had no key.
    """

    interventions: Interventions
    instructions: Mapping[int, str]
    allow_empty: bool = False
    num_replans: int = field(default=0, init=False)
    num_empty: int = field(default=0, init=False)

    def check_names(self, sites: Sequence[SiteLayout], objects: Sequence[SceneObject] | None = None) -> None:
        """Raise `SelectorError` for what is wrong whatever the call: names of objects only where these are known."""
        prompt, instructions = self.interventions.prompt, self.instructions
        changed = [
            changed_instruction(text, prompt, task_id=task_id, episode_index=0, instructions=instructions)
            for task_id, text in instructions.items()
            if prompt is not None
        ]
        known = named_objects(selectors_of(self.interventions)) if objects is None else objects
        check_selectors(self.interventions, self._vocabularies(sites, known, *changed))

    def editors(
        self, sites: Sequence[SiteLayout], policy_input: PolicyInput, context: CallContext
    ) -> dict[str, SiteEditor] | None:
        """Return the editors of one policy call by site, or None where nothing changes.

        Args:
            sites: the policy's sites.
            policy_input: what the call is given, after changes of prompt and pictures.
            context: the call's place in the run, and its scene's objects with their coverage.

        Raises:
            SelectorError: a name does not exist here.
            EmptyGroup: a group has no key, unless `allow_empty`.
        """
        if not self.interventions.changes_attention:
            return None
        self.num_replans += 1
        objects, place = context.objects, ReplanPlace(context.task_id, context.episode_index, context.replan)
        tokens = site_tokens(sites, policy_input.key_role, policy_input.prompt, objects, context.coverage)
        # Where empty groups are allowed, an object may also be one of another task's scene.
        known = [*objects, *named_objects(selectors_of(self.interventions))] if self.allow_empty else objects
        vocabularies = self._vocabularies(sites, known, policy_input.prompt.instruction_text)
        self.num_empty += has_empty_group(self.interventions, tokens, vocabularies, place, allow_empty=self.allow_empty)
        return make_editors(self.interventions, tokens, vocabularies, place) or None

    def describe_empty(self) -> str | None:
        """Return a line that says how many replans had an empty group; None if there was none."""
        if not self.num_empty:
            return None
        return (
            f"In {self.num_empty} of {self.num_replans} replans a group of an intervention had no key, and nothing was "
            "changed for it."
        )

    def _vocabularies(
        self, sites: Sequence[SiteLayout], objects: Sequence[SceneObject], *further: str
    ) -> dict[str, Vocabulary]:
        return run_vocabularies(sites, [*self.instructions.values(), *further], objects)


def named_objects(selectors: Iterable[str]) -> list[SceneObject]:
    """Return the objects that selectors name."""
    atoms = [atom for text in selectors for atom in atoms_of(parse_selector(text))]
    names = dict.fromkeys(atom.argument for atom in atoms if atom.kind == "object")
    return [SceneObject(name, "object", of_interest=False) for name in names]


def check_stored_replans(interventions: Interventions, store: Store, *, allow_empty: bool = False) -> int:
    """Check selectors on every replan of a store's episodes, before these are run again.

    Returns the number of replans in which some group has no key. The prompts are the stored ones: with another prompt,
    words can be checked at each call only.

    Raises:
        SelectorError: a name exists in no episode.
        EmptyGroup: a group has no key in some replans, unless `allow_empty`; names the first of them, and how many.
    """
    sites: list[str] = [site.name for site in store.attributes.sites]
    tokens = {
        episode.name: {site: episode.tokens(store.attributes, site) for site in sites} for episode in store.episodes
    }
    vocabularies = episode_vocabularies(list(tokens.values()))
    if not interventions.changes_attention or not vocabularies:
        return 0
    check_selectors(interventions, vocabularies)
    first: dict[str, str] = {}
    counts: dict[str, int] = {}
    any_empty = total = 0
    for name, tokens_of_episode in tokens.items():
        empty = empty_replans(interventions, tokens_of_episode, vocabularies)
        for selector, replans in empty.items():
            counts[selector] = counts.get(selector, 0) + int(replans.sum())
            if replans.any():
                first.setdefault(selector, f"replan {int(np.argmax(replans))} of {name}")
        some = np.any(list(empty.values()), axis=0)
        any_empty, total = any_empty + int(some.sum()), total + some.size
    if first and not allow_empty:
        selector, where = next(iter(first.items()))
        raise EmptyGroup(
            f"The group '{selector}' of an intervention has no key in {counts[selector]} of {total} replans, the first "
            f"is {where}; add --allow-empty to leave such replans unchanged, or choose episodes by --task-id."
        )
    return any_empty
