"""Measuring the effects of policy calls: each call is made again under every condition of its episode."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray

from vla_attention.capture.effects.conditions import UNCHANGED, conditions_of
from vla_attention.capture.effects.mean_pictures import MeanPictures
from vla_attention.capture.effects.patch_maps import (
    DRAWN,
    PROJECTIONS,
    STRONGEST,
    CallMap,
    PictureBlock,
    call_map,
    map_blocks,
)
from vla_attention.capture.interventions.changed_inputs import CallContext, changed_inputs
from vla_attention.capture.interventions.factors import QueryWithoutKeys, SiteEditor
from vla_attention.capture.interventions.resolution import (
    ReplanPlace,
    TooFewKeys,
    make_editors,
    run_vocabularies,
    site_tokens,
)
from vla_attention.capture.interventions.run_changes import RunChanges, named_objects
from vla_attention.capture.policies.policy import (
    CallVariant,
    MapPolicy,
    Policy,
    PolicyInput,
    UnitsPolicy,
    VariantPolicy,
    changed_actions,
    map_keys,
)
from vla_attention.capture.store.replan_records import ReplanEffects
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.effects import EffectItem, EffectsRecorded
from vla_attention.schemas.errors import BadArgument, UserError, plural
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, Vocabulary
from vla_attention.schemas.interventions import Interventions, KeyKnockout
from vla_attention.schemas.layout import Prompt
from vla_attention.schemas.stores.store_format import episode_name

#: Calls that are made at a time, at most; a family takes fewer where its model is large. With 32, effects take 8 %
#: longer, with 8 a third.
MOST_CALLS = 64
#: Of the memory that is left, the part that changed calls may take: the simulators' processes need some, too.
_SHARE_OF_MEMORY = 0.8
#: Largest difference, in normalised actions, of the unchanged call from the same call among the changed ones. A model
#: in float32 leaves 1e-6. Beyond it something else than rounding differs, and the effects of the replan are refused.
MOST_DIFFERENCE = 1e-4


@dataclass
class EffectMeasurement:
    """What all episodes of a process have in common.

    Attributes:
        policy, planned: which effects are measured of which policy.
        siblings: by task id, the instructions of the other tasks of its family, whose words are exchanged for its own.
        say: takes a line for the person at the terminal; each is said once.
        pictures: the mean pictures that cameras' own are exchanged for; None for grey ones.
        instructions: of the run's tasks; groups may name their words.
    """

    policy: Policy
    planned: EffectsRecorded
    siblings: Mapping[int, Sequence[str]]
    say: Callable[[str], None]
    pictures: MeanPictures | None = None
    instructions: Sequence[str] = ()
    #: Said where no word has another one that could stand in its place.
    no_siblings: str = "No other task of a family has other words in the same places: none is exchanged."
    #: Said where no mean pictures are known; empty where nothing could be done about it.
    no_pictures: str = (
        "Cameras' pictures are exchanged for grey ones; --effects-pictures STORE takes the task's mean ones."
    )
    #: Actions of a chunk that are executed; 0: as many as the checkpoint states.
    executed: int = 0
    #: Whether it says what the first measured call took.
    says_seconds: bool = False
    #: See `EpisodeEffects`; None before it was looked at.
    silent_blocks: tuple[str, ...] | None = field(default=None, init=False)
    #: Replans whose effects were refused.
    refused: int = field(default=0, init=False)
    #: What each replan with effects took.
    seconds: list[float] = field(default_factory=list, init=False)
    _batch: int = field(init=False)
    _said: set[str] = field(default_factory=set, init=False)

    def __post_init__(self) -> None:
        """Choose how many calls are made at a time, by the memory that is left."""
        self._batch = calls_at_a_time(self.policy, self.say)
        if "map" in self.planned.items:
            self.say(self._price_of_map())

    def _price_of_map(self) -> str:
        blocks = self.planned.blocks
        if blocks is not None:
            number, how = len(self.blocks), blocks.describe()
            alone = " Each block is one patch." if number == len(map_keys(self.policy)) else ""
            return (
                f"Map: {plural(number, 'changed call')} a policy call; in each a block of the pictures is {how}.{alone}"
            )
        memory = format_bytes(cast(MapPolicy, self.policy).gradient_memory())
        return (
            f"Map: {PROJECTIONS} backward passes a policy call, which take about {memory} of memory, and exact calls "
            f"without the strongest {STRONGEST:.0%} of the patches and {DRAWN} of the others."
        )

    def begin(self) -> EpisodeEffectsMeasured:
        """Return what measures one episode."""
        return EpisodeEffectsMeasured(self)

    @cached_property
    def blocks(self) -> Sequence[PictureBlock]:
        """Of the map."""
        return map_blocks(self.planned, self.policy)

    @cached_property
    def units(self) -> NDArray[np.float64]:
        """How far 1 of the normalised actions moves the robot, (action dim,); 1 for what the policy never moves."""
        units = cast(UnitsPolicy, self.policy).action_units()
        return np.where(units == 0, 1.0, units)

    def allowed_difference(self, actions: NDArray[np.float64]) -> float:
        """Return how far the unchanged call may be from actions (horizon, action dim), in their units."""
        return MOST_DIFFERENCE

    @cached_property
    def is_float32(self) -> bool:
        """Whether the model computes in float32."""
        return str(self.policy.identity().config.get("dtype", "float32")) == "float32"

    def say_once(self, line: str, about: str = "") -> None:
        """Say a line, unless it or another line about the same was said before."""
        if (about or line) not in self._said:
            self._said.add(about or line)
            self.say(line)

    def actions_of(self, variants: Mapping[int, CallVariant]) -> dict[int, NDArray[np.float64]]:
        """Return the actions (horizon, action dim) of variants by their numbers; what cannot be made is left out."""
        policy = self.policy
        if not isinstance(policy, VariantPolicy):
            made = {number: self._single(variant) for number, variant in variants.items()}
            return {number: actions for number, actions in made.items() if actions is not None}
        while True:
            try:
                together = policy.act_variants(list(variants.values()), self.planned.denoise_steps, self._batch)
                pairs = zip(variants, together, strict=True)
                return {number: actions for number, actions in pairs if actions is not None}
            except torch.OutOfMemoryError:
                if self._batch == 1:
                    self.say_once("The memory does not suffice for the effects of a single call: they are left out.")
                    return {}
            self._batch //= 2
            torch.cuda.empty_cache()
            self.say_once(f"The memory does not suffice for so many calls at a time: {self._batch} from here on.")

    def _single(self, variant: CallVariant) -> NDArray[np.float64] | None:
        """Return the actions of a variant by a call of its own; None where it leaves a query without any key."""
        try:
            return changed_actions(self.policy, variant.policy_input, variant.noise_seed, None, variant.editors or None)
        except QueryWithoutKeys as error:
            self.say_once(f"Left out of the effects: {error}")
            return None


def calls_at_a_time(policy: Policy, say: Callable[[str], None]) -> int:
    """Return how many changed calls the memory holds, at most `MOST_CALLS`; say so where it is few.

    Raises:
        BadArgument: it holds not even one.
    """
    if not isinstance(policy, VariantPolicy):
        return 1
    memory = policy.variant_memory()
    wanted = min(MOST_CALLS, memory.most_calls)
    fitting = int(min(memory.left * _SHARE_OF_MEMORY / memory.call_bytes, wanted))
    room = (
        f"each takes up to {format_bytes(memory.call_bytes)}, and {memory.device} has {format_bytes(memory.left)} left"
    )
    if fitting < 1:
        raise BadArgument(
            f"Cannot measure effects: there is no memory for one changed call ({room}). Leave --effects out."
        )
    if fitting < wanted:
        say(f"Effects: {plural(fitting, 'changed call')} at a time, not {wanted} ({room}).")
        return fitting
    return MOST_CALLS


def siblings_of(tasks: Iterable[tuple[int, str, str]]) -> dict[int, tuple[str, ...]]:
    """Return the instructions of the other tasks of each task's family; tasks: number, instruction and family."""
    known = list(tasks)
    return {
        number: tuple(dict.fromkeys(text for other, text, its in known if its == family != "" and other != number))
        for number, _, family in known
    }


def measurement_of(
    planned: EffectsRecorded | None,
    policy: Policy,
    tasks: Iterable[tuple[int, str, str]],
    say: Callable[[str], None],
    pictures: MeanPictures | None = None,
    executed: int = 0,
) -> EffectMeasurement | None:
    """Return what measures a run's effects, None for none; tasks: number, instruction and family; executed: see there.

    Raises:
        SelectorError: a group names something that no task has.
    """
    if planned is None:
        return None
    known = list(tasks)
    instructions = {number: text for number, text, _ in known}
    if known and planned.groups:
        groups = Interventions(keys=tuple(KeyKnockout(selector) for selector in planned.groups.values()))
        RunChanges(groups, instructions).check_names(policy.sites)
    siblings, told = siblings_of(known), tuple(instructions.values())
    return EffectMeasurement(policy, planned, siblings, say, pictures, told, executed=executed, says_seconds=True)


@dataclass
class EpisodeEffectsMeasured:
    """Measures the effects of the calls of one episode, whose conditions are those of its first call."""

    run: EffectMeasurement
    conditions: tuple[Interventions, ...] | None = None
    items: tuple[EffectItem, ...] = ()
    instruction: str = ""

    def measure(
        self, policy_input: PolicyInput, noise_seed: int, actions: NDArray[np.float64], context: CallContext
    ) -> ReplanEffects | None:
        """Return the effects of a call, or None if they are not measured at its replan.

        actions: (horizon, action dim) that the call gave.
        """
        policy, planned, begun = self.run.policy, self.run.planned, time.perf_counter()
        if context.replan % planned.every:
            return None
        if "cameras" in planned.items:
            context = replace(context, mean_pictures=self._mean_pictures(context))
        tokens = site_tokens(
            policy.sites, policy_input.key_role, policy_input.prompt, context.objects, context.coverage
        )
        # The words of the first call stay known where the instruction changes: they have no keys then.
        self.instruction = self.instruction or policy_input.prompt.instruction_text
        instructions = [self.instruction, policy_input.prompt.instruction_text, *self.run.instructions]
        # A group may name an object of another task's scene: it has no keys here.
        objects = [*context.objects, *named_objects(planned.groups.values())]
        vocabularies = run_vocabularies(policy.sites, instructions, objects)
        if self.conditions is None:
            siblings = self.run.siblings.get(context.task_id, ())
            made = conditions_of(
                planned,
                policy,
                policy_input,
                tokens,
                vocabularies,
                context.objects,
                siblings,
                context.task_id,
                context.mean_pictures,
            )
            self.conditions, self.items = tuple(one for one, _ in made), tuple(item for _, item in made)
            if "text" in planned.items and not any(condition.prompt for condition in self.conditions):
                self.run.say_once(self.run.no_siblings)
            if "objects" in planned.items and not (context.objects and context.coverage):
                self.run.say_once("The scene's objects are not known here: effects of objects are not measured.")
        variants: dict[int, CallVariant] = {}
        for number, condition in enumerate(self.conditions):
            variant = self._variant(condition, policy_input, noise_seed, context, tokens, vocabularies)
            if variant is not None:
                variants[number] = variant
        map_of = self._map(policy_input, noise_seed, context, len(actions)) if "map" in planned.items else None
        # Calls without a patch are numbered behind those of the conditions, and made together with them.
        behind = len(self.conditions)
        patches = {} if map_of is None else map_of.variants(policy, policy_input, noise_seed)
        cut = {knockout.selector for number in variants for knockout in self.conditions[number].keys}
        for name, selector in planned.groups.items():
            if selector not in cut:
                self.run.say_once(f"The group '{name}' has no key at some replans: it is not measured there.")
        of_patches = {behind + place: variant for place, variant in patches.items()}
        actions_of, reference = self.run.actions_of(variants | of_patches), actions
        if UNCHANGED in self.conditions:
            # Made as the changed calls are: in their batch, never compiled, with as many denoise steps.
            unchanged = self.conditions.index(UNCHANGED)
            reference = actions_of.get(unchanged, actions)
            if planned.denoise_steps < policy.num_denoise_steps:  # which change the actions by themselves
                actions_of.pop(unchanged, None)
        changes = {
            number: ((given - reference) / self.run.units).astype(np.float32) for number, given in actions_of.items()
        }
        if UNCHANGED in self.conditions and unchanged in changes:  # how far it is from what the robot executed
            changes[unchanged] = ((reference - actions) / self.run.units).astype(np.float32)
        of_patch = {number - behind: changes.pop(number) for number in [*changes] if number >= behind}
        measured, refused = self._refused_if_unlike(changes, context, self.run.allowed_difference(actions))
        weights = {
            site.name: np.stack([_cut(variants[number], site.name, site.num_keys) for number in measured])
            if measured
            else np.zeros((0, site.num_keys), np.float32)
            for site in policy.sites
        }
        change = (
            np.stack([changes[number] for number in measured])
            if measured
            else np.zeros((0, *actions.shape), np.float32)
        )
        self.run.seconds.append(time.perf_counter() - begun)
        if len(self.run.seconds) == 1 and self.run.says_seconds:
            calls = plural(len(variants) + len(patches), "changed call")
            passes = "" if map_of is None or planned.blocks else f" and {PROJECTIONS} backward passes"
            took = f"{calls}{passes} took {self.run.seconds[0]:.1f} s"
            self.run.say(f"Effects: {took} at the first policy call that is measured.")
        units = tuple(float(unit) for unit in self.run.units)
        silent = self.run.silent_blocks or ()
        stored = None if map_of is None else map_of.stored(policy, {} if refused else of_patch, actions.shape)
        return ReplanEffects(self.conditions, self.items, units, tuple(measured), change, weights, silent, stored)

    def _map(self, policy_input: PolicyInput, noise_seed: int, context: CallContext, horizon: int) -> CallMap | None:
        planned, policy = self.run.planned, self.run.policy
        steps = min(self.run.executed or policy.default_replan_steps or horizon, horizon)
        seed = (self.run.planned.seed % 2**32, context.task_id, context.episode_index, context.replan)
        try:
            found = call_map(planned, self.run.blocks, policy, policy_input, noise_seed, steps, horizon, seed)
        except torch.OutOfMemoryError:
            torch.cuda.empty_cache()
            self.run.say_once("The memory does not suffice for the backward passes of a call: no map is made.")
            return None
        if found is None:
            self.run.say_once("The first order of the patches is NaN or infinite: no map is made of such calls.")
        return found

    def _mean_pictures(self, context: CallContext) -> Mapping[str, NDArray[np.uint8]]:
        pictures = self.run.pictures
        if pictures is None:
            if self.run.no_pictures:
                self.run.say_once(self.run.no_pictures)
            return {}
        known = pictures.of_task(context.task_id)
        if not known:
            self.run.say_once(
                f"{pictures.store.path} has no pictures of task {context.task_id}: they are exchanged for grey ones."
            )
        return known

    def _variant(
        self,
        condition: Interventions,
        policy_input: PolicyInput,
        noise_seed: int,
        context: CallContext,
        tokens: Mapping[str, EpisodeTokens],
        vocabularies: Mapping[str, Vocabulary],
    ) -> CallVariant | None:
        """Return the call under a condition; None where there is nothing to change."""
        policy, editors = self.run.policy, dict[str, SiteEditor]()
        told = policy_input.prompt.instruction_text
        if condition.prompt and condition.prompt.kind == "text" and told != self.instruction:
            return None  # of a table's row: it is another sentence for the task of the first call
        if condition.keys:
            place = ReplanPlace(context.task_id, context.episode_index, context.replan)
            try:
                editors = make_editors(condition, tokens, vocabularies, place)
            except TooFewKeys:
                return None
            if not editors:
                return None
        if condition.changes_input:
            try:
                changed = changed_inputs(policy_input.given, condition, policy.sites, context)
                exchanged = policy.prepare_again(changed)
            except UserError as error:  # a prompt that the policy has no encoding of
                self.run.say_once(f"'{condition.name}' and its like are left out: {error}", about=type(error).__name__)
                return None
            if _end_is_cut(exchanged.prompt) and not _end_is_cut(policy_input.prompt):
                self.run.say_once(
                    f"'{condition.name}' and other long ones are left out: the policy has no room for the end of the "
                    "prompt, and would not read it.",
                    about="cut",
                )
                return None
            policy_input = exchanged
        if condition.noise is not None:
            noise_seed = policy.replan_noise_seed(
                condition.noise.seed, context.task_id, context.episode_index, context.replan
            )
        return CallVariant(policy_input, noise_seed, editors)

    def _refused_if_unlike(
        self, changes: Mapping[int, NDArray[np.float32]], context: CallContext, allowed: float
    ) -> tuple[list[int], bool]:
        """Return the numbers of the conditions that are kept, ascending, and whether the others are refused."""
        assert self.conditions is not None
        finite = [number for number, change in changes.items() if np.isfinite(change).all()]
        if len(finite) < len(changes):
            names = ", ".join(self.conditions[number].name for number in changes if number not in finite)
            self.run.say_once(f"The actions are NaN or infinite under {names}: left out.")
        unchanged = next((number for number in finite if self.conditions[number] == UNCHANGED), None)
        if unchanged is None or not self.run.is_float32:
            return finite, False
        difference = float(np.abs(changes[unchanged]).max(initial=0.0))
        if difference <= allowed:
            return finite, False
        if not self.run.refused:
            self.run.say(
                f"The effects of replan {context.replan} of {episode_name(context.task_id, context.episode_index)} are "
                f"refused: among the changed calls the unchanged one differs by {difference:.2g} of normalised "
                f"actions, allowed is {allowed:g}. Of further ones the store alone says so."
            )
        self.run.refused += 1
        return [unchanged], True


def _end_is_cut(prompt: Prompt) -> bool:
    return bool(prompt.pieces and prompt.text[prompt.pieces[-1].stop :].strip())


def _cut(variant: CallVariant, site: str, num_keys: int) -> NDArray[np.float32]:
    """Return the weight of each key of a site that is cut off, (key,)."""
    editor = variant.editors.get(site)
    if editor is None:
        return np.zeros(num_keys, np.float32)
    factors = np.prod([edit.values for edit in cast(SiteEditor, editor).edits], axis=0)
    cut: NDArray[np.float32] = (1.0 - factors).astype(np.float32)
    return cut
