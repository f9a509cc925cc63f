"""How strongly a call's actions react to every key of the prefix, from a few backward passes.

To cut a part w of key k adds log(1 - w) to the logits of the queries that read it, in every block of the prefix and in
every block and denoise step of the expert. With b added to the logit of k in one row of attention, whose probabilities
are p, the change of an action a is to first order

    d a / d w = -d a / d b                                  for a small w
    da(w = 1) = -(d a / d b) / (1 - p_k)                    for the key as a whole

the second because a row without k has exactly p_j / (1 - p_k) of every other key; what follows the row stays of first
order. The sum over rows, heads, blocks and steps is a column J_k of the Jacobian of the actions, and |J_k| / sqrt(n)
the size of the change of n numbers of the actions. For random signs u, E[(u·J_k)²] = |J_k|² (Hutchinson 1990), so that
a few directions suffice for an order of the keys. Sizes, and the order of words, come from exact knock-outs
(`docs/effects.md`): a policy that switches to another motion is not seen from here. Rows that are on one key but for
less than 1e-5 lose the digits of that key's gradient; none of `pi05_cubes` is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from vla_attention.capture.policies.pi.gemma import Rotation
from vla_attention.capture.policies.pi.model import Denoising, PiModel
from vla_attention.capture.recording.attention import AttentionEditor, CallKeys, LogitChange


@dataclass(frozen=True)
class _Added(AttentionEditor):
    """Adds `numbers` (key,), which are 0, to the logits of all queries, but to those of a prefix token's own key.

    whole: they count by 1 / (1 - p), so that their gradient is of the key as a whole.
    """

    numbers: Tensor
    whole: bool

    def change(self, layer: int, denoise_step: int | None, call: CallKeys) -> LogitChange:
        """See `AttentionEditor`."""
        added = self.numbers if call.numbers is None else self.numbers[torch.from_numpy(call.numbers)]
        # The diagonal of the prefix, whose queries are its keys.
        counted: Tensor | float = 1.0 - torch.eye(len(added), device=added.device) if call.in_prefix else 1.0

        def change(logits: Tensor) -> Tensor:
            return logits + added * (counted / _rest(logits.detach()) if self.whole else counted)

        return change

    def finish(self) -> None:
        """Nothing is left to do: no query loses all of its keys."""


def _rest(logits: Tensor) -> Tensor:
    """Return 1 - p of every key (..., query, key); of the most probable one the sum of the others, which is exact."""
    rows = torch.softmax(logits, dim=-1)
    most = rows.argmax(dim=-1, keepdim=True)
    others = rows.scatter(-1, most, 0.0).sum(dim=-1, keepdim=True)
    return (1.0 - rows).scatter(-1, most, others.clamp(min=torch.finfo(rows.dtype).tiny))


def cut_gradients(
    model: PiModel, tensors: Mapping[str, Tensor], noise: Tensor, directions: Tensor, num_steps: int, whole: bool = True
) -> Tensor:
    """Return what cutting each key of the prefix changes of some sums of a call's actions, (direction, key) float32.

    The graph is that of the model as it is written, whatever form its calls have; nothing of the call is changed.

    Args:
        model: float32 or bfloat16; its weights need no gradients.
        tensors: the inputs of the call by name, batch 1.
        noise: (1, horizon, action dim).
        directions: the factors of the actions (direction, horizon, action dim), still normalised; one backward pass
            each.
        num_steps: denoise steps.
        whole: see `_Added`.
    """
    config = model.config
    added = torch.zeros(config.prefix_len + config.suffix_len, device=model.device, requires_grad=True)
    editor, cameras = _Added(added, whole), config.cameras
    with torch.no_grad():
        embedded, valid = model.embed_prefix(
            {camera: tensors[f"image:{camera}"] for camera in cameras},
            {camera: tensors[f"image_mask:{camera}"] for camera in cameras},
            tensors["tokens"],
            tensors["token_mask"],
        )
    with torch.enable_grad():
        prefix = model.encode_prefix(embedded, valid, editor)
        valid = prefix.valid.to(noise.device)
        positions = valid.sum(dim=1, keepdim=True) + torch.arange(config.suffix_len, device=noise.device)
        rotation = Rotation.at(positions, config.action_expert.head_dim)
        denoising = Denoising(tensors["state"], rotation, model.suffix_mask(valid), prefix.cache, None)
        x = noise
        for step, waves in enumerate(model.time_waves(num_steps)):
            x = x + (-1.0 / num_steps) * model.velocity(x, step, waves, denoising, None, editor)
        sums = (x * directions).sum(dim=(1, 2))
    last = len(sums) - 1
    gradients = [torch.autograd.grad(one, added, retain_graph=i < last)[0] for i, one in enumerate(sums)]
    return -torch.stack(gradients)[:, : config.prefix_len]
