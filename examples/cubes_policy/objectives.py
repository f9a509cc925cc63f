"""The losses: flow matching of the actions, and two that ask where the named cube is.

Without the second kind a policy learns to reach some cube and ignores the instruction for a long time, with nearly as
good a flow loss. Their heads are dropped after training.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from examples.cubes_policy.batches import Batch
from examples.cubes_policy.network import CAMERAS
from examples.cubes_policy.training_pass import encode, velocities
from vla_attention.capture.policies.pi.gemma import rms_normalise
from vla_attention.capture.policies.pi.model import PiModel

#: Dimensions of an action that decide about success: x, y, z and the gripper. The others turn the hand.
_MAIN, _REST = (0, 1, 2, 6), (3, 4, 5, 7)
#: Weights of the parts in the loss.
WEIGHTS = {"flow": 1.0, "flow_rest": 0.2, "heat": 0.15, "position": 0.6}


class Heads(nn.Module):
    """What is read from the tokens that enter the last block: heat from patches, positions from the last text token."""

    def __init__(self, width: int, seed: int):
        super().__init__()
        self.heat = nn.Linear(width, 2)
        self.position = nn.Linear(width, 4 * 3)
        generator = torch.Generator().manual_seed(seed)
        for layer in (self.heat, self.position):
            nn.init.normal_(layer.weight, std=width**-0.5, generator=generator)
            nn.init.zeros_(layer.bias)


def losses(model: PiModel, heads: Heads, batch: Batch) -> dict[str, Tensor]:
    """Return each part of the loss, by the names in `WEIGHTS`, unweighted."""
    prefix = encode(model, batch)
    time = batch.times[..., None, None]
    actions = batch.actions[:, None]
    # The model's convention: t = 1 is noise, and a step of sampling subtracts the velocity.
    predicted = velocities(model, prefix, time * batch.noise + (1.0 - time) * actions, batch.times)
    error = (predicted - (batch.noise - actions)).square()
    tokens = rms_normalise(prefix.last)
    return {
        "flow": error[..., _MAIN].mean(),
        "flow_rest": error[..., _REST].mean(),
        "heat": _heat_loss(heads, tokens, batch, model.config.siglip.num_tokens),
        "position": _position_loss(heads, tokens, batch),
    }


def _heat_loss(heads: Heads, tokens: Tensor, batch: Batch, patches: int) -> Tensor:
    images = torch.unflatten(tokens[:, : len(CAMERAS) * patches], 1, (len(CAMERAS), patches))
    log_heat = heads.heat(images).float().transpose(-1, -2).log_softmax(dim=-1)  # (batch, camera, 2, patch)
    entropy = -(batch.heat * log_heat).sum(dim=-1)
    return _mean_where(entropy, batch.has_heat)


def _position_loss(heads: Heads, tokens: Tensor, batch: Batch) -> Tensor:
    text = tokens[:, tokens.shape[1] - batch.tokens.shape[1] :]
    last = batch.token_mask.sum(dim=1) - 1
    found = torch.unflatten(heads.position(text[torch.arange(len(last)), last]).float(), -1, (4, 3))
    error = F.smooth_l1_loss(found, batch.positions, reduction="none", beta=0.5).mean(dim=-1)
    return _mean_where(error, batch.has_position)


def _mean_where(values: Tensor, exists: Tensor) -> Tensor:
    return (values * exists).sum() / exists.sum().clamp(min=1)


def total(parts: dict[str, Tensor]) -> Tensor:
    """Return the weighted sum that is minimised."""
    return torch.stack([WEIGHTS[name] * part for name, part in parts.items()]).sum()
