"""Cosmos Policy behind the policy interface: from observation to action chunk, with the layouts of its two sites."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.environments.base import Observation
from vla_attention.capture.policies.cosmos.family import COSMOS
from vla_attention.capture.policies.cosmos.latents import (
    CROSS,
    SELF,
    action_shares,
    actions_of_frame,
    cameras,
    query_pools,
    self_roles,
)
from vla_attention.capture.policies.cosmos.model import CosmosModel
from vla_attention.capture.policies.cosmos.preprocess import Ranges, compressed_picture, proprio_of, upright
from vla_attention.capture.policies.cosmos.sampler import flow_time
from vla_attention.capture.policies.cosmos.text import TextSource
from vla_attention.capture.policies.identity import PolicySource, describe_policy
from vla_attention.capture.policies.policy import GivenInputs, PolicyInput, camera_frame
from vla_attention.capture.policies.weights import dtype_name, weights_digest
from vla_attention.capture.recording.attention import AttentionEditor, RowCollector
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.stores.store_format import PolicyIdentity

ACTION_FRAME = "action"


class CosmosPolicy:
    """Transformer, image encoder, text embeddings and statistics, for LIBERO-like observations.

    query_frame: the latent frame whose tokens' rows are recorded: `action`, `curr_last`, `frameN` or a frame's name.
    open_loop_steps: actions of a chunk that are executed before the next policy call.
    """

    #: Every key is computed anew at every denoise step.
    has_prefix = False

    def __init__(
        self,
        model: CosmosModel,
        text: TextSource,
        statistics: Ranges,
        source: PolicySource,
        *,
        open_loop_steps: int = 16,
        query_frame: str = ACTION_FRAME,
    ):
        config = model.config
        if not 1 <= open_loop_steps <= config.chunk_size:
            raise BadArgument(
                f"Cannot use --num-open-loop-steps {open_loop_steps}: the policy gives {config.chunk_size} actions a "
                f"call; expected 1 to {config.chunk_size}."
            )
        self.model = model
        #: Sizes and conventions.
        self.config = config
        self.text = text
        self.statistics = statistics
        self.source = source
        self.name = source.name
        self.family = "cosmos"
        self.query_frame = config.frames.names[config.frames.index(query_frame)]
        self.sites = model.sites
        self.num_layers = config.dit.num_blocks
        self.num_heads = config.dit.num_heads
        self.num_denoise_steps = len(model.levels)
        self.action_horizon = config.chunk_size
        self.default_protocol = COSMOS
        self.default_replan_steps = open_loop_steps
        self.num_action_queries = config.tokens_per_frame
        self.cameras = cameras(config)
        #: The model's images are the stored ones.
        self.needs_camera_frames = False

    def denoise_times(self) -> NDArray[np.float64]:
        """Return the network's time of each denoise step, (denoise,): 1 = noise, towards 0 = clean."""
        return np.array([flow_time(level) for level in self.model.levels])

    def replan_noise_seed(self, run_seed: int, task_id: int, episode_index: int, replan: int) -> int:
        """Return the seed of a replan's noise: always the run's seed, as in the reference.

        Every replan starts from the same noise, so that differences between replans come from their inputs only.
        """
        return run_seed

    def query_pools(self) -> NDArray[np.float64]:
        """Return weights (pool, query) that pool the recorded queries by action step and dimension, step-major."""
        if self.query_frame != ACTION_FRAME:
            raise BadArgument(
                f"Queries of latent frame '{self.query_frame}' do not stand for action steps; use --query-frame action."
            )
        return query_pools(action_shares(self.config))

    @cached_property
    def _digest(self) -> str:
        return weights_digest(self.model)

    def identity(self) -> PolicyIdentity:
        """Return the policy's description for the store. Slow the first time, because it reads all weights."""
        facts = {
            "config": json.loads(json.dumps(asdict(self.config))),
            "dtype": dtype_name(self.model.dtype),
            "normalisation": "min-max",
            "statistics": to_json(self.statistics),
            "query_frame": self.query_frame,
            "noise": "the same at every replan",
            **self.text.provenance(),
        }
        return describe_policy(self, self.source, self._digest, facts)

    def prepare(self, observation: Observation, instruction: str) -> PolicyInput:
        """Turn an observation and an instruction into the model's input (batch 1).

        state: the 9 numbers of proprioception, not normalised. The prompt's pieces are keys of `cross`. tensors:
        `given` (1, channel, frame, row, column) latents and `text` (1, position, width).
        """
        frames = {
            camera.name: compressed_picture(upright(camera_frame(observation, camera.source)), self.config.image_size)
            for camera in self.cameras
        }
        proprio = proprio_of(observation.gripper_qpos, observation.eef_pos, observation.eef_quat)
        return self._input_of(frames, proprio, instruction)

    def prepare_again(self, given: GivenInputs) -> PolicyInput:
        """Turn what a call was given into the model's input (batch 1)."""
        frames = {camera.name: given.frames[camera.name] for camera in self.cameras}
        return self._input_of(frames, given.state, given.instruction)

    def _input_of(
        self, frames: Mapping[str, NDArray[np.uint8]], proprio: NDArray[np.float64], instruction: str
    ) -> PolicyInput:
        """Return the model's input of pictures in key order, as the model sees them."""
        config = self.config
        encoded = self.text.encode(instruction)
        expected = (1, config.text_length, config.dit.text_dim)
        if tuple(encoded.embedding.shape) != expected:
            raise BadArgument(
                f"The text embedding of '{instruction}' has shape {tuple(encoded.embedding.shape)}, but the policy "
                f"reads {expected}."
            )
        normalised = self.statistics.normalise_proprio(proprio)
        return PolicyInput(
            frames=frames,
            key_role={SELF: self_roles(config), CROSS: encoded.roles},
            prompt=encoded.prompt,
            state=proprio,
            tensors={
                "given": self.model.given_latents(list(frames.values()), normalised),
                "text": encoded.embedding.to(self.model.device),
            },
        )

    def act(
        self,
        policy_input: PolicyInput,
        noise_seed: int,
        recorders: Mapping[str, RowCollector] | None = None,
        editors: Mapping[str, AttentionEditor] | None = None,
    ) -> NDArray[np.float64]:
        """Return the action chunk (horizon, 7) for the environment; it does not depend on the recorders."""
        config = self.config
        given, text = policy_input.tensors["given"], policy_input.tensors["text"]
        queries = config.frames.index(self.query_frame)
        clean = self.model.sample_latents(given, text, noise_seed, queries, recorders, editors)[0].cpu()
        frame = clean[:, config.frames.index(ACTION_FRAME)]
        actions = actions_of_frame(frame, config.chunk_size, config.action_dim).numpy()
        return self.statistics.environment_actions(actions)

    def action_units(self) -> NDArray[np.float64]:
        """Return how far 1 of the model's normalised actions moves the robot, (action dim,), in the robot's units."""
        size = self.config.action_dim
        low, high = self.statistics.environment_actions(np.stack([np.zeros(size), np.ones(size)]))
        units: NDArray[np.float64] = high - low
        return units
