"""pi0 and pi0.5: a vision-language model and an action expert that share their attention, sampled by flow matching.

Sources: Black et al. 2024 (pi0), Physical Intelligence 2025 (pi0.5); the numbers follow openpi's JAX models. One replan
is one prefix pass (images and text through the vision-language model, which leaves keys and values in a cache) and one
suffix pass (state and noisy actions through the expert) for each denoise step. Only suffix passes have action queries.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla_attention.capture.policies.pi.compiled import CompiledSteps
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.flow_time import denoise_times, embed_times
from vla_attention.capture.policies.pi.gemma import AttentionCalls, GemmaModel, KeysValues, Rotation
from vla_attention.capture.policies.pi.siglip import Projector, VisionTower
from vla_attention.capture.policies.weights import Shapes, check_shapes, fill, make_empty, shapes_of
from vla_attention.capture.recording.attention import AttentionEditor, CallKeys, RowCollector


@dataclass(frozen=True)
class Prefix:
    """Result of the prefix pass for the suffix passes: one cache entry per block, and which keys are valid.

    cache: per block, keys and values (batch, kv_head, prefix key, dim). valid: (batch, prefix key) bool, where the
    masks are.
    """

    cache: tuple[KeysValues, ...]
    valid: Tensor


@dataclass(frozen=True)
class Denoising:
    """What all denoise steps of a call have in common.

    state: (batch, action dim). rotation, mask (batch, suffix query, key) bool: of the suffix. cache: as in `Prefix`.
    pieces: of the value products (`pieces_of_keys`), or None for one product.
    """

    state: Tensor
    rotation: Rotation
    mask: Tensor
    cache: tuple[KeysValues, ...]
    pieces: tuple[slice, ...] | None


class PaliGemmaInner(nn.Module):
    """Image encoder, projector and language model."""

    def __init__(self, config: PiConfig):
        super().__init__()
        self.vision_tower = VisionTower(config.siglip)
        self.multi_modal_projector = Projector(config.siglip.width, config.paligemma.width)
        self.language_model = GemmaModel(config.paligemma, vocab_size=config.vocab_size)


class PaliGemma(nn.Module):
    """The level that checkpoints call `paligemma`."""

    def __init__(self, config: PiConfig):
        super().__init__()
        self.model = PaliGemmaInner(config)


class ActionExpert(nn.Module):
    """The level that checkpoints call `gemma_expert`."""

    def __init__(self, config: PiConfig):
        super().__init__()
        self.model = GemmaModel(
            config.action_expert, condition_width=config.action_expert.width if config.pi05 else None
        )


class PaliGemmaWithExpert(nn.Module):
    """Both transformers."""

    def __init__(self, config: PiConfig):
        super().__init__()
        self.paligemma = PaliGemma(config)
        self.gemma_expert = ActionExpert(config)


class PiModel(nn.Module):
    """A pi0 or pi0.5 model in float32 or bfloat16.

    With `dtype=torch.bfloat16` these stay in float32, as in openpi's PyTorch model: patch and position embedding, all
    Gemma norms with the dense layers of the adaptive ones, and the projections of state, action and time; with the
    configuration's `float32_vision` (LeRobot) the whole image encoder and its projector too. Unlike there,
    attention logits and the rotary embedding are float32 too, as in the JAX reference: logits with 8 bits would show in
    the recorded rows.
    """

    def __init__(self, config: PiConfig, dtype: torch.dtype = torch.float32):
        super().__init__()
        self.config = config
        self.dtype = dtype
        expert = config.action_expert.width
        self.paligemma_with_expert = PaliGemmaWithExpert(config)
        self.action_in_proj = nn.Linear(config.action_dim, expert)
        self.action_out_proj = nn.Linear(expert, config.action_dim)
        if config.pi05:
            self.time_mlp_in = nn.Linear(expert, expert)
            self.time_mlp_out = nn.Linear(expert, expert)
        else:
            self.state_proj = nn.Linear(config.action_dim, expert)
            self.action_time_mlp_in = nn.Linear(2 * expert, expert)
            self.action_time_mlp_out = nn.Linear(expert, expert)
        self._place_precision(dtype)
        self.eval()
        #: Makes the denoise steps of calls of one row whose attention is not changed, where it was asked for.
        self.compiled: CompiledSteps | None = None

    def _place_precision(self, dtype: torch.dtype) -> None:
        if dtype not in (torch.float32, torch.bfloat16):
            raise ValueError(f"pi models run in float32 or bfloat16, not in {dtype}")
        self.paligemma_with_expert.to(dtype)
        self._inner.vision_tower.vision_model.embeddings.float()
        if self.config.float32_vision:
            self._inner.vision_tower.float()
            self._inner.multi_modal_projector.float()
        for gemma in (self._vlm, self._expert):
            gemma.norm.float()
            for block in gemma.blocks:
                block.input_layernorm.float()
                block.post_attention_layernorm.float()

    @property
    def _inner(self) -> PaliGemmaInner:
        return self.paligemma_with_expert.paligemma.model

    @property
    def _vlm(self) -> GemmaModel:
        return self._inner.language_model

    @property
    def _expert(self) -> GemmaModel:
        return self.paligemma_with_expert.gemma_expert.model

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.action_in_proj.weight.device

    def embed_prefix(
        self, images: Mapping[str, Tensor], image_masks: Mapping[str, Tensor], tokens: Tensor, token_mask: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the prefix (batch, prefix key, width) and which of its keys are valid, (batch, prefix key) bool.

        A masked camera is encoded too and has its keys. Text is scaled by sqrt(width), images are not.
        """
        cameras = self.config.cameras
        # All cameras share the encoder: one pass over (camera · batch) images.
        projected = self.project_pictures(torch.cat([images[camera] for camera in cameras]))
        patches = torch.unflatten(projected, 0, (len(cameras), tokens.shape[0]))
        return self.embed_projected(patches.unbind(0), tokens), self.prefix_valid(image_masks, token_mask)

    def project_pictures(self, pictures: Tensor) -> Tensor:
        """Return the patches (picture, patch, width) of pictures (picture, 3, height, width)."""
        projected: Tensor = self._inner.multi_modal_projector(self._inner.vision_tower(pictures)).to(self.dtype)
        return projected

    def embed_projected(self, patches: Sequence[Tensor], tokens: Tensor) -> Tensor:
        """Return the prefix (batch, prefix key, width) of each camera's patches and the tokens (batch, text)."""
        return torch.cat([*patches, self._vlm.embed(tokens)], dim=1)

    def prefix_valid(self, image_masks: Mapping[str, Tensor], token_mask: Tensor) -> Tensor:
        """Return which keys of the prefix are valid, (batch, prefix key) bool."""
        patches = self.config.siglip.num_tokens
        valid = [image_masks[camera][:, None].expand(-1, patches) for camera in self.config.cameras]
        return torch.cat([*valid, token_mask], dim=1)

    def encode_prefix(
        self,
        embedded: Tensor,
        valid: Tensor,
        editor: AttentionEditor | None = None,
        tokens: Tensor | None = None,
        allowed: Tensor | None = None,
    ) -> Prefix:
        """Run images and text through the vision-language model once; all keys are cached, also the invalid ones.

        Positions count valid keys only. Only keys and values of the prefix are used later, so the last block stops
        after them. With a batch of one, invalid tokens are left out of the computation, which saves nearly half of it
        in LIBERO. Their cached keys are zeros; no query attends to them.

        editor: changes the attention of every block but the last, where no token of the prefix reads; blocks that it
        does not change use torch's fused attention. tokens: the keys that the embedded tokens are, (prefix key,), if
        all of them are valid; None counts them from 0. allowed: (batch, prefix key, prefix key) bool, for tokens that
        are all valid: which keys each token may read; None: all.
        """
        device = embedded.device
        if embedded.shape[0] == 1 and not bool(valid.all()):
            real = valid[0].nonzero()[:, 0]
            places = real.to(device)
            dense = self.encode_prefix(embedded[:, places], valid[:, real], editor, real)
            return Prefix(tuple(entry.spread(places, valid.shape[1]) for entry in dense.cache), valid)
        rotation = Rotation.at((valid.cumsum(dim=1) - 1).to(device), self.config.paligemma.head_dim)
        mask = allowed
        if embedded.shape[0] > 1 and tokens is None:
            mask = valid[:, None, :].to(device)
        x = embedded
        cache = []
        *earlier, last = self._vlm.blocks
        numbers = np.arange(embedded.shape[1]) if tokens is None else tokens.cpu().numpy()
        call = CallKeys.of_prefix(numbers)
        for layer, block in enumerate(earlier):
            change = editor.change(layer, None, call) if editor is not None else None
            x, keys_values = block(x, mask, rotation, calls=None if change is None else AttentionCalls(change=change))
            cache.append(keys_values)
        cache.append(last.keys_values(x, rotation))
        return Prefix(cache=tuple(cache), valid=valid)

    def _embed_suffix(self, state: Tensor, actions: Tensor, waves: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return the suffix tokens (batch, suffix query, width) float32 and the norms' condition (batch, width).

        waves: time embedding (width,). pi0.5 feeds time to the norms and has no state token; pi0 mixes time into the
        action tokens and puts a state token first.
        """
        tokens = self.action_in_proj(actions)
        if self.config.pi05:
            # openpi has a SiLU after the second layer too.
            condition = F.silu(self.time_mlp_out(F.silu(self.time_mlp_in(waves))))
            return tokens, condition.expand(actions.shape[0], -1)
        mixed = torch.cat([tokens, waves.expand_as(tokens)], dim=-1)
        tokens = self.action_time_mlp_out(F.silu(self.action_time_mlp_in(mixed)))
        return torch.cat([self.state_proj(state)[:, None], tokens], dim=1), None

    def suffix_mask(self, prefix_valid: Tensor) -> Tensor:
        """Return (batch, suffix query, key) bool: all attend to the prefix; pi0's state token not to the actions."""
        batch, queries = prefix_valid.shape[0], self.config.suffix_len
        among = torch.ones(queries, queries, dtype=torch.bool, device=prefix_valid.device)
        among[: self.config.first_action_query, self.config.first_action_query :] = False
        return torch.cat([prefix_valid[:, None].expand(-1, queries, -1), among.expand(batch, -1, -1)], dim=-1)

    def time_waves(self, num_steps: int) -> Tensor:
        """Return the time embedding of each denoise step, (denoise, width)."""
        config = self.config
        times, periods = denoise_times(num_steps, config.time_convention), (config.min_period, config.max_period)
        return embed_times(times, config.action_expert.width, config.time_convention, periods).to(self.device)

    @torch.no_grad()
    def sample_actions(
        self,
        images: Mapping[str, Tensor],
        image_masks: Mapping[str, Tensor],
        tokens: Tensor,
        token_mask: Tensor,
        state: Tensor,
        noise: Tensor,
        num_steps: int | None = None,
        recorder: RowCollector | None = None,
        editor: AttentionEditor | None = None,
    ) -> Tensor:
        """Integrate the flow from noise to actions by Euler steps x ← x − v(x, t)/num_steps.

        Args:
            images: per camera (batch, 3, height, width) float32 in [-1, 1].
            image_masks: per camera (batch,) bool.
            tokens: (batch, text) int. token_mask: (batch, text) bool. On a GPU, masks are best in the processor's
                memory: shapes depend on them, and the processor would wait for the GPU to read them there.
            state: (batch, action dim) float32, normalised and padded; pi0.5 does not read it.
            noise: (batch, horizon, action dim) float32, the actions at t = 1.
            num_steps: number of denoise steps; None takes the configuration's.
            recorder: receives the rows of every block and denoise step of the expert, with all suffix queries and the
                positions of the action queries among them.
            editor: changes the attention of prefix pass and denoise steps; the recorded rows are the changed ones.

        Returns:
            (batch, horizon, action dim) float32, still normalised.
        """
        config = self.config
        prefix = self.encode_prefix(*self.embed_prefix(images, image_masks, tokens, token_mask), editor)
        suffix_positions = torch.arange(config.suffix_len, device=noise.device)
        valid = prefix.valid.to(noise.device)
        listens = recorder is not None and recorder.listens_to_modules
        compiled = self.compiled if noise.shape[0] == 1 and editor is None and not listens else None
        positions = valid.sum(dim=1, keepdim=True) + suffix_positions
        denoising = Denoising(
            state,
            Rotation.at(positions, config.action_expert.head_dim),
            self.suffix_mask(valid),
            prefix.cache,
            pieces_of_keys(config, prefix.valid, noise.device) if compiled is None else None,
        )
        if recorder is not None:
            lasting = slice(0, valid.shape[1])
            recorder.begin_call(denoising.mask[0].any(dim=0), lasting, denoising.pieces)

        steps = config.num_denoise_steps if num_steps is None else num_steps
        x = noise
        for step, waves in enumerate(self.time_waves(steps)):
            if compiled is not None:
                velocity = compiled.velocity(x, step, waves, denoising, recorder)
            else:
                velocity = self.velocity(x, step, waves, denoising, recorder, editor)
            x = x + (-1.0 / steps) * velocity
        return x

    def velocity(
        self,
        x: Tensor,
        step: int,
        waves: Tensor,
        denoising: Denoising,
        recorder: RowCollector | None = None,
        editor: AttentionEditor | None = None,
    ) -> Tensor:
        """Return the flow's velocity (batch, horizon, action dim) float32 at the noisy actions x, of the same shape.

        step: number of the denoise step. waves: its time embedding (width,).
        """
        config = self.config
        action_queries = slice(config.first_action_query, config.suffix_len)
        call = CallKeys(action_queries, slice(config.prefix_len, config.prefix_len + config.suffix_len))
        tokens, condition = self._embed_suffix(denoising.state, x, waves)
        hidden = tokens.to(self.dtype)
        for layer, block in enumerate(self._expert.blocks):
            if recorder is not None:
                recorder.begin_block(layer, step)
            hidden, _ = block(
                hidden,
                denoising.mask,
                denoising.rotation,
                before=denoising.cache[layer],
                condition=condition,
                calls=AttentionCalls(
                    editor.change(layer, step, call) if editor is not None else None,
                    recorder.sink(layer, step, action_queries) if recorder is not None else None,
                    denoising.pieces,
                    recorder.piece_sink(layer, step, action_queries) if recorder is not None else None,
                    recorder.update_sink(layer, step, action_queries) if recorder is not None else None,
                ),
            )
        normed, _ = self._expert.norm(hidden[:, action_queries], condition)
        velocity: Tensor = self.action_out_proj(normed.float())
        return velocity


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


def expected_tensors(config: PiConfig, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """Return name -> tensor without memory (meta) of `PiModel(config, dtype)`: shapes, and the precision of each."""
    return make_empty(lambda: PiModel(config, dtype)).state_dict()


def expected_shapes(config: PiConfig) -> Shapes:
    """Return name -> shape of every tensor of `PiModel(config)`, without allocating any."""
    return shapes_of(expected_tensors(config))


def build_model(
    config: PiConfig,
    names: Iterable[str],
    read: Callable[[str], Tensor],
    *,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PiModel:
    """Build the model and fill it tensor by tensor, so that a full-size checkpoint is never in memory twice.

    `read(name)` returns one tensor by its name in the model; each is cast to the precision of that tensor in the model.
    """
    model = make_empty(lambda: PiModel(config, dtype))
    empty = model.state_dict()
    return fill(model, {name: read(name).to(device=device, dtype=empty[name].dtype) for name in names})


def model_from_state(
    config: PiConfig,
    state: Mapping[str, Tensor],
    *,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PiModel:
    """Build the model from tensors in memory; differences of names or shapes raise `CheckpointMismatch`."""
    check_shapes(shapes_of(state), expected_shapes(config))
    return build_model(config, state, state.__getitem__, dtype=dtype, device=device)
