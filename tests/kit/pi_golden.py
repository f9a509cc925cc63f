"""Helpers of the pi tests: golden cases that openpi computed, a collector that keeps all rows, made-up observations."""

from __future__ import annotations

import gzip
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from torch import Tensor

from tests.kit.jax_leaves import to_jax_leaves
from vla_attention.capture.environments.base import Observation
from vla_attention.capture.policies.pi.case import Case, read_case
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.loading import load_pi_model
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.parity import run_case
from vla_attention.capture.recording.attention import RowCollector

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "tests" / "golden" / "pi"
#: larger cases, too large for the repository, where a checkout has them beside it
LARGE_GOLDEN = ROOT.parent / "shared" / "golden" / "pi"


class KeepAll(RowCollector):
    """A row collector for parity tests: every layer, denoise step, batch entry, head and suffix query."""

    def __init__(self):
        self.rows = {}

    def sink(self, layer, denoise_step, action_queries):
        def take(rows):
            self.rows[denoise_step, layer] = rows.numpy().copy()

        return take

    def stacked(self) -> np.ndarray:
        """(denoise, layer, batch, head, query, key)."""
        steps, layers = (1 + max(index) for index in zip(*self.rows, strict=True))
        return np.stack([np.stack([self.rows[step, layer] for layer in range(layers)]) for step in range(steps)])


#: folder of the checkpoint that gives a golden case its weights: the first that is there
WEIGHTS = ("checkpoint", "checkpoint_openpi_torch")


@dataclass
class GoldenCase:
    """A case, its weights, and the collectors that the tests want."""

    case: Case
    weights: dict[str, Tensor]

    @property
    def config(self) -> PiConfig:
        return self.case.config

    @property
    def inputs(self):
        return self.case.inputs

    @property
    def expected(self):
        return self.case.expected

    @property
    def leaves(self) -> dict[str, np.ndarray]:
        """The weights as leaves of the JAX model."""
        return to_jax_leaves(self.weights, self.config)

    def single(self, entry: int) -> GoldenCase:
        """The same case with one entry of the batch."""
        inputs = {name: x[entry : entry + 1] if x.ndim else x for name, x in self.inputs.items()}
        return replace(self, case=replace(self.case, inputs=inputs))

    def sample(self, model: PiModel, recorder=None) -> np.ndarray:
        """Run the model on the case's inputs."""
        return run_case(self.case, model, recorder)


def load_case(folder: Path) -> GoldenCase:
    case = read_case(folder)
    checkpoint = next(folder / name for name in WEIGHTS if (folder / name).is_dir())
    model, _ = load_pi_model(checkpoint, config=case.config)
    return GoldenCase(case, dict(model.state_dict()))


def read_manifest(name: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a full-size checkpoint."""
    manifest = json.loads(gzip.decompress((GOLDEN / "key_manifests" / f"{name}.json.gz").read_bytes()))
    # either [shape, dtype] or the shape alone
    return {key: tuple(entry[0] if isinstance(entry[0], list) else entry) for key, entry in manifest.items()}


def read_manifest_dtypes(name: str) -> dict[str, str]:
    manifest = json.loads(gzip.decompress((GOLDEN / "key_manifests" / f"{name}.json.gz").read_bytes()))
    return {key: dtype for key, (_, dtype) in manifest.items()}


def make_observation(seed: int) -> Observation:
    generator = np.random.default_rng(seed)

    def picture():
        frame = np.full((256, 256, 3), 150, dtype=np.uint8)
        frame[128:] = (120, 100, 80)
        for _ in range(6):
            row, column = generator.integers(0, 216, 2)
            height, width = generator.integers(15, 40, 2)
            frame[row : row + height, column : column + width] = generator.integers(0, 255, 3)
        return frame

    return Observation(
        images={"agentview": picture(), "robot0_eye_in_hand": picture()},
        eef_pos=np.array([-0.2, 0.05, 1.0]),
        eef_quat=np.array([0.999, 0.02, 0.03, 0.01]),
        gripper_qpos=np.array([0.03, -0.03]),
    )
