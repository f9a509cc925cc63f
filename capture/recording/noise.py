"""Noise seeds: one per replan, derived from the run's seed alone, so that an episode never depends on what ran before it."""

from __future__ import annotations

import numpy as np


def noise_seed(run_seed: int, task_id: int, episode_index: int, replan: int) -> int:
    """Seed of one replan's initial noise, an unsigned 63-bit number (it fits the signed integers of every reader)."""
    words = np.random.SeedSequence([run_seed, task_id, episode_index, replan]).generate_state(1, dtype=np.uint64)
    return int(words[0] >> np.uint64(1))
