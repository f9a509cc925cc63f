"""Policy calls with recorders: their actions and rows, or the error that says where numbers stopped being finite."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from vla_attention.capture.interventions.changed_inputs import CallContext
from vla_attention.capture.policies.policy import BatchPolicy, Policy, PolicyInput
from vla_attention.capture.recording.attention import AttentionEditor
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite, all_finite, describe_origin
from vla_attention.capture.recording.recorder import make_recorders
from vla_attention.capture.store.replan_records import RecordedRows, ReplanEffects, ReplanRecord
from vla_attention.schemas.errors import listing
from vla_attention.schemas.stores.store_format import Recording


@dataclass(frozen=True)
class RecordedCall:
    """What one policy call gave: actions (horizon, action dim) for the environment, and the rows of each site."""

    actions: NDArray[np.float64]
    rows: Mapping[str, RecordedRows]


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


def replan_record(
    policy_input: PolicyInput,
    call: RecordedCall,
    recording: Recording,
    *,
    env_step: int,
    noise_seed: int,
    coverage: Mapping[str, NDArray[np.float32]] | None = None,
    dataset_actions: NDArray[np.float64] | None = None,
    base_actions: NDArray[np.float64] | None = None,
    constant_cameras: frozenset[str] = frozenset(),
    effects: ReplanEffects | None = None,
) -> ReplanRecord:
    """Return what is stored of a policy call; see `ReplanRecord`."""
    return ReplanRecord(
        env_step=env_step,
        noise_seed=noise_seed,
        rows=call.rows,
        key_role=policy_input.key_role,
        prompt=policy_input.prompt,
        state=policy_input.state,
        actions=call.actions,
        frames=policy_input.frames if recording.frames else {},
        camera_frames=policy_input.camera_frames if recording.frames else {},
        coverage=coverage or {},
        dataset_actions=dataset_actions,
        base_actions=base_actions,
        constant_cameras=constant_cameras,
        effects=effects,
    )


@dataclass(frozen=True)
class PreparedCall:
    """A policy call before it is made.

    where: replan, environment step and episode, for messages. coverage: policy camera -> (patch, object) float32.
    editors: the editor of each site whose attention changes. context: its place in the run, and the scene.
    constant_cameras: those whose picture shows nothing.
    """

    env_step: int
    where: str
    context: CallContext
    policy_input: PolicyInput
    noise_seed: int
    coverage: Mapping[str, NDArray[np.float32]]
    editors: Mapping[str, AttentionEditor] | None
    constant_cameras: frozenset[str] = frozenset()


def record_calls(
    policy: Policy, calls: Sequence[PreparedCall], recording: Recording
) -> list[RecordedCall | NumbersNotFinite]:
    """Make calls as one batch if the policy can, else one after the other, and record what `recording` says.

    One call, and calls with editors, are made as `record_call` makes them, to the bit. In the place of a call whose
    actions or rows are NaN or infinite is the error that `record_call` raises: the others of a batch are not its fault.
    """
    if len(calls) == 1 or any(call.editors for call in calls) or not isinstance(policy, BatchPolicy):
        return [_recorded_or_error(policy, call, recording) for call in calls]
    pools = policy.query_pools() if recording.queries == "steps" else None
    recorders = [make_recorders(recording, policy.sites, call.policy_input.key_role, pools) for call in calls]
    inputs, seeds = [call.policy_input for call in calls], [call.noise_seed for call in calls]
    made: list[RecordedCall | NumbersNotFinite] = []
    for call, actions, recorders_of_call in zip(
        calls, policy.act_batch(inputs, seeds, recorders), recorders, strict=True
    ):
        rows = {site: recorder.finish() for site, recorder in recorders_of_call.items()}
        if all_finite(actions, rows):
            made.append(RecordedCall(actions, rows))
        else:
            made.append(_not_finite(policy, call.policy_input, call.noise_seed, call.where, None))
    return made


def _recorded_or_error(policy: Policy, call: PreparedCall, recording: Recording) -> RecordedCall | NumbersNotFinite:
    try:
        return record_call(policy, call.policy_input, call.noise_seed, recording, call.where, call.editors)
    except NumbersNotFinite as error:
        return error


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
    sentence = f"The policy's numbers turned NaN or infinite at {where}. {origin}. Nothing of this episode was kept"
    if passing:
        return NumbersNotFinite(f"{sentence}.", passing=True)
    dtype = policy.identity().config.get("dtype")
    remedy = "use another checkpoint" if dtype == "float32" else "use --dtype float32, or another checkpoint"
    return NumbersNotFinite(
        f"{sentence}, and the episodes before it are unharmed; {remedy}, and a new --output, if it comes again."
    )
