"""The pi policies as the rollout sees them: observation in, action chunk out, layout stated."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from capture.attention import RowCollector
from capture.environments.base import Observation
from capture.policies.base import PolicyCamera, PolicyInput, camera_frame, initial_noise, weights_digest
from capture.policies.pi.config import PiConfig
from capture.policies.pi.loading import load_pi_model
from capture.policies.pi.model import PiModel, denoise_times
from capture.policies.pi.preprocess import (
    NormalisationMode,
    NormStats,
    environment_actions,
    libero_state,
    model_image,
    pad_to,
    read_norm_stats,
)
from capture.policies.pi.tokenizer import PromptTokenizer
from schemas.errors import BadArgument
from schemas.layout import PatchGrid, Role, SiteLayout, Span, roles_from_spans

#: Which environment camera fills which slot (openpi's LIBERO inputs); other slots are black and masked.
CAMERA_OF_SLOT = {"base_0_rgb": "agentview", "left_wrist_0_rgb": "robot0_eye_in_hand"}

#: The state that openpi's LIBERO inputs build: position, axis-angle, two finger joints.
STATE_DIM = 8

PROMPT_SPAN, STATE_SPAN, ACTION_SPAN = "prompt", "state", "actions"


@dataclass(frozen=True)
class PiSource:
    """Where a policy's weights come from: `checkpoint` is a path, or a description of how they were made."""

    name: str
    checkpoint: str
    checkpoint_format: str
    untrained: bool


def site_layout(config: PiConfig) -> SiteLayout:
    """Return the key axis of a denoise step: cameras, prompt, state token (pi0 only), actions."""
    lengths = [(camera, config.siglip.num_tokens) for camera in config.cameras]
    lengths.append((PROMPT_SPAN, config.max_token_len))
    if not config.pi05:
        lengths.append((STATE_SPAN, 1))
    lengths.append((ACTION_SPAN, config.action_horizon))
    spans: list[Span] = []
    start = 0
    for name, length in lengths:
        stop = start + length
        if name in config.cameras:
            spans.append(Span(name, "image", start, stop, camera=name, grid=patch_grid(config)))
        elif name == PROMPT_SPAN:
            spans.append(Span(name, "text", start, stop))
        else:
            spans.append(Span(name, "state" if name == STATE_SPAN else "action", start, stop))
        start = stop
    return SiteLayout(name="joint", spans=tuple(spans))


def patch_grid(config: PiConfig) -> PatchGrid:
    """Return how the patches of any camera tile its model image."""
    siglip = config.siglip
    return PatchGrid(siglip.grid, siglip.grid, siglip.image_size, siglip.image_size)


class PiPolicy:
    """A pi0 or pi0.5 model with its tokenizer and statistics, for LIBERO-like observations.

    `relative_actions`: the model was trained on differences to the state (openpi's pi0_libero), so the state is added.
    """

    def __init__(
        self,
        model: PiModel,
        tokenizer: PromptTokenizer,
        norm_stats: NormStats,
        source: PiSource,
        *,
        normalisation: NormalisationMode,
        relative_actions: bool = False,
    ):
        config = model.config
        if tokenizer.vocab_size > config.vocab_size:
            raise BadArgument(
                f"The tokenizer has {tokenizer.vocab_size} pieces, but the model '{source.name}' knows "
                f"{config.vocab_size}: it is another model's tokenizer."
            )
        norm_stats.check(normalisation, STATE_DIM)
        self.model = model
        self.tokenizer = tokenizer
        self.norm_stats = norm_stats
        self.source = source
        self.normalisation = normalisation
        self.relative_actions = relative_actions
        self.name = source.name
        self.sites = (site_layout(config),)
        self.num_layers = config.action_expert.depth
        self.num_heads = config.action_expert.num_heads
        self.num_denoise_steps = config.num_denoise_steps
        self.action_horizon = config.action_horizon
        self.num_action_queries = config.action_horizon
        self.cameras = tuple(
            PolicyCamera(slot, CAMERA_OF_SLOT[slot], rotate_180=True, grid=patch_grid(config))
            for slot in config.cameras
            if slot in CAMERA_OF_SLOT
        )

    def denoise_times(self) -> NDArray[np.float64]:
        """Return the flow time of each denoise step, (denoise,): 1 = noise, towards 0 = action."""
        return denoise_times(self.num_denoise_steps).astype(np.float64)

    @cached_property
    def _digest(self) -> str:
        return weights_digest(self.model)

    def provenance(self) -> dict[str, Any]:
        """Return what identifies the policy, as plain JSON values; reading all weights, it is slow the first time."""
        config = self.model.config
        return {
            "policy": self.name,
            "family": "pi05" if config.pi05 else "pi0",
            "checkpoint": self.source.checkpoint,
            "checkpoint_format": self.source.checkpoint_format,
            "weights_digest": self._digest,
            "untrained": self.source.untrained,
            "config": {**asdict(config), "cameras": list(config.cameras)},
            "dtype": str(self.model.dtype).removeprefix("torch."),
            "device": str(self.model.device),
            "normalisation": self.normalisation,
            "relative_actions": self.relative_actions,
            "prompt_format": "task-state-action" if config.discrete_state_input else "instruction-newline",
            "tokenizer_digest": self.tokenizer.digest,
        }

    def prepare(self, observation: Observation, instruction: str) -> PolicyInput:
        """Turn an observation and an instruction into the model's input (openpi's LIBERO inputs, batch 1)."""
        config, device = self.model.config, self.model.device
        size = config.siglip.image_size
        frames = {
            camera.slot: model_image(camera_frame(observation, camera.environment_camera), size)
            for camera in self.cameras
        }
        state = libero_state(observation.eef_pos, observation.eef_quat, observation.gripper_qpos)
        normalised = self.norm_stats.state.normalise(state, self.normalisation)
        layout = self.sites[0]
        prompt_span = layout.span(PROMPT_SPAN)
        tokenized = self.tokenizer.tokenize(
            instruction,
            max_token_len=config.max_token_len,
            first_key=prompt_span.start,
            state=normalised if config.discrete_state_input else None,
        )
        roles = {camera: Role.IMAGE if camera in frames else Role.MASKED_IMAGE for camera in config.cameras}
        # The prompt's own roles replace the placeholder below.
        roles |= {PROMPT_SPAN: Role.TEXT, STATE_SPAN: Role.STATE, ACTION_SPAN: Role.ACTION}
        key_role = roles_from_spans(layout, roles)
        key_role[prompt_span.start : prompt_span.stop] = tokenized.roles

        black = np.zeros((size, size, 3), dtype=np.uint8)
        tensors: dict[str, Tensor] = {
            "tokens": torch.from_numpy(tokenized.ids)[None].to(device),
            "token_mask": torch.from_numpy(tokenized.mask)[None].to(device),
            "state": torch.from_numpy(pad_to(normalised, config.action_dim)).float()[None].to(device),
        }
        for camera in config.cameras:
            tensors[f"image:{camera}"] = image_tensor(frames.get(camera, black)).to(device)
            tensors[f"image_mask:{camera}"] = torch.tensor([camera in frames], device=device)
        return PolicyInput(frames=frames, key_role=key_role, prompt=tokenized.prompt, state=state, tensors=tensors)

    def act(
        self, policy_input: PolicyInput, noise_seed: int, recorder: RowCollector | None = None
    ) -> NDArray[np.float64]:
        """Return the action chunk (horizon, 7) for the environment; the noise depends on `noise_seed` only."""
        config, tensors = self.model.config, policy_input.tensors
        noise = initial_noise(noise_seed, (1, config.action_horizon, config.action_dim))
        sampled = self.model.sample_actions(
            images={camera: tensors[f"image:{camera}"] for camera in config.cameras},
            image_masks={camera: tensors[f"image_mask:{camera}"] for camera in config.cameras},
            tokens=tensors["tokens"],
            token_mask=tensors["token_mask"],
            state=tensors["state"],
            noise=torch.from_numpy(noise).to(self.model.device),
            recorder=recorder,
        )
        return environment_actions(
            sampled[0].cpu().numpy().astype(np.float64),
            self.norm_stats,
            self.normalisation,
            relative_to=policy_input.state if self.relative_actions else None,
        )


def image_tensor(image: NDArray[np.uint8]) -> Tensor:
    """Return (1, 3, height, width) float32 in [-1, 1] of an image (height, width, 3): x/255·2 - 1, as in openpi."""
    scaled = image.astype(np.float32) / 255.0 * 2.0 - 1.0
    return torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)))[None]


def load_pi_policy(
    checkpoint: str | Path,
    tokenizer: str | Path,
    *,
    config: PiConfig | None = None,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PiPolicy:
    """Load a policy from a checkpoint folder (openpi's PyTorch or JAX format) and a tokenizer file.

    Normalisation and the meaning of actions are those of openpi's LIBERO configurations: pi0.5 quantiles and plain
    actions, pi0 z-scores and actions relative to the state.
    """
    # The cheap files first: a missing tokenizer should not cost the minutes that the weights take.
    prompt_tokenizer = PromptTokenizer(tokenizer)
    model, checkpoint_format = load_pi_model(checkpoint, config=config, dtype=dtype, device=device)
    pi05 = model.config.pi05
    source = PiSource(
        name="pi05" if pi05 else "pi0",
        checkpoint=str(checkpoint),
        checkpoint_format=checkpoint_format,
        untrained=False,
    )
    return PiPolicy(
        model,
        prompt_tokenizer,
        read_norm_stats(checkpoint),
        source,
        normalisation="quantile" if pi05 else "z-score",
        relative_actions=not pi05,
    )
