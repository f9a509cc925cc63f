"""A recorded call reads nothing back from its device before its end, and leaves no tensor on the processor.

On torch's device `meta` tensors have a shape and no numbers: reading one, or mixing it with one of the processor, is an
error. The transfers at a call's end are replaced, and what compares the pictures of variants before they are made.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.kit.cosmos_helpers import INSTRUCTION, recorders_of
from tests.kit.policy_inputs import make_observation
from vla_attention.capture.interventions.changed_inputs import CallContext
from vla_attention.capture.interventions.resolution import interventions_for
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.policies.cosmos.embedded import DUMMY_CONFIG, random_policy
from vla_attention.capture.policies.pi.embedded import dummy_policy
from vla_attention.capture.policies.policy import CallVariant, changed_actions
from vla_attention.capture.recording import recorder
from vla_attention.schemas.interventions import Interventions, KeyKnockout

CHANGES = {
    "unchanged": Interventions(),
    "all queries": Interventions(keys=(KeyKnockout("role:instruction"),)),
    "the action's queries": Interventions(keys=(KeyKnockout("role:image", queries="action", weight=0.5),)),
}


@pytest.fixture(params=["pi", "cosmos"])
def on_meta(request, monkeypatch):
    """A policy without numbers, the input of a call, and the shapes that were moved to the processor."""
    if request.param == "cosmos":
        pytest.importorskip("diffusers")
    policy = dummy_policy() if request.param == "pi" else random_policy("untrained-tiny", DUMMY_CONFIG)
    if request.param == "pi":
        policy.model.to("meta")
        given = policy.prepare(make_observation(0), INSTRUCTION)
    else:  # its picture encoder runs while the input is prepared, and clamps what it gives to numbers
        given = policy.prepare(make_observation(0), INSTRUCTION)
        policy.model.to("meta")
        given = replace(given, tensors={name: tensor.to("meta") for name, tensor in given.tensors.items()})
    moved = []

    def read_back(tensor):
        assert tensor.device.type == "meta", "a tensor was left on the processor"
        moved.append(tuple(tensor.shape))
        return torch.zeros(tensor.shape, dtype=tensor.dtype)

    plain, same = torch.Tensor.cpu, torch.equal
    monkeypatch.setattr(torch, "equal", lambda one, other: one is other if one.is_meta else same(one, other))
    monkeypatch.setattr(torch.Tensor, "cpu", lambda one: read_back(one) if one.is_meta else plain(one))
    monkeypatch.setattr(recorder, "to_processor", lambda tensors: [read_back(tensor) for tensor in tensors])
    return policy, given, moved


def editors_of(policy, given, change):
    changes = RunChanges(interventions_for(change, policy), {})
    return changes.editors(policy.sites, given, CallContext(0, 0, 0))


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_recorded_call_reads_back_once(on_meta, change):
    policy, given, moved = on_meta
    recorders = recorders_of(policy, given)
    changed_actions(policy, given, 5, recorders, editors_of(policy, given, change))
    first = len(moved)
    assert first == 1 + (change is not CHANGES["unchanged"])  # actions, and whether queries kept keys
    for one in recorders.values():
        one.finish()
    assert len(moved) == first + 2 * len(recorders)  # rows and contributions of each site


def test_variants_of_a_call_read_back_once(on_meta):
    policy, given, moved = on_meta
    if not hasattr(policy, "act_variants"):
        pytest.skip("this policy makes changed calls one by one, as above")
    variants = [CallVariant(given, 5, editors_of(policy, given, change) or {}) for change in CHANGES.values()]
    assert np.shape(policy.act_variants(variants, policy.num_denoise_steps, 2))[0] == len(CHANGES)
    assert len(moved) == 1
