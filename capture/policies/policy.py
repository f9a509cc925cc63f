"""The interface between a policy and the rollout.

A policy is a small adapter around a model, with cameras, a prompt format and a normalisation. It has no access to the
simulator, to episodes or to files.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from vla_attention.capture.environments.base import Observation
from vla_attention.capture.environments.base import (
    camera_frame as camera_frame,
)  # policies and their users import it here
from vla_attention.capture.environments.episode_protocol import EvaluationProtocol
from vla_attention.capture.recording.attention import AttentionEditor, FactorEditor, RowCollector
from vla_attention.schemas.layout import Part, Prompt, SiteLayout, picture_size
from vla_attention.schemas.stores.store_format import PolicyCameraView, PolicyIdentity


@dataclass(frozen=True)
class PolicyInput:
    """One observation and instruction, ready for the model.

    frames: camera -> (height, width, 3) uint8, the images as the model sees them. key_role: site -> (key,) uint8 codes
    of `Role`. state: (state dim,) float64, not normalised. tensors: the model's inputs by its own names, batch 1.
    camera_frames: camera -> (height, width, 3) uint8, the cameras' own pictures, if the policy `needs_camera_frames`.
    shown: camera -> the part of its frame that shows the camera's picture, where the rest is a border.
    """

    frames: Mapping[str, NDArray[np.uint8]]
    key_role: Mapping[str, NDArray[np.uint8]]
    prompt: Prompt
    state: NDArray[np.float64]
    tensors: Mapping[str, Tensor]
    camera_frames: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    shown: Mapping[str, Part] = field(default_factory=dict)

    @property
    def given(self) -> GivenInputs:
        """What this input was made of; `Policy.prepare_again` makes the same input of it."""
        return GivenInputs(self.frames, self.camera_frames, self.state, self.prompt.instruction_text, self.shown)


@dataclass(frozen=True)
class GivenInputs:
    """What a policy call was given, as a store keeps it. It may be changed before the input is prepared again.

    frames: camera -> (height, width, 3) uint8, the images as the model sees them. camera_frames: camera -> the camera's
    own picture. Where there is one, the model's image is made of it, and `frames` is not used: a changed picture of
    `frames` needs the camera's own one removed. state: (state dim,) float64, not normalised. instruction: may be empty.
    shown: as in `PolicyInput`, of frames without the camera's own picture.
    """

    frames: Mapping[str, NDArray[np.uint8]]
    camera_frames: Mapping[str, NDArray[np.uint8]]
    state: NDArray[np.float64]
    instruction: str
    shown: Mapping[str, Part] = field(default_factory=dict)


class ModelSizes(Protocol):
    """How many layers, heads and denoise steps there are to record from; a policy or a layout."""

    @property
    def family(self) -> str:
        """Kind of model, as the store names it; it decides which layer numbers are accepted."""

    @property
    def num_layers(self) -> int:
        """Transformer blocks, numbered from 0."""

    @property
    def num_heads(self) -> int:
        """Attention heads of a block."""

    @property
    def num_denoise_steps(self) -> int:
        """Network evaluations of one replan."""


class Policy(ModelSizes, Protocol):
    """A policy whose attention can be recorded."""

    #: short name, for the store and the first lines of a run
    name: str
    #: actions of one chunk
    action_horizon: int
    #: the published evaluation of policies of this kind
    default_protocol: EvaluationProtocol
    #: actions of a chunk that the published evaluation executes before the next policy call
    default_replan_steps: int
    #: whether some keys are made in a pass before the denoise steps, in which their tokens read each other
    has_prefix: bool
    #: action queries of every recorded call
    num_action_queries: int
    #: the cameras whose pictures reach the model, in key order
    cameras: tuple[PolicyCameraView, ...]
    #: whether the model's images have more than whole grey levels, so that stored ones are not exact
    needs_camera_frames: bool

    @property
    def sites(self) -> tuple[SiteLayout, ...]:
        """The sites whose rows can be recorded, with the layout of their keys."""

    @property
    def model(self) -> nn.Module:
        """The network. Its modules are looked at when a policy call gives numbers that are not finite."""

    def query_pools(self) -> NDArray[np.float64]:
        """Return the weights (pool, action query) of the means that stand for single action steps."""

    def replan_noise_seed(self, run_seed: int, task_id: int, episode_index: int, replan: int) -> int:
        """Return the seed of one replan's initial noise; it never depends on what ran before."""

    def denoise_times(self) -> NDArray[np.float64]:
        """Return the noise level or flow time of each denoise step, (denoise,)."""

    def identity(self) -> PolicyIdentity:
        """Return the policy's description for the store. Slow the first time, because it reads all weights."""

    def prepare(self, observation: Observation, instruction: str) -> PolicyInput:
        """Turn an observation and an instruction into the model's input."""

    def prepare_again(self, given: GivenInputs) -> PolicyInput:
        """Turn what a call was given into the model's input; unchanged, it is the same to the bit.

        Other than `prepare` it accepts an empty instruction.
        """

    def act(
        self,
        policy_input: PolicyInput,
        noise_seed: int,
        recorders: Mapping[str, RowCollector] | None = None,
        editors: Mapping[str, AttentionEditor] | None = None,
    ) -> NDArray[np.float64]:
        """Return the action chunk (horizon, 7) for the environment. A seed gives the same noise on every machine.

        recorders: the row collector of each recorded site. editors: the editor of each site whose attention changes.
        """


def changed_actions(
    policy: Policy,
    policy_input: PolicyInput,
    noise_seed: int,
    recorders: Mapping[str, RowCollector] | None,
    editors: Mapping[str, AttentionEditor] | None,
) -> NDArray[np.float64]:
    """Return what `act` gives; raise `QueryWithoutKeys` where the editors left a query without any key."""
    actions = policy.act(policy_input, noise_seed, recorders, editors)
    for editor in (editors or {}).values():
        editor.finish()
    return actions


@runtime_checkable
class BatchPolicy(Protocol):
    """A policy that can make several calls at a time."""

    def act_batch(
        self,
        policy_inputs: Sequence[PolicyInput],
        noise_seeds: Sequence[int],
        recorders: Sequence[Mapping[str, RowCollector]],
    ) -> list[NDArray[np.float64]]:
        """Return what `act` gives for each input, its noise and its recorders; equal but for rounding."""


@dataclass(frozen=True)
class CallVariant:
    """A policy call that differs from another one in its input, its noise, or the attention of some queries.

    editors: of each site whose attention changes.
    """

    policy_input: PolicyInput
    noise_seed: int
    editors: Mapping[str, FactorEditor] = field(default_factory=dict)


@runtime_checkable
class VariantPolicy(Protocol):
    """A policy that makes variants of one call together, for less than a call each."""

    def act_variants(
        self, variants: Sequence[CallVariant], num_steps: int, batch: int
    ) -> Sequence[NDArray[np.float64] | None]:
        """Return what `act` gives for each variant, equal but for rounding; None for what cannot be made.

        num_steps: denoise steps. batch: variants that are made at a time, at most.
        """

    def variant_memory(self) -> VariantMemory:
        """Return how much memory variants take, and how much is left for them."""


@dataclass(frozen=True)
class VariantMemory:
    """What variants of a call take in memory.

    Attributes:
        call_bytes: of each variant among those that are made at a time, at most.
        most_calls: variants at a time beyond which the policy makes no larger batch.
        left: bytes that the model's device has left.
        device: its name, for a sentence.
    """

    call_bytes: int
    most_calls: int
    left: float
    device: str


@runtime_checkable
class UnitsPolicy(Protocol):
    """A policy that says what a unit of its normalised actions is."""

    def action_units(self) -> NDArray[np.float64]:
        """Return how far 1 of the model's normalised actions moves the robot, (action dim,), in the robot's units."""


@runtime_checkable
class MapPolicy(VariantPolicy, Protocol):
    """A policy of whose calls it can be computed by first order how every patch moves the actions."""

    def patch_gradients(
        self, policy_input: PolicyInput, noise_seed: int, directions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return what cutting each patch as a whole changes of sums of a call's actions, (direction, patch) float32.

        directions: the factors of the actions (direction, horizon, action dim), normalised. Patches are those of
        `map_keys`.
        """

    def gradient_memory(self) -> int:
        """Return the bytes that `patch_gradients` takes beside the model, about."""


def map_site(policy: Policy) -> SiteLayout:
    """Return the first of the policy's sites that has patches of pictures: maps of patches are of it."""
    return next((site for site in policy.sites if site.pictured), policy.sites[0])


def map_keys(policy: Policy) -> tuple[int, ...]:
    """Return the keys of the patches of all cameras at the map's site."""
    site = map_site(policy)
    return tuple(int(key) for camera in policy.cameras if camera.name in site.pictured
                 for key in site.patch_keys(camera.name))  # fmt: skip


def stored_picture_sizes(policy: Policy, image_size: int) -> list[int]:
    """Return the bytes of every picture that is stored of a call; image_size: side of the cameras' own pictures."""
    sizes = [math.prod(picture_size(policy.sites, camera.name)) * 3 for camera in policy.cameras]
    return sizes + [image_size**2 * 3] * len(sizes) * policy.needs_camera_frames
