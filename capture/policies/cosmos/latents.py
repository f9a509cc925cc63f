"""Numbers in latent frames: proprioception is written into one frame, actions are read from another.

A latent frame is a volume (channel, row, column), read as one long list in that order. The frames are the key axis of
the site `self`; that of `cross` has the text positions.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.policies.cosmos.config import CosmosConfig
from vla_attention.capture.policies.cosmos.preprocess import visible_area
from vla_attention.schemas.layout import PatchGrid, Role, SiteLayout, Span, roles_from_spans
from vla_attention.schemas.stores.store_format import PolicyCameraView

SELF: Final = "self"
CROSS: Final = "cross"
TEXT_SPAN = "text"

#: Latent frame -> the simulator's camera that it shows now.
CAMERA_OF_FRAME = {"wrist": "robot0_eye_in_hand", "primary": "agentview"}

_ROLES = {
    "blank": Role.BLANK,
    "proprio": Role.PROPRIO,
    "wrist": Role.IMAGE,
    "primary": Role.IMAGE,
    "action": Role.ACTION,
    "value": Role.VALUE,
}


def cameras(config: CosmosConfig) -> tuple[PolicyCameraView, ...]:
    """Return the cameras in key order: wrist, then primary."""
    return tuple(
        PolicyCameraView(name, source=CAMERA_OF_FRAME[name], upright=True, mirrored=False, visible=visible_area())
        for name in config.frames.names
        if name in CAMERA_OF_FRAME
    )


def self_layout(config: CosmosConfig) -> SiteLayout:
    """Return the key axis of self-attention: one span of kind `latent` per latent frame."""
    rows, columns = config.dit.grid(config.latent_size, config.latent_size)
    tokens, grid = config.tokens_per_frame, PatchGrid(rows, columns, config.image_size, config.image_size)
    spans = []
    for number, name in enumerate(config.frames.names):
        camera = name if name in CAMERA_OF_FRAME else None
        spans.append(Span(name, "latent", number * tokens, (number + 1) * tokens, camera, grid if camera else None))
    return SiteLayout(SELF, tuple(spans))


def cross_layout(config: CosmosConfig) -> SiteLayout:
    """Return the key axis of cross-attention: the text's positions."""
    return SiteLayout(CROSS, (Span(TEXT_SPAN, "text", 0, config.text_length),))


def self_roles(config: CosmosConfig) -> NDArray[np.uint8]:
    """Return the role codes of self-attention's keys, the same at every replan."""
    roles = {name: _ROLES.get(name, Role.FUTURE) for name in config.frames.names}
    return roles_from_spans(self_layout(config), roles)


def fill_frame(values: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Return a frame of that shape whose element k is values[k mod number of values]; a last copy may be cut."""
    elements = int(np.prod(shape))
    copies = -(-elements // len(values))
    return values.repeat(copies)[:elements].reshape(shape)


def actions_of_frame(frame: Tensor, chunk_size: int, action_dim: int) -> Tensor:
    """Return the actions (step, dim) that a frame (channel, row, column) holds: the mean over its whole copies."""
    size = chunk_size * action_dim
    copies = frame.numel() // size
    return frame.reshape(-1)[: copies * size].reshape(copies, chunk_size, action_dim).mean(dim=0)


def action_shares(config: CosmosConfig) -> NDArray[np.float64]:
    """Return the shares (token, step, dim) of each token's elements that hold an action number; a token sums to <= 1.

    With the published sizes every token holds four (step, dim) pairs, the same in every channel. Elements of an
    incomplete copy count for none.
    """
    channels, side, patch = config.dit.in_channels, config.latent_size, config.dit.patch_size
    size = config.chunk_size * config.action_dim
    element = np.arange(channels * side * side)
    _, row, column = np.unravel_index(element, (channels, side, side))
    token = row // patch * (side // patch) + column // patch
    counted = element < len(element) // size * size
    counts = np.zeros((config.tokens_per_frame, size))
    np.add.at(counts, (token[counted], element[counted] % size), 1.0)
    shares: NDArray[np.float64] = counts / (channels * patch * patch)
    return shares.reshape(-1, config.chunk_size, config.action_dim)


def query_pools(shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return weights (step · dim, token), step-major, that pool the action frame's queries by step and dim.

    Every row sums to 1: the mean over the tokens that hold the step and dim, by the share of it that each holds.
    """
    flat = shares.reshape(len(shares), -1).T
    pools: NDArray[np.float64] = flat / flat.sum(axis=1, keepdims=True)
    return pools


def condition_mask(config: CosmosConfig) -> Tensor:
    """Return (1, 1, frame, row, column) float32: 1 for the given frames, 0 for the frames that are denoised."""
    mask = torch.zeros(1, 1, config.frames.count, config.latent_size, config.latent_size)
    mask[:, :, : config.frames.num_conditioned] = 1.0
    return mask
