"""Helpers of the pi tests: golden cases that openpi computed, with their weights and manifests."""

from __future__ import annotations

import gzip
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from torch import Tensor

from tests.capture.policies.pi.jax_leaves import to_jax_leaves
from tests.kit.paths import GOLDEN as ALL_GOLDEN
from tests.kit.paths import SHARED
from tests.kit.pi_parity import Case, read_case, run_case
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.loading import load_pi_model
from vla_attention.capture.policies.pi.model import PiModel

GOLDEN = ALL_GOLDEN / "pi"
#: Larger cases, too large for the repository.
LARGE_GOLDEN = SHARED / "golden" / "pi"


#: Folders of a golden case that may have its weights; the first that exists is used.
WEIGHTS = ("checkpoint", "checkpoint_openpi_torch")


@dataclass
class GoldenCase:
    """A case and its weights."""

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
    model = load_pi_model(checkpoint, case.config)
    return GoldenCase(case, dict(model.state_dict()))


def read_manifest(name: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a full-size checkpoint."""
    manifest = json.loads(gzip.decompress((GOLDEN / "key_manifests" / f"{name}.json.gz").read_bytes()))
    # either [shape, dtype] or the shape alone
    return {key: tuple(entry[0] if isinstance(entry[0], list) else entry) for key, entry in manifest.items()}


def read_manifest_dtypes(name: str) -> dict[str, str]:
    manifest = json.loads(gzip.decompress((GOLDEN / "key_manifests" / f"{name}.json.gz").read_bytes()))
    return {key: dtype for key, (_, dtype) in manifest.items()}
