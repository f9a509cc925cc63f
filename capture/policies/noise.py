"""Noise of the denoise loop: a seed per replan, and normal numbers from a seed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def noise_seed(run_seed: int, task_id: int, episode_index: int, replan: int) -> int:
    """Return the seed of one replan's initial noise, a non-negative 63-bit number.

    It depends on the arguments only, so that an episode does not depend on the episodes before it. It fits a signed
    64-bit integer, which every reader of a store has.
    """
    words = np.random.SeedSequence([run_seed, task_id, episode_index, replan]).generate_state(1, dtype=np.uint64)
    return int(words[0] >> np.uint64(1))


def initial_noise(seed: int, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return standard normal noise from a counter-based generator: the same on every device and with every torch."""
    return np.random.Generator(np.random.Philox(seed)).standard_normal(shape, dtype=np.float32)
