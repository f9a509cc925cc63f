"""The diffusion transformer of Cosmos Policy, with the checkpoint's own module names and shapes.

Tokens have the axes (batch, frame, token of the frame, width), because the time conditioning is per latent frame.
Self-attention is computed one frame of queries at a time. So nothing of token x token size is ever allocated, and the
recorded rows are those that the model itself uses: recording cannot change the arithmetic.
"""

from __future__ import annotations

from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla_attention.capture.policies.cosmos.config import DitConfig
from vla_attention.capture.recording.attention import LogitChange, RowSink, attend, join_heads, split_heads

NORM_EPS = 1e-6


class BlockObserver(Protocol):
    """Observes the inside of a block. The model calls it for every block and, at `self`, for every frame of queries.

    `begin_block`: is called before everything else of a block.
    `rows`: returns the function that takes the float32 probabilities (batch, head, query of the frame, key), or None.
    `updates`: takes the block's gated updates, name -> (batch, frame, token, width), after the block.
    """

    def begin_block(self, layer: int) -> None:
        """Learn that this block begins."""

    def rows(self, site: str, layer: int, frame: int, attention: Attention, value: Tensor) -> RowSink | None:
        """Return the function that takes the rows of these queries; `value` is (batch, head, key, dim)."""

    def updates(self, layer: int, updates: dict[str, Tensor], gates: dict[str, Tensor], block_input: Tensor) -> None:
        """Take the gated updates of one block; gates are (batch, frame, 1, width)."""


class BlockEditor(Protocol):
    """Changes the attention inside a block. The model asks it for every site and frame of queries."""

    def change(self, site: str, layer: int, frame: int) -> LogitChange | None:
        """Return the change of the logits (batch, head, query of the frame, key), or None."""


class RMSNorm(nn.Module):
    """x / sqrt(mean(x²) + ε) · weight over the last axis, in float32, returned in the dtype of x."""

    def __init__(self, dim: int):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise the last axis."""
        wide = x.float()
        scaled = wide * torch.rsqrt(wide.square().mean(dim=-1, keepdim=True) + NORM_EPS)
        return (scaled * self.weight.float()).to(x.dtype)


class RotaryPositions(nn.Module):
    """Rotary angles of (frame, row, column), from the exponents in the checkpoint.

    The reference casts its exponents to bfloat16 with everything else and computes frequencies from those in float32;
    the buffers are therefore part of the weights, and float32 in every precision of the model.
    """

    seq: Tensor
    dim_spatial_range: Tensor
    dim_temporal_range: Tensor

    def __init__(self, config: DitConfig):
        super().__init__()
        spatial, temporal = config.spatial_rotary_dim, config.temporal_rotary_dim
        self.register_buffer("seq", torch.arange(config.max_positions, dtype=torch.float32))
        self.register_buffer("dim_spatial_range", torch.arange(0, spatial, 2, dtype=torch.float32) / spatial)
        self.register_buffer("dim_temporal_range", torch.arange(0, temporal, 2, dtype=torch.float32) / temporal)
        self.theta_t = 10000.0 * config.rope_t_extrapolation ** (temporal / (temporal - 2))
        self.theta_h = 10000.0 * config.rope_h_extrapolation ** (spatial / (spatial - 2))
        self.theta_w = 10000.0 * config.rope_w_extrapolation ** (spatial / (spatial - 2))

    def forward(self, frames: int, rows: int, columns: int) -> tuple[Tensor, Tensor]:
        """Return cosine and sine, each (token, head dim) float32, tokens ordered by frame, row, column."""
        sizes = (frames, rows, columns)
        temporal, spatial = self.dim_temporal_range.float(), self.dim_spatial_range.float()
        frequencies = (self.theta_t**-temporal, self.theta_h**-spatial, self.theta_w**-spatial)
        parts = []
        for axis, (size, frequency) in enumerate(zip(sizes, frequencies, strict=True)):
            shape = [1, 1, 1, -1]
            shape[axis] = size
            angles = torch.outer(self.seq[:size].float(), frequency)
            parts.append(angles.view(shape).expand(*sizes, -1))
        half = torch.cat(parts, dim=-1).flatten(0, 2)
        angles = torch.cat([half, half], dim=-1)
        return angles.cos(), angles.sin()


def rotate(x: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Turn (batch, head, token, dim) by the angles of its tokens; the halves of a head are the two coordinates."""
    wide = x.float()
    first, second = wide.chunk(2, dim=-1)
    return (wide * cosine + torch.cat([-second, first], dim=-1) * sine).to(x.dtype)


class Attention(nn.Module):
    """Attention of tokens to tokens (`self`) or to text (`cross`), with normalised queries and keys."""

    def __init__(self, config: DitConfig, context_dim: int, site: str):
        super().__init__()
        width = config.width
        self.site = site
        self.head_dim = config.head_dim
        self.scale = config.head_dim**-0.5
        self.q_proj = nn.Linear(width, width, bias=False)
        self.q_norm = RMSNorm(config.head_dim)
        self.k_proj = nn.Linear(context_dim, width, bias=False)
        self.k_norm = RMSNorm(config.head_dim)
        self.v_proj = nn.Linear(context_dim, width, bias=False)
        self.output_proj = nn.Linear(width, width, bias=False)

    def forward(
        self,
        x: Tensor,
        text: Tensor | None,
        rotary: tuple[Tensor, Tensor] | None,
        layer: int,
        observer: BlockObserver | None,
        editor: BlockEditor | None,
    ) -> Tensor:
        """Return the update (batch, frame, token, width) of the tokens x, before the gate.

        text: (batch, position, text width), the keys of `cross`. rotary: positions, for `self`.
        """
        frames, tokens = x.shape[1:3]
        flat = x.flatten(1, 2)
        context = flat if text is None else text
        query = self.q_norm(split_heads(self.q_proj(flat), self.head_dim))
        key = self.k_norm(split_heads(self.k_proj(context), self.head_dim))
        value = split_heads(self.v_proj(context), self.head_dim)
        if rotary is not None:
            query, key = rotate(query, *rotary), rotate(key, *rotary)
        key = key.float()  # once, not for every frame of queries
        mixed = []
        for frame in range(frames):
            part = query[:, :, frame * tokens : (frame + 1) * tokens]
            sink = observer.rows(self.site, layer, frame, self, value) if observer is not None else None
            change = editor.change(self.site, layer, frame) if editor is not None else None
            mixed.append(attend(part, key, value, None, self.scale, change=change, rows_to=sink))
        update = self.output_proj(join_heads(torch.cat(mixed, dim=2)))
        return torch.unflatten(update, 1, (frames, tokens))


class FeedForward(nn.Module):
    """Two linear layers around an exact GELU."""

    def __init__(self, config: DitConfig):
        super().__init__()
        self.layer1 = nn.Linear(config.width, config.mlp_dim, bias=False)
        self.layer2 = nn.Linear(config.mlp_dim, config.width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Apply to the last axis."""
        update: Tensor = self.layer2(F.gelu(self.layer1(x)))
        return update


def modulation_layers(config: DitConfig, parts: int) -> nn.Sequential:
    """The low-rank layers that make shift, scale (and gate) of a time embedding."""
    return nn.Sequential(
        nn.SiLU(),
        nn.Linear(config.width, config.adaln_dim, bias=False),
        nn.Linear(config.adaln_dim, parts * config.width, bias=False),
    )


def modulate(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    """LayerNorm without weights, then scale and shift."""
    return F.layer_norm(x, x.shape[-1:], eps=NORM_EPS) * (1 + scale) + shift


class Block(nn.Module):
    """Self-attention, cross-attention and feed-forward, each modulated and gated by the time of its frame."""

    def __init__(self, config: DitConfig):
        super().__init__()
        self.self_attn = Attention(config, config.width, "self")
        self.cross_attn = Attention(config, config.text_dim, "cross")
        self.mlp = FeedForward(config)
        self.adaln_modulation_self_attn = modulation_layers(config, 3)
        self.adaln_modulation_cross_attn = modulation_layers(config, 3)
        self.adaln_modulation_mlp = modulation_layers(config, 3)

    def forward(
        self,
        x: Tensor,
        time: Tensor,
        shared_modulation: Tensor,
        text: Tensor,
        rotary: tuple[Tensor, Tensor],
        layer: int,
        observer: BlockObserver | None,
        editor: BlockEditor | None,
    ) -> Tensor:
        """Return the tokens (batch, frame, token, width) after the block; time, modulation: (batch, frame, ...)."""
        modulations = {
            "self": self.adaln_modulation_self_attn,
            "cross": self.adaln_modulation_cross_attn,
            "mlp": self.adaln_modulation_mlp,
        }
        block_input = x
        updates: dict[str, Tensor] = {}
        gates: dict[str, Tensor] = {}
        for name, layers in modulations.items():
            shift, scale, gate = (layers(time) + shared_modulation)[:, :, None].chunk(3, dim=-1)
            modulated = modulate(x, shift, scale)
            if name == "self":
                update = self.self_attn(modulated, None, rotary, layer, observer, editor)
            elif name == "cross":
                update = self.cross_attn(modulated, text, None, layer, observer, editor)
            else:
                update = self.mlp(modulated)
            gates[name], updates[name] = gate, gate * update
            x = x + updates[name]
        if observer is not None:
            observer.updates(layer, updates, gates, block_input)
        return x


class TimeSinusoid(nn.Module):
    """Cosines, then sines, of t times geometrically spaced frequencies."""

    def __init__(self, width: int):
        super().__init__()
        self.width = width

    def forward(self, times: Tensor) -> Tensor:
        """Return (..., width) float32 of times (...)."""
        half = self.width // 2
        exponents = torch.arange(half, dtype=torch.float32, device=times.device) / half
        angles = times.float()[..., None] * torch.exp(-torch.log(torch.tensor(10000.0)).to(times.device) * exponents)
        return torch.cat([angles.cos(), angles.sin()], dim=-1)


class TimeModulation(nn.Module):
    """The modulation that all blocks and sub-layers share."""

    def __init__(self, config: DitConfig):
        super().__init__()
        self.linear_1 = nn.Linear(config.width, config.width, bias=False)
        self.linear_2 = nn.Linear(config.width, 3 * config.width, bias=False)

    def forward(self, sinusoid: Tensor) -> Tensor:
        """Return shift, scale and gate, (..., 3 · width)."""
        modulation: Tensor = self.linear_2(F.silu(self.linear_1(sinusoid)))
        return modulation


class Patchify(nn.Module):
    """Cut latent frames into patches: (batch, channel, frame, row, column) to (batch, frame, token, feature)."""

    def __init__(self, patch_size: int):
        super().__init__()
        self.patch_size = patch_size

    def forward(self, x: Tensor) -> Tensor:
        """Return features ordered (channel, row in the patch, column in the patch), tokens row by row."""
        size = self.patch_size
        cut = torch.unflatten(torch.unflatten(x, 4, (-1, size)), 3, (-1, size))  # b c t (h p) (w q)
        return cut.permute(0, 2, 3, 5, 1, 4, 6).flatten(4).flatten(2, 3)


class PatchEmbedder(nn.Module):
    """Patches to tokens."""

    def __init__(self, config: DitConfig):
        super().__init__()
        features = (config.in_channels + 2) * config.patch_size**2
        self.proj = nn.Sequential(Patchify(config.patch_size), nn.Linear(features, config.width, bias=False))

    def forward(self, x: Tensor) -> Tensor:
        """Return the tokens (batch, frame, token, width)."""
        tokens: Tensor = self.proj(x)
        return tokens


class FinalLayer(nn.Module):
    """Tokens back to patches."""

    def __init__(self, config: DitConfig):
        super().__init__()
        self.linear = nn.Linear(config.width, config.patch_size**2 * config.out_channels, bias=False)
        self.adaln_modulation = modulation_layers(config, 2)

    def forward(self, x: Tensor, time: Tensor, shared_modulation: Tensor) -> Tensor:
        """Return the features of each token, ordered (row in the patch, column in the patch, channel)."""
        modulation = self.adaln_modulation(time)
        shift, scale = (modulation + shared_modulation[..., : modulation.shape[-1]])[:, :, None].chunk(2, dim=-1)
        features: Tensor = self.linear(modulate(x, shift, scale))
        return features


class Dit(nn.Module):
    """The diffusion transformer: noisy latent frames, their times and a text to the network's estimate."""

    def __init__(self, config: DitConfig):
        super().__init__()
        self.config = config
        self.x_embedder = PatchEmbedder(config)
        self.pos_embedder = RotaryPositions(config)
        self.t_embedder = nn.Sequential(TimeSinusoid(config.width), TimeModulation(config))
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.num_blocks))
        self.final_layer = FinalLayer(config)
        self.t_embedding_norm = RMSNorm(config.width)

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the weights."""
        return self.final_layer.linear.weight.dtype

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.final_layer.linear.weight.device

    def forward(
        self,
        latents: Tensor,
        times: Tensor,
        condition_mask: Tensor,
        padding_mask: Tensor,
        text: Tensor,
        observer: BlockObserver | None = None,
        editor: BlockEditor | None = None,
    ) -> Tensor:
        """Return the network's output (batch, channel, frame, row, column) in the model's dtype.

        Inputs are cast to the model's dtype, the times too: in bfloat16 the reference's network sees rounded times.

        Args:
            latents: (batch, channel, frame, row, column).
            times: (batch, frame), 0 for a given frame, else t = sigma / (1 + sigma); or (batch, 1), the same for all
                frames.
            condition_mask: (batch, 1, frame, row, column), 1 for a given frame.
            padding_mask: (batch, 1, pixel row, pixel column), resized to the latent's size.
            text: (batch, position, text width).
            observer: gets rows and updates; the output does not depend on it.
            editor: changes the attention.
        """
        frames, height, width = latents.shape[2:]
        rows, columns = self.config.grid(height, width)
        padding = F.interpolate(padding_mask.float(), size=(height, width), mode="nearest")
        padding = padding[:, :, None].expand(-1, -1, frames, -1, -1)
        given = torch.cat([latents.to(self.dtype), condition_mask.to(self.dtype), padding.to(self.dtype)], dim=1)
        x = self.x_embedder(given)
        sinusoid_layer, modulation_layer = self.t_embedder
        sinusoid = sinusoid_layer(times.to(self.dtype).expand(-1, frames)).to(self.dtype)
        shared_modulation = modulation_layer(sinusoid)
        time = self.t_embedding_norm(sinusoid)
        rotary = self.pos_embedder(frames, rows, columns)
        text = text.to(self.dtype)
        for layer, block in enumerate(self.blocks):
            if observer is not None:
                observer.begin_block(layer)
            x = block(x, time, shared_modulation, text, rotary, layer, observer, editor)
        features = self.final_layer(x, time, shared_modulation)
        size = self.config.patch_size
        cut = torch.unflatten(features, -1, (size, size, -1))
        patches = torch.unflatten(cut, 2, (rows, columns))  # b t i j p q c
        return patches.permute(0, 6, 1, 2, 4, 3, 5).flatten(5).flatten(3, 4)
