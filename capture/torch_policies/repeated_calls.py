"""Effects beside the attention of a policy of the caller: a callable repeats each call under every condition.

The calls are made again one by one, after the recorded one, from the state in which it found the policy and the random
numbers. Nothing of them is recorded, and afterwards the state is the one that the recorded call left.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.effects.arguments import EffectSettings, settings_of
from vla_attention.capture.effects.conditions import effects_recorded
from vla_attention.capture.effects.measurement import MOST_DIFFERENCE, EffectMeasurement
from vla_attention.capture.interventions.changed_inputs import GREY
from vla_attention.capture.interventions.factors import SiteEdit, SiteEditor
from vla_attention.capture.policies.noise import noise_seed
from vla_attention.capture.policies.policy import CallVariant, GivenInputs, Policy, PolicyInput, VariantMemory
from vla_attention.capture.policies.random_numbers import RandomNumbers
from vla_attention.capture.torch_policies.attention_calls import AttentionCall, CallShape
from vla_attention.capture.torch_policies.call_order import CallPlace, KnownCalls
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused
from vla_attention.capture.torch_policies.inspect_calls import folded_paths
from vla_attention.capture.torch_policies.knockouts import CallBias
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, RecordedSite
from vla_attention.capture.torch_policies.policy_modules import FoundPolicy, blocks_without_calls
from vla_attention.capture.torch_policies.replan_inputs import Repeat, RepeatedCall, read_actions
from vla_attention.capture.torch_policies.site_recorder import ReplanRecorder
from vla_attention.capture.torch_policies.watch import watch_attention
from vla_attention.capture.torch_policies.watched_places import WatchedPlaces
from vla_attention.schemas.effects import EffectsRecorded
from vla_attention.schemas.errors import BadArgument, Note, UserError
from vla_attention.schemas.stores.store_format import PolicyIdentity, Recording

#: Of random keys and of the other noise; a run of `va.record` has the seed 0.
_SEED = 1
#: Stands for the noise of the recorded call, whose seed may not be known.
OWN_NOISE = -1
#: Of a repeat: actions (horizon, action dim); site -> (key,) bool, the keys that its first call could see.
_Repeated = tuple[NDArray[np.float64], Mapping[str, NDArray[np.bool_]]]

_NO_SIBLINGS = "No word is exchanged: no instruction of run.episode(siblings=[...]) has other words in the same places."
_TAKES_NO_CALL = (
    "The callable given as repeat takes no argument: no word and no picture is exchanged. Give lambda call: ..., which "
    "makes the call with call.instruction and call.frames."
)
_OTHER_ACTIONS = (
    "The callable given as repeat gives other actions than the recorded call when nothing is changed: it must return "
    "what replan.actions is set to, and draw from torch's, numpy's or Python's global random numbers only. What the "
    "policy keeps from call to call (a queue, a generator of its own) must be set back in it. The effects of such "
    "replans are refused."
)


class NotRepeated(BadArgument):
    """A callable that does not make the policy call again."""


def effects_of_layout(effects: str | EffectSettings | None, layout: PolicyLayout) -> EffectsRecorded | None:
    """Return which effects a run measures; raise `BadArgument` for what the layout or a repeated call has not."""
    settings = settings_of(effects)
    if settings is None:
        return None
    if settings.denoise_steps is not None:
        raise BadArgument(
            f"Cannot measure effects with {settings.denoise_steps} denoise steps: a call of your own is repeated as it "
            "is. Leave denoise_steps out."
        )
    if settings.map_form and (settings.blocks is None or settings.blocks.way == "picture"):
        raise BadArgument(
            f"Cannot measure '{settings.map_form}' of a call of your own, whose gradients and pictures are not known "
            "here. Take map:8x8, which hides blocks of patches one at a time."
        )
    tokens = [rule for rule in layout.rules if rule.tokens is not None]
    for reader in settings.readers:
        if reader == "action" or any(rule.is_prefix or reader == "all" for rule in tokens):
            continue
        calls = "its tokens" if reader == "all" else "a prefix"
        raise BadArgument(
            f"Cannot measure effects by the reader '{reader}': no rule of the layout '{layout.name}' says which calls "
            f"are passes over {calls}, in which keys would be cut off too. Say it with CallRule(..., tokens=SITE), or "
            "use EffectSettings(..., readers=('action',)), as --effects-readers action."
        )
    planned = effects_recorded(settings, [site.keys for site in layout.sites], layout.num_denoise_steps, _SEED)
    if planned.blocks and not any(site.keys.pictured for site in layout.sites):
        raise BadArgument(f"Cannot measure a map: no key of the layout '{layout.name}' is a patch of a picture.")
    return planned


@dataclass(frozen=True)
class CallInput(PolicyInput):
    """What a call was given by its caller, in `call`; prompt and pictures are here as they are stored."""

    call: RepeatedCall = field(default_factory=lambda: RepeatedCall("", {}))

    @property
    def given(self) -> GivenInputs:
        """What a condition changes: the caller's instruction, and which pictures."""
        return GivenInputs(self.frames, {}, self.state, self.call.instruction)


@dataclass(frozen=True)
class CallToRepeat:
    """What is known of a recorded call that is to be repeated.

    before: the random numbers before it. actions: (horizon, action dim). present: site -> (key,) bool, the keys that
    its calls had. where: the replan, in words.
    """

    repeat: Repeat
    given: CallInput
    before: RandomNumbers
    actions: NDArray[np.float64]
    present: Mapping[str, NDArray[np.bool_]]
    where: str


class RepeatedPolicy:
    """A policy of the caller, as far as `EffectMeasurement` needs one; `call` is the one that is repeated.

    found, known: the policy's modules, and what was found out about its calls. recording: of the run.

    Attributes:
        measurement: measures the effects of a run.
        siblings: by task id, instructions whose words are exchanged for the task's own.
    """

    def __init__(self, found: FoundPolicy, known: KnownCalls, identity: PolicyIdentity, recording: Recording) -> None:
        assert recording.effects is not None
        self.name, self.family = identity.name, identity.family
        self.num_denoise_steps = identity.num_denoise_steps
        self.cameras, self.default_replan_steps = identity.cameras, 0
        self.sites = tuple(site.keys for site in known.layout.sites)
        self.siblings: dict[int, Sequence[str]] = {}
        # It has what is needed of policies whose variants are made together.
        self.measurement = _Measurement(
            cast(Policy, self),
            recording.effects,
            self.siblings,
            partial(warnings.warn, category=Note, stacklevel=2),
            no_siblings=_NO_SIBLINGS,
            no_pictures="",
        )
        self.call: CallToRepeat
        #: Repeated calls may compute attention where recorded ones do not.
        self._found = replace(found, places=WatchedPlaces())
        self._known = known
        self._identity = identity
        self._recording = recording
        #: Whether calls whose attention is not changed get a mask that changes nothing: they then take the kernels of
        #: the others, and what these round otherwise is seen.
        self._masks = True

    def take(self, call: CallToRepeat) -> None:
        """Take the call that was just recorded: `measurement` is of it from here on."""
        self.call = call
        if "cameras" in self.measurement.planned.items and call.repeat.takes_call and not call.repeat.given.frames:
            self.measurement.say_once("No picture is exchanged: replan(frames=...) was given none.")

    def identity(self) -> PolicyIdentity:
        """Return the policy's description in the store."""
        return self._identity

    def action_units(self) -> NDArray[np.float64]:
        """Return ones, (action dim,): actions are in the caller's units."""
        return np.ones(self.call.actions.shape[1])

    replan_noise_seed = staticmethod(noise_seed)

    def prepare_again(self, given: GivenInputs) -> PolicyInput:
        """Return the call's input with another instruction, and grey pictures where they are others."""
        base = self.call.given
        frames = {
            camera: _grey(picture)
            if camera in base.frames and given.frames[camera] is not base.frames[camera]
            else picture
            for camera, picture in base.call.frames.items()
        }
        return replace(base, call=RepeatedCall(given.instruction, frames))

    def variant_memory(self) -> VariantMemory:
        """Return that calls are made one by one, as the caller's own are: whatever these take suffices."""
        return VariantMemory(call_bytes=1, most_calls=1, left=float("inf"), device="the caller's device")

    def act_variants(
        self, variants: Sequence[CallVariant], num_steps: int, batch: int
    ) -> list[NDArray[np.float64] | None]:
        """Repeat the call for each variant, the first of which is the unchanged one; None for what cannot be made."""
        nothing = [None] * (len(variants) - 1)
        after = RandomNumbers()
        try:
            unchanged = self._made(variants[0])
            if unchanged is None or self._is_another(unchanged):
                return [None if unchanged is None else unchanged[0], *nothing]
            made = [self._compared(variant, unchanged) for variant in variants[1:]]
            # Once more: what the repeats before it left behind would be in them, too.
            last = self._made(variants[0])
            if last is None or self._is_another(last):
                return [None if last is None else last[0], *nothing]
            return [unchanged[0], *made]
        finally:
            after.again()

    def _is_another(self, unchanged: _Repeated) -> bool:
        """Whether a repeat without a change gives other actions than rounding explains, which is said once."""
        is_another = self.measurement.differs(unchanged[0], self.call.actions)
        if is_another:
            self.measurement.say_once(_OTHER_ACTIONS)
        return is_another

    def _compared(self, variant: CallVariant, unchanged: _Repeated) -> NDArray[np.float64] | None:
        """Return the actions of a variant; None, and a line, where it is not the variant that it should be."""
        say, exchanged = self.measurement.say_once, variant.policy_input is not self.call.given
        if exchanged and not self.call.repeat.takes_call:
            say(_TAKES_NO_CALL)
            return None
        made = self._made(variant)
        if made is None:
            return None
        actions, seen_now = made
        if exchanged and any((seen_now[site] != seen).any() for site, seen in unchanged[1].items()):
            say("A call with an exchanged word is not measured where its prompt has another number of tokens.")
            return None
        if variant.noise_seed != OWN_NOISE and np.array_equal(actions, unchanged[0]):
            say("The repeated call draws no global random numbers: another noise is not measured.")
            return None
        return actions

    def _made(self, variant: CallVariant) -> _Repeated | None:
        """Repeat the call for one variant; None, and a line, where that fails: an episode never does."""
        try:
            try:
                return self._repeated(variant)
            except ChangeRefused:
                if variant.editors or not self._masks:
                    raise
                self._masks = False
                return self._repeated(variant)
        except Exception as error:
            kind = "" if isinstance(error, UserError) else f"{type(error).__name__}: "
            self.measurement.say_once(f"Left out of the effects: a repeated call failed. {kind}{error}")
            return None

    def _repeated(self, variant: CallVariant) -> _Repeated:
        call, given = self.call, cast(CallInput, variant.policy_input).call
        call.before.again()
        if variant.noise_seed != OWN_NOISE:
            call.before.reseed(variant.noise_seed)
        edits = {site: cast(SiteEditor, editor).edits for site, editor in variant.editors.items()}
        bias = CallBias(self._known.layout, edits, call.present) if edits or self._masks else None
        watcher = RepeatWatcher(self._known, self._identity.name, self._recording, bias)
        with watch_attention(self._found, watcher):
            result = call.repeat.call(given) if call.repeat.takes_call else call.repeat.call()
        if not watcher.ran:
            raise NotRepeated(
                "The callable given as repeat made no attention call: a policy that answers from a queue must be reset "
                "in it, as lambda call: (policy.reset(), policy.select_action(batch))[1]."
            )
        watcher.check(f"the repeated call of {call.where}")
        self._look_for_silent_blocks(watcher)
        self._check_prefix(watcher, [edit for of_site in edits.values() for edit in of_site])
        actions = read_actions(result)
        if actions is None or actions.shape != call.actions.shape:
            shape = None if actions is None else actions.shape
            raise NotRepeated(
                f"The callable given as repeat returned actions of the shape {shape}; expected {call.actions.shape}, "
                "as replan.actions is set to."
            )
        return actions, watcher.seen

    def _look_for_silent_blocks(self, watcher: RepeatWatcher) -> None:
        """Say once which repeated blocks no knockout reaches: an effect for all queries is not the total one then."""
        if self.measurement.silent_blocks is not None:
            return
        called = [shape.module for shape in watcher.ran]
        silent = self.measurement.silent_blocks = tuple(
            blocks_without_calls(self._found.modules, watcher.modules, called)
        )
        if silent:
            self.measurement.say_once(
                f"{folded_paths(silent)} ran without an attention call (linear attention, state spaces): keys are cut "
                "off through softmax only, also for all queries. Exchange words and pictures for whole effects."
            )

    def _check_prefix(self, watcher: RepeatWatcher, edits: Sequence[SiteEdit]) -> None:
        """Raise `ChangeRefused` if edits of the prefix's queries reached no call."""
        passes = [number for number, rule in enumerate(self._known.layout.rules) if rule.is_prefix]
        if not passes or all(edit.queries == "action" for edit in edits):
            return
        if not any(watcher.calls_of_rule[number] for number in passes):
            raise ChangeRefused(
                f"No call was a pass over the prefix, as the layout '{self._known.layout.name}' says with tokens=SITE: "
                "keys cannot be cut off there. Change its rules, or measure with readers=('action',)."
            )


class RepeatWatcher(ReplanRecorder):
    """Changes the calls of a repeat and records none.

    seen: site -> (key,) bool, the keys that the site's first call could see.
    """

    def __init__(self, known: KnownCalls, policy: str, recording: Recording, bias: CallBias | None) -> None:
        super().__init__(known, policy, recording, 1, [0], "")
        self.seen: dict[str, NDArray[np.bool_]] = {}
        self.changes, self._bias = bias is not None, bias

    def bias(self, row: int, place: CallPlace, shape: CallShape) -> NDArray[np.float32] | None:
        """See `ReplanRecorder`."""
        return None if self._bias is None else self._bias(place, shape)

    def change(self, shape: CallShape) -> Tensor | None:
        """See `Watcher`; a call of several rows cannot be changed."""
        if shape.batch != self.batch and self.changed_place(shape) is not None:
            raise ChangeRefused(
                f"The attention call {shape} has a batch of {shape.batch}, and effects are of calls of one row."
            )
        return super().change(shape)

    def wanted(self, place: CallPlace) -> bool:
        """Return whether a call is the first of its site: its mask is looked at."""
        return place.site not in self.seen

    def _keep(self, call: AttentionCall, place: CallPlace, site: RecordedSite) -> None:
        self.seen[site.name] = seen = np.zeros(site.keys.num_keys, dtype=bool)
        allowed = call.allowed(place.queries).any(dim=2).any(dim=1).any(dim=0).cpu().numpy()
        seen[slice(None) if place.keys is None else place.keys] = allowed


class _Measurement(EffectMeasurement):
    """Allows for the size of the caller's units: 1e-4 of an angle of 180 degrees is less than float32 holds."""

    def allowed_difference(self, actions: NDArray[np.float64]) -> float:
        return MOST_DIFFERENCE * max(1.0, float(np.abs(actions).max()))

    def differs(self, unchanged: NDArray[np.float64], actions: NDArray[np.float64]) -> bool:
        """Whether these are other actions; see `is_float32`."""
        return self.is_float32 and not float(np.abs(unchanged - actions).max()) <= self.allowed_difference(actions)


def _grey(picture: Any) -> Any:
    """Return a picture of one grey in the caller's form: whole grey levels, or numbers from 0 to 1."""
    if isinstance(picture, Tensor):
        return torch.full_like(picture, GREY / 255 if picture.is_floating_point() else GREY)
    values = np.asarray(picture)
    return np.full_like(values, GREY / 255 if values.dtype.kind == "f" else GREY)
