"""What every policy offers the rollout and the store: a layout, an input made of an observation, an action chunk.

A policy is a small adapter around a model. It knows its cameras, prompt format and normalisation; it knows nothing about
simulators, episodes or files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from vla_attention.capture.environments.base import Observation
from vla_attention.capture.recording.attention import RowCollector
from vla_attention.schemas.errors import unknown_name
from vla_attention.schemas.layout import PatchGrid, Prompt, SiteLayout


@dataclass(frozen=True)
class PolicyCamera:
    """A camera slot of the model that sees something, and where its picture comes from.

    flip_rows, flip_columns: the model's image is the environment's raw one (bottom row first) with these reversed. visible: side
    of the part that the model sees, as a share of the picture's side, around its middle. grid: how patches tile that part.
    """

    slot: str
    environment_camera: str
    flip_rows: bool
    flip_columns: bool
    grid: PatchGrid
    visible: float = 1.0


@dataclass(frozen=True)
class PolicyInput:
    """One observation and instruction, ready for the model.

    frames: slot -> (height, width, 3) uint8, the images as the model sees them. key_role: site -> (key,) uint8 codes of
    `Role`.
    state: (8,) float64, not normalised. tensors: what the model takes, by its own names, batch 1.
    """

    frames: Mapping[str, NDArray[np.uint8]]
    key_role: Mapping[str, NDArray[np.uint8]]
    prompt: Prompt
    state: NDArray[np.float64]
    tensors: Mapping[str, Tensor]


class Policy(Protocol):
    """A policy whose attention can be recorded."""

    @property
    def name(self) -> str:
        """Short name, as on the command line."""

    @property
    def sites(self) -> tuple[SiteLayout, ...]:
        """The softmax families whose rows can be recorded, with the layout of their keys."""

    @property
    def num_layers(self) -> int:
        """Transformer blocks, numbered from 0."""

    @property
    def num_heads(self) -> int:
        """Attention heads of a block."""

    @property
    def num_denoise_steps(self) -> int:
        """Network evaluations of one replan."""

    @property
    def action_horizon(self) -> int:
        """Actions of one chunk."""

    @property
    def default_replan_steps(self) -> int:
        """Actions of a chunk that the policy's own published evaluation executes before it asks again."""

    @property
    def num_action_queries(self) -> int:
        """Queries that are actions, in every recorded call."""

    @property
    def cameras(self) -> tuple[PolicyCamera, ...]:
        """The camera slots that see something, in key order."""

    def query_pools(self) -> NDArray[np.float64]:
        """Return the weights (pool, action query) of the means that stand for single action steps."""

    def replan_noise_seed(self, run_seed: int, task_id: int, episode_index: int, replan: int) -> int:
        """Return the seed of one replan's initial noise; it never depends on what ran before."""

    def denoise_times(self) -> NDArray[np.float64]:
        """Return the noise level or flow time of each denoise step, (denoise,)."""

    def provenance(self) -> dict[str, Any]:
        """Return what identifies the policy, as plain JSON values; two runs that differ here must not be merged."""

    def prepare(self, observation: Observation, instruction: str) -> PolicyInput:
        """Turn an observation and an instruction into the model's input."""

    def act(
        self, policy_input: PolicyInput, noise_seed: int, recorders: Mapping[str, RowCollector] | None = None
    ) -> NDArray[np.float64]:
        """Return the action chunk (horizon, 7) for the environment. The same seed gives the same noise anywhere.

        `recorders`: for each site whose rows are wanted, where they go.
        """


def camera_frame(observation: Observation, camera: str) -> NDArray[np.uint8]:
    """Return a camera's picture; the error names the cameras that the environment has."""
    if camera not in observation.images:
        raise unknown_name("environment camera", camera, observation.images)
    return observation.images[camera]


def initial_noise(seed: int, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return standard normal noise from a counter-based generator: the same on every device and with every torch."""
    return np.random.Generator(np.random.Philox(seed)).standard_normal(shape, dtype=np.float32)


def weights_digest(model: nn.Module) -> str:
    """Return the SHA-256 (hex) over names, dtypes, shapes and bytes of all weights, in order of their names."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        # A view as bytes serves bfloat16 too, which numpy does not know.
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()
