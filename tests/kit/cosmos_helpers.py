"""Helpers of the Cosmos tests: where the golden cases are, made-up observations, a collector that keeps all rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vla_attention.capture.environments.base import Observation
from vla_attention.capture.recording.attention import RowCollector
from vla_attention.capture.recording.recorder import make_recorders
from vla_attention.schemas.stores.store_format import Recording

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "tests" / "golden" / "cosmos"
#: larger cases, too large for the repository, where a checkout has them beside it
LARGE_GOLDEN = ROOT.parent / "shared" / "golden" / "cosmos"
INSTRUCTION, OTHER_INSTRUCTION = "pick up the black bowl", "open the top drawer of the cabinet"


def make_observation(seed: int) -> Observation:
    """Pictures of coloured squares, and a hand somewhere above the table."""
    rng = np.random.default_rng(seed)

    def picture():
        return np.kron(rng.integers(0, 255, (8, 8, 3)), np.ones((32, 32, 1))).astype(np.uint8)

    return Observation(
        images={"agentview": picture(), "robot0_eye_in_hand": picture()},
        eef_pos=rng.uniform([-0.3, -0.2, 0.8], [0.1, 0.2, 1.2]),
        eef_quat=np.array([1.0, 0.0, 0.1, 0.0]),
        gripper_qpos=np.array([0.03, -0.03]),
    )


class KeepAll(RowCollector):
    """A row collector that wants everything and keeps it: (layer, denoise step) -> (batch, head, query, key)."""

    def __init__(self):
        self.rows = {}
        self.queries = set()

    def sink(self, layer, denoise_step, action_queries):
        def take(rows):
            self.rows[layer, denoise_step] = rows.clone()
            self.queries.add((action_queries.start, action_queries.stop))

        return take


def recorders_of(policy, prepared):
    """Recorders of rows and contributions of both sites, all layers, heads and denoise steps, as the rollout makes them."""
    layers, steps = tuple(range(policy.num_layers)), tuple(range(policy.num_denoise_steps))
    recording = Recording(
        layers=layers,
        layer_labels=layers,
        denoise_steps=steps,
        heads=tuple(range(policy.num_heads)),
        queries="mean",
        num_action_queries=policy.num_action_queries,
        mantissa_bits=23,
        contributions=True,
    )
    return make_recorders(recording, policy.sites, prepared.key_role)
