"""What tests of policies share: an observation made up of coloured rectangles, and a collector that keeps all rows."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vla_attention.capture.environments.base import Observation
from vla_attention.capture.policies.policy import PolicyInput
from vla_attention.capture.recording.attention import RowCollector


def make_observation(seed: int) -> Observation:
    """Two pictures (256, 256, 3) of coloured rectangles, and a hand somewhere above the table."""
    generator = np.random.default_rng(seed)

    def picture() -> np.ndarray:
        frame = np.full((256, 256, 3), 150, dtype=np.uint8)
        frame[128:] = (120, 100, 80)
        for _ in range(6):
            row, column = generator.integers(0, 216, 2)
            height, width = generator.integers(15, 40, 2)
            frame[row : row + height, column : column + width] = generator.integers(0, 255, 3)
        return frame

    return Observation(
        images={"agentview": picture(), "robot0_eye_in_hand": picture()},
        eef_pos=generator.uniform([-0.3, -0.2, 0.8], [0.1, 0.2, 1.2]),
        eef_quat=np.array([0.999, 0.02, 0.03, 0.01]),
        gripper_qpos=np.array([0.03, -0.03]),
    )


class KeepAll(RowCollector):
    """Keeps the rows of every layer and denoise step.

    `rows`: (layer, denoise step) -> (batch, head, query, key). `queries`: the ranges of action queries that were seen.
    """

    def __init__(self) -> None:
        self.rows: dict[tuple[int, int], Tensor] = {}
        self.queries: set[tuple[int, int]] = set()

    def sink(self, layer, denoise_step, action_queries):
        def take(rows):
            self.rows[layer, denoise_step] = rows.clone()
            self.queries.add((action_queries.start, action_queries.stop))

        return take

    def stacked(self) -> np.ndarray:
        """All rows (denoise, layer, batch, head, query, key)."""
        layers, steps = (1 + max(index) for index in zip(*self.rows, strict=True))
        return np.stack([[self.rows[layer, step].numpy() for layer in range(layers)] for step in range(steps)])


def assert_same_input(first: PolicyInput, second: PolicyInput) -> None:
    """Fail unless two inputs of a policy are the same to the bit."""
    assert (first.prompt, set(first.tensors)) == (second.prompt, set(second.tensors))
    for name, tensor in first.tensors.items():
        assert tensor.dtype == second.tensors[name].dtype, name
        assert torch.equal(tensor, second.tensors[name]), name
    np.testing.assert_array_equal(first.state, second.state)
    for what in ("frames", "camera_frames", "key_role"):
        mine, other = getattr(first, what), getattr(second, what)
        assert list(mine) == list(other), what
        for name, values in mine.items():
            np.testing.assert_array_equal(values, other[name])
