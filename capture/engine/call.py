"""Policy calls of a run: changed by its interventions, recorded, held to be finite, with their effects.

Captures, reruns and replays make their calls here. In `va.record` the user makes them; what is stored of them is made
here, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from vla_attention.capture.effects.measurement import EffectMeasurement, EpisodeEffectsMeasured
from vla_attention.capture.interventions.changed_inputs import CallContext, changed_inputs
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.policies.policy import BatchPolicy, GivenInputs, Policy, PolicyInput, changed_actions
from vla_attention.capture.recording.attention import AttentionEditor
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite, all_finite, describe_origin, not_finite
from vla_attention.capture.recording.recorder import AttentionRecorder, make_recorders
from vla_attention.capture.store.replan_records import RecordedRows, ReplanRecord
from vla_attention.schemas.errors import listing
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.plumbing import Plumbing
from vla_attention.schemas.stores.store_format import Recording


@dataclass(frozen=True)
class PolicyCall:
    """A policy call before it is made.

    Attributes:
        policy_input: with the run's changes of prompt and pictures.
        context: its place in the run, and the scene.
        where: replan, environment step and episode, for messages.
        dataset_actions: (step, action dim), those that a data set has from here on.
        base_actions: (horizon, action dim), those that the same call gave in the store that is run again.
        constant_cameras: those whose picture shows nothing.
    """

    policy_input: PolicyInput
    noise_seed: int
    context: CallContext
    env_step: int
    where: str
    dataset_actions: NDArray[np.float64] | None = None
    base_actions: NDArray[np.float64] | None = None
    constant_cameras: frozenset[str] = frozenset()


@dataclass(frozen=True)
class RecordedCall:
    """What one policy call gave: actions (horizon, action dim) for the environment, and the rows of each site."""

    actions: NDArray[np.float64]
    rows: Mapping[str, RecordedRows]


@dataclass(frozen=True)
class Caller:
    """Makes the policy calls of a run.

    recording: what is recorded of them. changes: the run's interventions; without any, nothing. effects: what measures
    the effects of calls; None where they are not recorded. looks_at_words: whether it is looked at whether
    the instruction gets through (`plumbing.py`); a rerun repeats calls that were.
    """

    policy: Policy
    recording: Recording
    changes: RunChanges = field(default_factory=lambda: RunChanges(Interventions(), {}))
    effects: EffectMeasurement | None = None
    looks_at_words: bool = False

    def denoise_times(self) -> NDArray[np.float64]:
        """Return the noise levels of the denoise steps that are recorded, (denoise,)."""
        return np.asarray(self.policy.denoise_times()[list(self.recording.denoise_steps)])

    def prepared(self, given: GivenInputs, context: CallContext) -> PolicyInput:
        """Return the model's input for what a call is given, with the run's changes of prompt and pictures."""
        changes = self.changes
        if changes.interventions.changes_input:
            sites, allow_empty = self.policy.sites, changes.allow_empty
            given = changed_inputs(given, changes.interventions, sites, context, allow_empty=allow_empty)
        return self.policy.prepare_again(given)

    def drawn_seed(self, seed: int, context: CallContext) -> int:
        """Return the seed of a call's noise. seed: of the run, where it does not change the noise."""
        noise = self.changes.interventions.noise
        run_seed = seed if noise is None else noise.seed
        return self.policy.replan_noise_seed(run_seed, context.task_id, context.episode_index, context.replan)

    def make(self, calls: Sequence[PolicyCall]) -> list[RecordedCall | NumbersNotFinite]:
        """Make calls as one batch if the policy can, else one after the other.

        A batch changes last bits. Calls whose attention is changed are made one by one. In the place of a call whose
        actions or rows are NaN or infinite is the error: the others of a batch are not its fault.
        """
        policy = self.policy
        editors = [self.changes.editors(policy.sites, call.policy_input, call.context) for call in calls]
        if len(calls) > 1 and not any(editors) and isinstance(policy, BatchPolicy):
            inputs, seeds = [call.policy_input for call in calls], [call.noise_seed for call in calls]
            recorders = [self._recorders(call) for call in calls]
            actions = policy.act_batch(inputs, seeds, recorders)
            together = zip(calls, actions, recorders, strict=True)
            return [self._made(call, of_call, own, None) for call, of_call, own in together]
        made = []
        for call, of_call in zip(calls, editors, strict=True):
            own = self._recorders(call)
            one = changed_actions(policy, call.policy_input, call.noise_seed, own, of_call)
            made.append(self._made(call, one, own, of_call))
        return made

    def _recorders(self, call: PolicyCall) -> dict[str, AttentionRecorder]:
        policy, recording = self.policy, self.recording
        pools = policy.query_pools() if recording.queries == "steps" else None
        return make_recorders(recording, policy.sites, call.policy_input.key_role, pools)

    def _made(
        self,
        call: PolicyCall,
        actions: NDArray[np.float64],
        recorders: Mapping[str, AttentionRecorder],
        editors: Mapping[str, AttentionEditor] | None,
    ) -> RecordedCall | NumbersNotFinite:
        rows = {site: recorder.finish() for site, recorder in recorders.items()}
        return RecordedCall(actions, rows) if all_finite(actions, rows) else self._not_finite(call, editors)

    def _not_finite(self, call: PolicyCall, editors: Mapping[str, AttentionEditor] | None) -> NumbersNotFinite:
        """Return the error of a call whose results are not finite; it repeats the call to find where that began."""
        policy, policy_input = self.policy, call.policy_input
        wrong_inputs = [name for name, values in policy_input.tensors.items() if not torch.isfinite(values).all()]
        if wrong_inputs:
            origin, passing = f"The policy's input is not finite already: {listing(wrong_inputs)}", False
        else:
            origin, passing = describe_origin(
                policy.model,
                lambda watch: policy.act(policy_input, call.noise_seed, watch, editors),
                tuple(site.name for site in policy.sites),
            )
        if passing:
            return not_finite(call.where, origin, "")
        dtype = policy.identity().config.get("dtype")
        remedy = "use another checkpoint" if dtype == "float32" else "use --dtype float32, or another checkpoint"
        return not_finite(call.where, origin, f"{remedy}, and a new --output, if it comes again")


def record_of(
    call: PolicyCall,
    rows: Mapping[str, RecordedRows],
    actions: NDArray[np.float64] | None,
    recording: Recording,
    effects: EpisodeEffectsMeasured | None,
    noise_seed: int | None,
    plumbing: Plumbing | None = None,
) -> ReplanRecord:
    """Return what is stored of a call that was made, with its effects.

    rows, actions: what it gave. effects: what measures its effects, None for none. noise_seed: the stored one.
    plumbing: where it was looked at whether the instruction gets through.
    """
    given = call.policy_input
    measured = None
    if effects is not None and actions is not None:
        measured = effects.measure(given, call.noise_seed, actions, call.context)
    return ReplanRecord(
        env_step=call.env_step,
        noise_seed=noise_seed,
        rows=rows,
        key_role={site: given.key_role[site] for site in rows},
        prompt=given.prompt,
        state=given.state if given.state.size else None,
        actions=actions,
        frames=given.frames if recording.frames else {},
        camera_frames=given.camera_frames if recording.frames else {},
        coverage=call.context.coverage,
        dataset_actions=call.dataset_actions,
        base_actions=call.base_actions,
        constant_cameras=call.constant_cameras,
        effects=measured,
        plumbing=plumbing,
        shown=given.shown,
    )
