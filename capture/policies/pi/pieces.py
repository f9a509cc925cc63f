"""The pieces of the value product of a denoise step: runs of valid keys, one for every span that has any.

A processor multiplies by pieces: keys of absent cameras and of padding are left out, which nothing reads, and what each
camera adds to the mixed values is at hand for the contributions. A GPU multiplies at once: there a product more
costs its start.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vla_attention.capture.policies.pi.config import PiConfig


def pieces_of_keys(config: PiConfig, prefix_valid: Tensor, device: torch.device) -> tuple[slice, ...] | None:
    """Return the pieces of the keys of a denoise step, or None where the product is made at once.

    prefix_valid: (batch, prefix key) bool. device: of the model. Pieces are for a batch of one on a processor.
    """
    if prefix_valid.shape[0] != 1 or device.type != "cpu":
        return None
    valid = prefix_valid[0].numpy()
    lengths = [*[config.siglip.num_tokens] * len(config.cameras), config.max_token_len]
    pieces: list[slice] = []
    start = 0
    for length in lengths:
        inside = np.flatnonzero(valid[start : start + length]) + start
        runs = np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1) if inside.size else []
        pieces += [slice(int(run[0]), int(run[-1]) + 1) for run in runs]
        start += length
    first_action = start + config.first_action_query
    if first_action > start:
        pieces.append(slice(start, first_action))
    return (*pieces, slice(first_action, start + config.suffix_len))
