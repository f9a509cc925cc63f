"""One policy call with recorders: its actions and rows, or the error that says where numbers stopped being finite."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from vla_attention.capture.policies.policy import Policy, PolicyInput
from vla_attention.capture.recording.attention import AttentionEditor
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite, all_finite, describe_origin
from vla_attention.capture.recording.recorder import make_recorders
from vla_attention.capture.store.recorded_rows import RecordedRows
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


def _not_finite(
    policy: Policy, policy_input: PolicyInput, seed: int, where: str, editors: Mapping[str, AttentionEditor] | None
) -> NumbersNotFinite:
    """Return the error of a policy call whose results are not finite; it repeats the call to find where that began."""
    wrong_inputs = [name for name, values in policy_input.tensors.items() if not torch.isfinite(values).all()]
    if wrong_inputs:
        origin = f"The policy's input is not finite already: {listing(wrong_inputs)}"
    else:
        origin = describe_origin(
            policy.model,
            lambda watch: policy.act(policy_input, seed, watch, editors),
            tuple(site.name for site in policy.sites),
        )
    dtype = policy.identity().config.get("dtype")
    remedy = "use another checkpoint" if dtype == "float32" else "use --dtype float32, or another checkpoint"
    return NumbersNotFinite(
        f"The policy's numbers turned NaN or infinite at {where}. {origin}. Nothing of this episode was kept, and the "
        f"episodes before it are unharmed; {remedy}, and a new --store."
    )
