"""Variants of one policy call, made together: keys that are knocked out, other prompts and pictures, another noise.

What variants share is computed once: pictures that are the same, and the prefix of all variants that change nothing in
it. Keys that no query sees are left out before the variants become a batch, in which they would all be computed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.gemma import KeysValues, Rotation
from vla_attention.capture.policies.pi.model import Denoising, PiModel
from vla_attention.capture.recording.attention import CallKeys, FactorEditor, LogitChange, log_factors

#: Bytes of the logits of one block that a batch may have on a processor: beyond it, larger batches gain nothing.
_MOST_LOGITS = 1 << 28
#: More than there are conditions of a call.
_MOST_CALLS_OF_GPU = 1 << 10


def most_calls(config: PiConfig, num_keys: int, device: torch.device) -> int:
    """Return the number of calls whose logits of one prefix block take `_MOST_LOGITS`; num_keys: of the prefix.

    On a GPU, where larger batches do gain, memory alone limits them.
    """
    if device.type != "cpu":
        return _MOST_CALLS_OF_GPU
    return max(1, _MOST_LOGITS // (4 * config.paligemma.num_heads * num_keys**2))


def call_bytes(config: PiConfig, num_bytes: int) -> int:
    """Return the memory that one call of a batch takes at most: one prefix block, and the caches of all.

    num_bytes: of a number of the model. Counted are the three matrices of the block's feed-forward layer, eight of the
    width of its residual stream, its logits in float32 before and after the softmax, and the caches twice, as they are
    brought into the order of the calls.
    """
    model, keys = config.paligemma, config.prefix_len
    caches = 2 * model.depth * 2 * keys * model.num_kv_heads * model.head_dim * num_bytes
    return _block_bytes(config, num_bytes) + caches


def graph_bytes(config: PiConfig, num_bytes: int) -> int:
    """Return the memory of the graph of a call, about: of every prefix block, and a seventh for the denoise steps."""
    return round(8 / 7 * config.paligemma.depth * _block_bytes(config, num_bytes))


def _block_bytes(config: PiConfig, num_bytes: int) -> int:
    model, keys = config.paligemma, config.prefix_len
    block = keys * (3 * model.mlp_dim + 8 * model.width) * num_bytes
    return block + 2 * 4 * model.num_heads * keys**2


@dataclass(frozen=True)
class ModelCall:
    """One variant for the model: its inputs by name, batch 1, noise (1, horizon, action dim), and the editor."""

    tensors: Mapping[str, Tensor]
    noise: Tensor
    editor: FactorEditor | None


@dataclass(frozen=True)
class _Prefix:
    """What the prefix pass of a variant is made of: the number of its input, and the editor that changes the pass."""

    number: int
    editor: FactorEditor | None


@torch.no_grad()
def sample_variants(model: PiModel, calls: Sequence[ModelCall], num_steps: int, batch: int) -> Tensor:
    """Return the actions (call, horizon, action dim) float32, still normalised.

    What bfloat16 rounds differs from batch to batch by more than small effects. The first call is then made in every
    batch of calls with as many tokens, and these are moved by as much as it differs from its first time: a call that is
    the same gives the same to the bit.

    num_steps: denoise steps. batch: calls that are made at a time, at most.
    """
    inputs = _Inputs(model)
    numbers = [inputs.number(call.tensors) for call in calls]
    prefixes = [
        _Prefix(number, call.editor if call.editor and call.editor.changes_prefix else None)
        for number, call in zip(numbers, calls, strict=True)
    ]
    actions: list[Tensor | None] = [None] * len(calls)
    for valid in dict.fromkeys(inputs.valid[number] for number in numbers):
        of_mask = [i for i, number in enumerate(numbers) if inputs.valid[number] == valid]
        # Calls with a prefix of their own first: in the batches after them, all share one.
        ordered = sorted(of_mask, key=lambda i: (prefixes[i].editor is None, prefixes[i].number))
        group = _Group(model, inputs, np.flatnonzero(valid), num_steps)
        size = min(batch, most_calls(model.config, len(group.real), model.device))
        again = [0] if 0 in ordered and len(ordered) > size > 1 and model.dtype is torch.bfloat16 else []
        ordered = [i for i in ordered if i not in again]
        for first in range(0, len(ordered), size - len(again)):
            chosen = again + ordered[first : first + size - len(again)]
            made = group.sample([calls[i] for i in chosen], [prefixes[i] for i in chosen])
            if again and actions[0] is None:
                actions[0] = made[0]
            moved = made - made[:1] + actions[0] if again and actions[0] is not None else made
            for i, one in list(zip(chosen, moved, strict=True))[len(again) :]:
                actions[i] = one
    return torch.stack([one for one in actions if one is not None])


class _Inputs:
    """The different inputs of calls, embedded, each once; pictures and prompts that are the same are one."""

    def __init__(self, model: PiModel) -> None:
        self.model = model
        self.embedded: list[Tensor] = []
        self.states: list[Tensor] = []
        #: Which keys of the prefix are valid, (prefix key,) as a tuple: inputs that agree in it make batches.
        self.valid: list[tuple[bool, ...]] = []
        self._known: list[Mapping[str, Tensor]] = []
        self._pictures: list[tuple[Tensor, Tensor]] = []

    def number(self, tensors: Mapping[str, Tensor]) -> int:
        """Return the number of an input; embeds it the first time."""
        for number, known in enumerate(self._known):
            if known is tensors or all(torch.equal(known[name], values) for name, values in tensors.items()):
                return number
        cameras = self.model.config.cameras
        pictures = [self._picture(tensors[f"image:{camera}"]) for camera in cameras]
        self.embedded.append(self.model.embed_projected(pictures, tensors["tokens"]))
        masks = {camera: tensors[f"image_mask:{camera}"] for camera in cameras}
        self.valid.append(tuple(self.model.prefix_valid(masks, tensors["token_mask"])[0].tolist()))
        self.states.append(tensors["state"])
        self._known.append(tensors)
        return len(self._known) - 1

    def _picture(self, picture: Tensor) -> Tensor:
        for known, projected in self._pictures:
            if known is picture or torch.equal(known, picture):
                return projected
        projected = self.model.project_pictures(picture)
        self._pictures.append((picture, projected))
        return projected


class _Group:
    """Calls whose inputs have the same valid keys; `real` are these keys of the prefix."""

    def __init__(self, model: PiModel, inputs: _Inputs, real: NDArray[np.int64], num_steps: int) -> None:
        config = model.config
        self.model, self.inputs, self.real, self.num_steps = model, inputs, real, num_steps
        self.places = torch.from_numpy(real).to(model.device)
        #: A call of a denoise step: its keys are those of the prefix, then those of the suffix's own tokens.
        self.step = CallKeys(
            slice(config.first_action_query, config.suffix_len),
            slice(len(real), len(real) + config.suffix_len),
            np.concatenate([real, np.arange(config.prefix_len, config.prefix_len + config.suffix_len)]),
        )
        self.unchanged: dict[_Prefix, tuple[KeysValues, ...]] = {}
        positions = torch.tensor([[len(real)]], device=model.device) + torch.arange(
            config.suffix_len, device=model.device
        )
        self.rotation = Rotation.at(positions, config.action_expert.head_dim)
        self.waves = model.time_waves(num_steps)

    def sample(self, calls: Sequence[ModelCall], prefixes: Sequence[_Prefix]) -> Tensor:
        """Make the calls as one batch; returns (call, horizon, action dim)."""
        model = self.model
        state = torch.cat([self.inputs.states[prefix.number] for prefix in prefixes])
        mask = model.suffix_mask(torch.ones(1, len(self.real), dtype=torch.bool, device=model.device))
        changed = _Changed.by([call.editor for call in calls], model.config.suffix_len, self.step, model.device)
        if changed.allowed is not None:
            mask = mask & changed.allowed
        denoising = Denoising(state, self.rotation, mask, self._cache(prefixes), None)
        x = torch.cat([call.noise for call in calls])
        for step, waves in enumerate(self.waves):
            x = x + (-1.0 / self.num_steps) * model.velocity(x, step, waves, denoising, None, changed.editor)
        return x

    def _cache(self, prefixes: Sequence[_Prefix]) -> tuple[KeysValues, ...]:
        """Return the keys and values of the prefix of each call, by block."""
        different = list(dict.fromkeys(prefixes))
        new = [prefix for prefix in different if prefix not in self.unchanged]
        blocks = self._encoded(new) if new else ()
        caches = {prefix: tuple(_one(entry, place) for entry in blocks) for place, prefix in enumerate(new)}
        self.unchanged |= {prefix: cache for prefix, cache in caches.items() if prefix.editor is None}
        caches |= self.unchanged
        if len(different) == 1 and different[0].editor is None:
            return tuple(_expanded(entry, len(prefixes)) for entry in caches[different[0]])
        return tuple(
            KeysValues(torch.cat([entry.keys for entry in entries]), torch.cat([entry.values for entry in entries]))
            for entries in zip(*(caches[prefix] for prefix in prefixes), strict=True)
        )

    def _encoded(self, prefixes: Sequence[_Prefix]) -> tuple[KeysValues, ...]:
        embedded = torch.cat([self.inputs.embedded[prefix.number][:, self.places] for prefix in prefixes])
        editors = [prefix.editor for prefix in prefixes]
        changed = _Changed.by(editors, len(self.real), CallKeys.of_prefix(self.real), self.model.device)
        valid = torch.ones(embedded.shape[:2], dtype=torch.bool)
        tokens = torch.from_numpy(self.real)
        return self.model.encode_prefix(embedded, valid, changed.editor, tokens, changed.allowed).cache


def _one(entry: KeysValues, place: int) -> KeysValues:
    return KeysValues(entry.keys[place : place + 1], entry.values[place : place + 1])


def _expanded(entry: KeysValues, count: int) -> KeysValues:
    return KeysValues(entry.keys.expand(count, -1, -1, -1), entry.values.expand(count, -1, -1, -1))


@dataclass(frozen=True)
class _Changed:
    """What changes the attention of a batch: keys that may not be read, (call, query, key), and factors of the others.

    None where there is nothing of it. Keys that are cut as a whole need no logits, so that fused attention can be used.
    """

    allowed: Tensor | None
    editor: _Everywhere | None

    @classmethod
    def by(cls, editors: Sequence[FactorEditor | None], queries: int, call: CallKeys, device: torch.device) -> _Changed:
        """Return it for the editor of each variant of a call with so many queries; None changes nothing."""
        factors = [None if editor is None else editor.factors(queries, call) for editor in editors]
        shape = next((given.shape for given in factors if given is not None), None)
        if shape is None:
            return cls(None, None)
        stacked = np.stack([np.ones(shape) if given is None else given for given in factors])
        added = log_factors(stacked)
        bias = torch.from_numpy(added).to(device)[:, None] if added.any() else None
        return cls(torch.from_numpy(stacked > 0).to(device), None if bias is None else _Everywhere(bias.add))


@dataclass(frozen=True)
class _Everywhere:
    """An editor with one change for all blocks, of a batch of prefix passes or of denoise steps."""

    added: LogitChange

    def change(self, layer: int, denoise_step: int | None, call: CallKeys) -> LogitChange:
        """See `AttentionEditor`."""
        return self.added

    def finish(self) -> None:
        """Nothing is left to do: it holds factors alone."""
