"""A policy whose actions turn NaN at chosen calls."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vla_attention.capture.policies.pi.policy import PiPolicy


def spoil_actions(
    monkeypatch: pytest.MonkeyPatch, seed: int, task: int, episode: int, replan: int = 1, times: int = 100
) -> list[int]:
    """Let the actions of one replan hold NaN, at so many calls; returns how many are left.

    seed: of the run; the replan is known by the seed of its noise.
    """
    act, left = PiPolicy.act, [times]

    def spoiled(self: PiPolicy, policy_input: Any, noise_seed: int, *given: Any) -> Any:
        actions = act(self, policy_input, noise_seed, *given)
        if noise_seed == self.replan_noise_seed(seed, task, episode, replan) and left[0]:
            left[0] -= 1
            actions = actions.copy()
            actions[0, 2] = np.nan
        return actions

    monkeypatch.setattr(PiPolicy, "act", spoiled)
    return left
