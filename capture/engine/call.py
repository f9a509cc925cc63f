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
from vla_attention.capture.policies.policy import BatchPolicy, GivenInputs, Policy, PolicyInput
from vla_attention.capture.recording.attention import AttentionEditor
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite, all_finite, describe_origin, not_finite
from vla_attention.capture.recording.recorder import make_recorders
from vla_attention.capture.store.replan_records import RecordedRows, ReplanRecord
from vla_attention.schemas.errors import listing
from vla_attention.schemas.interventions import Interventions
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
    the effects of calls; None where they are not recorded.
    """

    policy: Policy
    recording: Recording
    changes: RunChanges = field(default_factory=lambda: RunChanges(Interventions(), {}))
    effects: EffectMeasurement | None = None

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

        One call, and calls whose attention is changed, are made as `record_call` makes them, to the bit. In the place
        of a call whose actions or rows are NaN or infinite is the error: the others of a batch are not its fault.
        """
        policy, recording = self.policy, self.recording
        editors = [self.changes.editors(policy.sites, call.policy_input, call.context) for call in calls]
        if len(calls) == 1 or any(editors) or not isinstance(policy, BatchPolicy):
            return [self._made_alone(call, of_call) for call, of_call in zip(calls, editors, strict=True)]
        pools = policy.query_pools() if recording.queries == "steps" else None
        recorders = [make_recorders(recording, policy.sites, call.policy_input.key_role, pools) for call in calls]
        together = policy.act_batch(
            [call.policy_input for call in calls], [call.noise_seed for call in calls], recorders
        )
        made: list[RecordedCall | NumbersNotFinite] = []
        for call, actions, recorders_of_call in zip(calls, together, recorders, strict=True):
            rows = {site: recorder.finish() for site, recorder in recorders_of_call.items()}
            if all_finite(actions, rows):
                made.append(RecordedCall(actions, rows))
            else:
                made.append(_not_finite(policy, call.policy_input, call.noise_seed, call.where, None))
        return made

    def _made_alone(
        self, call: PolicyCall, editors: Mapping[str, AttentionEditor] | None
    ) -> RecordedCall | NumbersNotFinite:
        try:
            return record_call(self.policy, call.policy_input, call.noise_seed, self.recording, call.where, editors)
        except NumbersNotFinite as error:
            return error


def record_of(
    call: PolicyCall,
    rows: Mapping[str, RecordedRows],
    actions: NDArray[np.float64] | None,
    recording: Recording,
    effects: EpisodeEffectsMeasured | None,
    noise_seed: int | None,
) -> ReplanRecord:
    """Return what is stored of a call that was made, with its effects.

    rows, actions: what it gave. effects: what measures its effects, None for none. noise_seed: the stored one.
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
    )


def record_call(
    policy: Policy,
    policy_input: PolicyInput,
    noise_seed: int,
    recording: Recording,
    where: str,
    editors: Mapping[str, AttentionEditor] | None = None,
) -> RecordedCall:
    """Call the policy once, and record what `recording` says.

    editors: the editor of each site whose attention changes; the rows are the changed ones.

    Raises:
        NumbersNotFinite: actions or rows are NaN or infinite; `where` names the replan in the sentence.
    """
    pools = policy.query_pools() if recording.queries == "steps" else None
    recorders = make_recorders(recording, policy.sites, policy_input.key_role, pools)
    actions = policy.act(policy_input, noise_seed, recorders, editors)
    rows = {site: recorder.finish() for site, recorder in recorders.items()}
    if not all_finite(actions, rows):
        raise _not_finite(policy, policy_input, noise_seed, where, editors)
    return RecordedCall(actions, rows)


def _not_finite(
    policy: Policy, policy_input: PolicyInput, seed: int, where: str, editors: Mapping[str, AttentionEditor] | None
) -> NumbersNotFinite:
    """Return the error of a policy call whose results are not finite; it repeats the call to find where that began."""
    wrong_inputs = [name for name, values in policy_input.tensors.items() if not torch.isfinite(values).all()]
    if wrong_inputs:
        origin, passing = f"The policy's input is not finite already: {listing(wrong_inputs)}", False
    else:
        origin, passing = describe_origin(
            policy.model,
            lambda watch: policy.act(policy_input, seed, watch, editors),
            tuple(site.name for site in policy.sites),
        )
    if passing:
        return not_finite(where, origin, "")
    dtype = policy.identity().config.get("dtype")
    remedy = "use another checkpoint" if dtype == "float32" else "use --dtype float32, or another checkpoint"
    return not_finite(where, origin, f"{remedy}, and a new --output, if it comes again")
