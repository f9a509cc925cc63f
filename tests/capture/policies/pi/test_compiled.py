"""Denoise steps through torch.compile: rows, contributions and actions are the model's own up to rounding."""

from __future__ import annotations

import argparse

import numpy as np
import pytest
import torch

from tests.kit.policy_inputs import KeepAll, make_observation
from vla_attention.capture.policies.cosmos.family import FAMILY as COSMOS_FAMILY
from vla_attention.capture.policies.pi.compiled import compile_steps
from vla_attention.capture.policies.pi.embedded import DUMMY_CONFIG, build_random_model, dummy_policy
from vla_attention.capture.policies.pi.family import FAMILY
from vla_attention.capture.rollout.policy_call import record_call
from vla_attention.schemas.errors import BadArgument
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
    [
        ({}, INSTRUCTIONS[0]),
        ({}, INSTRUCTIONS[1]),
        ({"queries": "all", "contributions": False}, INSTRUCTIONS[0]),
        ({"queries": "steps"}, INSTRUCTIONS[0]),
        ({"layers": (1,), "denoise_steps": (0, 1, 2)}, INSTRUCTIONS[1]),
    ],
    ids=["short", "long", "all", "steps", "layers"],
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


def test_prompts_of_other_lengths_need_no_other_graph(compiled):
    torch._dynamo.reset()
    counter = torch._dynamo.testing.CompileCounter()
    compile_steps(compiled.model, backend=counter)
    counter.frame_count = 0  # the small function that is tried first
    for number, instruction in enumerate(INSTRUCTIONS):
        given = compiled.prepare(make_observation(number), instruction)
        record_call(compiled, given, number, recording(denoise_steps=(0, 1, 2)), "here")
    assert counter.frame_count == 1


def test_collectors_that_look_inside_go_through_the_model_s_own_loop(policy, compiled):
    given, before = policy.prepare(make_observation(0), "lift"), compiled.model.compiled_steps.calls
    ours, theirs = KeepAll(), KeepAll()
    np.testing.assert_array_equal(policy.act(given, 1, {"joint": ours}), compiled.act(given, 1, {"joint": theirs}))
    np.testing.assert_array_equal(ours.stacked(), theirs.stacked())
    assert compiled.model.compiled_steps.calls == before


def test_interventions_on_attention_are_refused_with_a_sentence(compiled):
    given = compiled.prepare(make_observation(0), "lift")
    with pytest.raises(BadArgument, match=r"--compile with interventions on attention.*leave --compile out"):
        compiled.act(given, 1, editors={"joint": object()})


def test_a_compiler_that_fails_is_a_sentence_and_the_model_stays_as_it_was():
    def broken(graph, inputs):
        raise OSError("no compiler here")

    model = build_random_model(DUMMY_CONFIG, 0)
    with pytest.raises(BadArgument, match=r"Cannot use --compile here: .*no compiler here.*leave --compile out"):
        compile_steps(model, backend=broken)
    assert model.compiled_steps is None


def test_the_store_says_that_steps_were_compiled_and_a_rerun_compiles_them(policy, compiled):
    identity = compiled.identity()
    assert identity.config["denoise_steps"] == "compiled"
    assert FAMILY.rebuild(identity)["compile"] is True
    assert "denoise_steps" not in policy.identity().config
    assert "compile" not in FAMILY.rebuild(policy.identity())


def test_a_cosmos_policy_refuses_to_be_compiled():
    parser = argparse.ArgumentParser()
    COSMOS_FAMILY.add_arguments(parser)
    with pytest.raises(BadArgument, match="--compile with a Cosmos policy"):
        COSMOS_FAMILY.build(parser.parse_args(["--compile"]), "cpu")


@pytest.mark.thorough
def test_code_of_the_real_compiler_gives_the_same(policy):
    made = dummy_policy()
    compile_steps(made.model)
    given = policy.prepare(make_observation(3), "lift")
    expected, got = (record_call(each, given, 11, recording(), "here") for each in (policy, made))
    np.testing.assert_allclose(got.actions, expected.actions, rtol=0, atol=2e-6)
    np.testing.assert_allclose(got.rows["joint"].rows, expected.rows["joint"].rows, rtol=0, atol=2e-6)
