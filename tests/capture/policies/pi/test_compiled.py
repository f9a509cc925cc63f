"""Denoise steps as one compiled graph: the same numbers up to rounding, recorded or not, and never a second graph."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch._dynamo.utils import counters

from tests.kit.thorough import thorough_except
from vla_attention.capture.engine.call import Caller, PolicyCall
from vla_attention.capture.environments.base import Observation
from vla_attention.capture.interventions.changed_inputs import CallContext
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.policies.pi import embedded
from vla_attention.capture.policies.pi.compiled import CannotCompile, CompiledSteps
from vla_attention.capture.policies.pi.family import PiSettings
from vla_attention.capture.policies.pi.policy import PiPolicy
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.run.capture_run import _policy_batch
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions, knockout
from vla_attention.schemas.stores.store_format import Recording


@pytest.fixture(autouse=True)
def no_graphs():
    torch._dynamo.reset()
    counters.clear()
    yield
    torch._dynamo.reset()


def policy_of(pi05: bool = True, blocks: int = 3) -> PiPolicy:
    policy = embedded.dummy_policy()
    config = policy.model.config
    sizes = {name: replace(getattr(config, name), depth=blocks) for name in ("paligemma", "action_expert")}
    config = replace(config, pi05=pi05, **sizes)
    model = embedded.build_random_model(config, 0)
    return PiPolicy(model, policy.tokenizer, policy.processing, policy.source)


def given(policy: PiPolicy, instruction: str = "pick the red cube"):
    stream = np.random.default_rng(len(instruction))
    images = {camera.source: stream.integers(0, 255, (64, 64, 3), dtype=np.uint8) for camera in policy.cameras}
    pose = {"eef_pos": np.zeros(3), "eef_quat": np.array([1.0, 0, 0, 0]), "gripper_qpos": np.array([0.02, -0.02])}
    return policy.prepare(Observation(images=images, **pose), instruction)


def record(policy: PiPolicy, policy_input, changes: RunChanges | None = None):
    layers, steps = tuple(range(policy.num_layers)), tuple(range(policy.num_denoise_steps))
    recording = Recording(
        layers, layers, steps, tuple(range(policy.num_heads)), "mean", policy.num_action_queries, 10, contributions=True
    )
    caller = Caller(policy, recording) if changes is None else Caller(policy, recording, changes)
    (made,) = caller.make([PolicyCall(policy_input, 3, CallContext(0, 0, 0), 0, "the test")])
    return made


#: pi0.5 or pi0, backend, blocks: inductor's code takes half a minute to build for three.
CASES = [(True, "aot_eager", 3), (False, "aot_eager", 3), (True, "inductor", 1), (False, "inductor", 3)]


@pytest.mark.parametrize(("pi05", "backend", "blocks"), thorough_except(CASES[:3], CASES, several=True))
def test_one_graph_gives_the_numbers_of_the_model(pi05, backend, blocks):
    policy = policy_of(pi05, blocks)
    inputs = [given(policy), given(policy, "put the green cube on the plate")]
    eager = [record(policy, each) for each in inputs]
    policy.model.compiled = CompiledSteps(policy.model, backend)
    for each, expected in zip(inputs, eager, strict=True):
        made = record(policy, each)
        np.testing.assert_allclose(made.actions, expected.actions, atol=1e-5, rtol=0)
        np.testing.assert_allclose(made.rows["joint"].rows, expected.rows["joint"].rows, atol=2e-6, rtol=0)
        gram, wanted = made.rows["joint"].contribution, expected.rows["joint"].contribution
        np.testing.assert_allclose(gram, wanted, atol=1e-5 * np.abs(wanted).max(), rtol=0)
        np.testing.assert_array_equal(policy.act(each, 3), made.actions)
    assert counters["stats"]["unique_graphs"] == 1
    assert not counters["graph_break"]


def test_changed_calls_and_batches_run_without_it():
    policy = policy_of()
    each = given(policy)
    changes = RunChanges(Interventions(keys=knockout("role:instruction").keys), {0: "pick the red cube"})
    expected = record(policy, each, changes)
    batch = policy.act_batch([each, each], [3, 4], [{}, {}])
    policy.model.compiled = CompiledSteps(policy.model, refused)
    np.testing.assert_array_equal(record(policy, each, changes).actions, expected.actions)
    np.testing.assert_array_equal(policy.act_batch([each, each], [3, 4], [{}, {}]), batch)
    with pytest.raises(CannotCompile, match=r"no compiler here.*--compile"):
        record(policy, each)


def refused(*_):
    raise RuntimeError("no compiler here")


def test_numbers_that_are_not_finite_are_traced_to_their_module():
    policy = policy_of()
    policy.model.compiled = CompiledSteps(policy.model, "aot_eager")
    policy.model._expert.blocks[1].mlp.up_proj.weight.data.fill_(3e38)
    made = record(policy, given(policy))
    assert isinstance(made, NumbersNotFinite)
    assert "layers.1.mlp" in str(made)


def test_the_store_says_it_and_a_rerun_does_the_same(capsys):
    policy = PiSettings(checkpoint="untrained-tiny", compile=True).build("cpu")
    assert "compiled at the first policy call" in capsys.readouterr().err
    assert policy.identity().config["compiled"] == "denoise steps"
    assert PiSettings.of_store(policy.identity())["compile"]
    eager = PiSettings(checkpoint="untrained-tiny").build("cpu")
    assert "compiled" not in eager.identity().config
    assert not PiSettings.of_store(eager.identity())["compile"]
    settings = SimpleNamespace(policy_batch=2, interventions=Interventions())
    with pytest.raises(BadArgument, match="--compile"):
        _policy_batch(settings, policy, "cpu", 2)
