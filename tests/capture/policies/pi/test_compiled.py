"""Denoise steps through torch.compile: rows, contributions and actions are the model's own up to rounding."""

from __future__ import annotations

import numpy as np
import pytest

from tests.kit.policy_inputs import make_observation
from vla_attention.capture.policies.pi.compiled import compile_steps
from vla_attention.capture.policies.pi.embedded import dummy_policy
from vla_attention.capture.rollout.policy_call import record_call
from vla_attention.schemas.stores.store_format import Recording


@pytest.fixture(scope="module")
def policy():
    return dummy_policy()


@pytest.fixture(scope="module")
def compiled():
    """The same policy with compiled steps; the graphs are run by torch itself and not turned into C++."""
    made = dummy_policy()
    compile_steps(made.model, backend="eager")
    return made


def recording(**changes):
    given = {"layers": (2, 0), "denoise_steps": (2, 0), "heads": (5, 1, 2), "queries": "mean", "contributions": True}
    given |= changes
    queries = given.pop("queries")
    pools = 4 if queries == "steps" else 0
    return Recording(
        layer_labels=given["layers"],
        num_action_queries=4,
        mantissa_bits=10,
        queries=queries,
        num_pools=pools,
        **given,
    )


INSTRUCTIONS = ("lift", "put the red cube on the plate beside the very small green cube")


@pytest.mark.parametrize(
    ("changes", "instruction"),
    [({}, INSTRUCTIONS[0]), ({"queries": "all", "contributions": False}, INSTRUCTIONS[0])],
    ids=["short", "all"],
)
def test_compiled_steps_record_what_the_model_records(policy, compiled, changes, instruction):
    given = policy.prepare(make_observation(3), instruction)
    plan, before = recording(**changes), compiled.model.compiled_steps.calls
    expected = record_call(policy, given, 11, plan, "here")
    got = record_call(compiled, given, 11, plan, "here")
    assert compiled.model.compiled_steps.calls == before + 1
    np.testing.assert_allclose(got.actions, expected.actions, rtol=0, atol=2e-6)
    rows, wanted = got.rows["joint"], expected.rows["joint"]
    assert rows.rows.shape == wanted.rows.shape
    np.testing.assert_allclose(rows.rows, wanted.rows, rtol=0, atol=2e-6)
    np.testing.assert_allclose(rows.row_sum, wanted.row_sum, rtol=0, atol=2e-6)
    assert (rows.contribution is None) == (wanted.contribution is None)
    if wanted.contribution is not None:
        scale = wanted.contribution[..., -1:, -1:]
        np.testing.assert_allclose(rows.contribution / scale, wanted.contribution / scale, rtol=1e-3, atol=1e-5)
