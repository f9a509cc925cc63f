"""The first order of knock-outs against finite differences of calls that are made by themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from tests.capture.interventions.test_interventions_on_policies import policy_named
from tests.kit.policy_inputs import make_observation
from vla_attention.capture.interventions.factors import SiteEdit, SiteEditor
from vla_attention.capture.policies.pi.influence import cut_gradients
from vla_attention.capture.recording.attention import CallKeys

STEP = 4e-3


@dataclass
class OfWholeKey:
    """Moves the logits of one key by `step` / (1 - p), in float64, as `cut_gradients` counts it."""

    key: int
    step: float

    def change(self, layer: int, denoise_step: int | None, call: CallKeys):
        numbers = range(10_000) if call.numbers is None else call.numbers.tolist()

        def change(logits: torch.Tensor) -> torch.Tensor:
            rows = torch.softmax(logits.double(), dim=-1)
            place = list(numbers[: logits.shape[-1]]).index(self.key)
            added = torch.zeros_like(logits)
            added[..., place] = (self.step / (1.0 - rows[..., place])).float()
            if call.in_prefix:
                added[..., place, place] = 0.0
            return logits + added

        return change

    def finish(self) -> None:
        pass


@pytest.mark.parametrize("name", ["pi05", "pi0"])
@pytest.mark.parametrize("whole", [False, True], ids=["a small weight", "whole keys"])
def test_gradients_are_those_of_calls_with_a_little_less_of_a_key(name, whole):
    policy = policy_named(name)
    model, site, given = policy.model, policy.sites[0], policy.prepare(make_observation(0), "put the red bowl down")
    config = model.config
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (3, config.action_horizon, config.action_dim))
    directions = torch.from_numpy(signs.astype(np.float32))
    found = cut_gradients(model, given.tensors, policy._noise([5]), directions, config.num_denoise_steps, whole)
    assert found.shape == (3, config.prefix_len)

    def sums(key: int, step: float) -> np.ndarray:
        factors = np.ones(site.num_keys)
        factors[key] = np.exp(step)
        less = SiteEditor(site.name, [SiteEdit("key", "factor", factors, "all")])
        editor = OfWholeKey(key, step) if whole else less
        actions = policy._sample(given.tensors, [5], None, editor)[0]
        return (actions.astype(np.float64) * signs).sum(axis=(1, 2))

    valid = np.flatnonzero(given.key_role[site.name][: config.prefix_len] < 10)
    strongest = [key for key in np.argsort(-np.abs(found.numpy()).sum(axis=0))[:6] if key in valid]
    assert len(strongest) == 6
    for key in [*strongest, int(valid[0])]:
        expected = -(sums(key, STEP) - sums(key, -STEP)) / (2 * STEP)
        np.testing.assert_allclose(found[:, key], expected, rtol=2e-2, atol=2e-3)


def test_keys_that_nobody_reads_have_none_and_the_call_stays_as_it_was():
    policy = policy_named("pi05")
    given, config = policy.prepare(make_observation(0), "put the red bowl down"), policy.model.config
    before = policy.act(given, 5)
    directions = torch.ones(1, config.action_horizon, config.action_dim)
    found = cut_gradients(policy.model, given.tensors, policy._noise([5]), directions, config.num_denoise_steps)
    inputs = given.tensors
    valid = policy.model.prefix_valid(
        {camera: inputs[f"image_mask:{camera}"] for camera in config.cameras}, inputs["token_mask"]
    )[0]
    assert (found[0, ~valid] == 0).all()
    assert (found[0, valid] != 0).all()
    np.testing.assert_array_equal(policy.act(given, 5), before)
    assert not any(weight.requires_grad for weight in policy.model.parameters())
