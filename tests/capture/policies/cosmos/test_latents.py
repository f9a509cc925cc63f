"""Numbers in latent frames, the noise levels, and the solver."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kit.examples import examples
from vla_attention.capture.policies.cosmos.config import CosmosConfig, SamplerConfig
from vla_attention.capture.policies.cosmos.embedded import DUMMY_CONFIG
from vla_attention.capture.policies.cosmos.latents import (
    action_shares,
    actions_of_frame,
    fill_frame,
    query_pools,
)
from vla_attention.capture.policies.cosmos.sampler import flow_time, noise_levels, sample, seeded_noise


def test_a_frame_repeats_its_numbers_and_cuts_the_last_copy():
    filled = fill_frame(torch.arange(9.0), (2, 3, 4)).reshape(-1)
    assert filled.tolist() == [float(k % 9) for k in range(24)]


@settings(max_examples=examples(15), deadline=None)
@given(chunk=st.integers(1, 6), dim=st.integers(1, 4), extra=st.integers(0, 5))
def test_actions_written_as_copies_are_read_back(chunk, dim, extra):
    actions = torch.arange(float(chunk * dim)).reshape(chunk, dim)
    frame = torch.cat([actions.reshape(-1).repeat(3), torch.full((min(extra, chunk * dim - 1),), 99.0)])
    torch.testing.assert_close(actions_of_frame(frame, chunk, dim), actions)


def test_every_published_action_token_stands_for_four_pairs():
    shares = action_shares(CosmosConfig())
    assert shares.shape == (196, 16, 7)
    assert ((shares > 0).sum(axis=(1, 2)) == 4).all()
    np.testing.assert_allclose(shares.sum(axis=(1, 2)), 1.0)
    for token in range(196):
        row, column = divmod(token, 14)
        steps = {4 * (h % 4) + w // 7 for h in (2 * row, 2 * row + 1) for w in (2 * column, 2 * column + 1)}
        dims = {w % 7 for w in (2 * column, 2 * column + 1)}
        found_steps, found_dims = np.nonzero(shares[token])
        assert set(found_steps) == steps
        assert set(found_dims) == dims
    grippers = {token % 14 for token in np.nonzero(shares[:, :, 6].sum(axis=1))[0]}
    assert grippers == {3, 6, 10, 13}


def test_pools_are_means_over_the_tokens_of_a_step():
    shares = action_shares(DUMMY_CONFIG)
    pools = query_pools(shares)
    assert pools.shape == (16 * 7, 16)
    np.testing.assert_allclose(pools.sum(axis=1), 1.0)
    np.testing.assert_allclose(pools[3 * 7 + 2], shares[:, 3, 2] / shares[:, 3, 2].sum())


def test_the_published_noise_levels():
    levels = noise_levels(SamplerConfig())
    np.testing.assert_allclose(levels, [80, 42.2911, 20.9724, 9.6183, 4], rtol=1e-5)
    np.testing.assert_allclose([flow_time(x) for x in levels], [0.98765, 0.97690, 0.95449, 0.90582, 0.8], atol=1e-5)


@pytest.mark.parametrize(("steps", "evaluations"), [(1, 1), (2, 1), (3, 3), (5, 5)])
def test_two_steps_make_one_evaluation_as_in_the_reference(steps, evaluations):
    levels = noise_levels(SamplerConfig(num_steps=steps))
    assert len(levels) == evaluations
    assert levels[0] == 80
    seen = []

    def denoise(noisy, sigma, step):
        seen.append((sigma, step))
        return noisy * 0

    sample(denoise, torch.ones(3), levels)
    assert seen == [(pytest.approx(level), step) for step, level in enumerate(levels)]


def test_the_solver_is_exact_where_the_estimate_is_constant():
    """With a constant estimate x0, the exact path is x0 + sigma * eps, and the last evaluation is on it."""
    target, noise = torch.tensor([0.3, -1.2]), torch.tensor([0.7, 0.4])
    visited = []

    def denoise(noisy, sigma, step):
        visited.append((sigma, noisy))
        return target

    levels = noise_levels(SamplerConfig(num_steps=6))
    result = sample(denoise, noise, levels)
    assert torch.equal(result, target)
    start = noise * 80 - target
    for sigma, noisy in visited:
        torch.testing.assert_close(noisy, target + start * sigma / 80, rtol=1e-5, atol=1e-5)


def test_the_solver_is_of_second_order():
    """On dx/dl with the estimate linear in l = -ln sigma, the multistep solver has no error after its first step."""

    def denoise(noisy, sigma, step):
        return torch.tensor([-math.log(sigma)])

    def last_state(steps):
        states = []
        sample(
            lambda x, s, i: (states.append(x), denoise(x, s, i))[1],
            torch.zeros(1),
            noise_levels(SamplerConfig(num_steps=steps)),
        )
        return float(states[-1])

    # x' = x0 - x in l, x0 = l: x = l - 1 + C e^-l from x(l_0) = 0
    first, end = -math.log(80), -math.log(4)
    exact = end - 1 + (1 - first) * math.exp(-(end - first))
    errors = [abs(last_state(steps) - exact) for steps in (5, 9, 17, 33)]
    orders = [math.log2(coarse / fine) for coarse, fine in pairwise(errors)]
    assert all(order > 1.5 for order in orders), orders


def test_noise_is_numpys_legacy_and_large_seeds_work():
    legacy = np.random.RandomState(196).standard_normal((2, 3)).astype(np.float32)
    assert np.array_equal(seeded_noise(196, (2, 3)), legacy)
    large = seeded_noise(2**62 + 5, (100,))
    assert np.isfinite(large).all()
    assert not np.array_equal(large, seeded_noise(2**61 + 5, (100,)))
