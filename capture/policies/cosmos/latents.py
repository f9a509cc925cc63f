"""Numbers in latent frames: proprioception is written into one frame, actions and the value are read from others.

A latent frame is a volume (channel, row, column), read as one long list in that order.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.policies.cosmos.config import CosmosConfig


def fill_frame(values: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Return a frame of that shape whose element k is values[k mod number of values]; a last copy may be cut."""
    elements = int(np.prod(shape))
    copies = -(-elements // len(values))
    return values.repeat(copies)[:elements].reshape(shape)


def read_actions(frame: Tensor, chunk_size: int, action_dim: int) -> Tensor:
    """Return the actions (step, dim) that a frame (channel, row, column) holds: the mean over its whole copies."""
    size = chunk_size * action_dim
    copies = frame.numel() // size
    return frame.reshape(-1)[: copies * size].reshape(copies, chunk_size, action_dim).mean(dim=0)


def read_value(frame: Tensor) -> float:
    """Return the value that the last frame holds: its mean, from -1..1 to 0..1 and cut there."""
    return float(((frame.mean() + 1) / 2).clamp(0, 1))


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


def condition_mask(config: CosmosConfig, num_given: int | None = None) -> Tensor:
    """Return (1, 1, frame, row, column) float32: 1 for the given frames, 0 for the frames that are denoised."""
    given = config.frames.num_conditioned if num_given is None else num_given
    mask = torch.zeros(1, 1, config.frames.count, config.latent_size, config.latent_size)
    mask[:, :, :given] = 1.0
    return mask
