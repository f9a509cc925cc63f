"""The reference's sampler: noise levels, a second-order multistep solver, and a last evaluation that gives the result.

With K requested evaluations, K - 1 solver steps lead from sigma_max to sigma_min, and one evaluation there gives
the result. As in the reference, K = 2 makes only one evaluation, at sigma_max, like K = 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.policies.cosmos.config import SamplerConfig

#: (noisy latents float32, sigma, number of the evaluation) -> estimate of the clean latents, float32
Denoiser = Callable[[Tensor, float, int], Tensor]


def noise_levels(config: SamplerConfig) -> NDArray[np.float64]:
    """Return the sigma of each network evaluation, (denoise,) float64."""
    intervals = config.num_steps - 1
    if intervals <= 1:
        return np.array([config.sigma_max])
    high, low = config.sigma_max ** (1 / config.rho), config.sigma_min ** (1 / config.rho)
    levels: NDArray[np.float64] = (high + np.arange(intervals + 1) / intervals * (low - high)) ** config.rho
    return levels


def flow_time(sigma: float) -> float:
    """Return the network's time of a noise level: t = sigma / (1 + sigma), 1 = noise, towards 0 = clean."""
    return sigma / (1.0 + sigma)


def seeded_noise(seed: int, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return the reference's standard normal noise, from numpy's legacy generator.

    Seeds above 32 bits are split into words of 32 bits.
    """
    words = seed if seed < 2**32 else [seed & 0xFFFFFFFF, seed >> 32]
    return np.random.RandomState(words).standard_normal(shape).astype(np.float32)


def sample(denoise: Denoiser, noise: Tensor, levels: NDArray[np.float64]) -> Tensor:
    """Return the clean latents (float32); `noise` is standard normal. The solver's state is float64."""
    x = (noise * levels[0]).double()
    previous: tuple[Tensor, float] | None = None
    for step, (level, following) in enumerate(pairwise(levels)):
        estimate = denoise(x.float(), float(level), step).double()
        x = _advance(x, estimate, previous, float(level), float(following))
        previous = estimate, float(level)
    return denoise(x.float(), float(levels[-1]), len(levels) - 1)


def _advance(
    x: Tensor, estimate: Tensor, previous: tuple[Tensor, float] | None, level: float, following: float
) -> Tensor:
    """One step of the second-order Adams-Bashforth solver in log-sigma; the first step is of first order."""
    if previous is None:
        return (1 - following / level) * estimate + following / level * x
    last_estimate, last_level = previous
    now = -math.log(level)
    h = -math.log(following) - now
    c = (-math.log(last_level) - now) / h
    p1 = math.expm1(-h) / -h
    p2 = (p1 - 1) / -h
    b2 = p2 / c
    b1 = p1 - b2
    result: Tensor = math.exp(-h) * x + h * (b1 * estimate + b2 * last_estimate)
    return result
