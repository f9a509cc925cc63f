"""From pictures to latent frames: the encoder of the Wan2.1 video VAE, with diffusers' code.

The VAE is causal in time: a latent frame does not depend on later pixel frames. So only the first 13 of the 33 pixel
frames that the reference encodes are computed (blank, the place of proprioception, wrist, primary). The first five of
them are always black, and the state of the causal convolutions after them is computed once.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from typing import Any

import torch
from torch import Tensor, nn

from vla_attention.capture.policies.checkpoints import check_size
from vla_attention.capture.policies.cosmos.config import VaeConfig
from vla_attention.capture.policies.weights import Shapes, check_shapes, fill, make_empty, shapes_of
from vla_attention.schemas.errors import MissingDependency
from vla_attention.schemas.install_line import install_line

#: Pixel frames of every latent frame but the first, which has one.
FRAMES_PER_LATENT = 4
BLACK = -1.0


def _build_wan(config: VaeConfig) -> Any:
    """Return diffusers' AutoencoderKLWan, which has no types for mypy."""
    try:
        library = import_module("diffusers.models.autoencoders.autoencoder_kl_wan")
    except ImportError as error:
        raise MissingDependency(
            f"Cosmos policies need diffusers for their image encoder ({error}); install it with "
            f"`{install_line('cosmos')}`."
        ) from error
    return library.AutoencoderKLWan(
        base_dim=config.base_dim,
        z_dim=config.latent_channels,
        dim_mult=list(config.dim_mult),
        num_res_blocks=config.num_res_blocks,
        temperal_downsample=list(config.temporal_downsample),
    )


_RESNET = {
    "norm1.": "residual.0.",
    "conv1.": "residual.2.",
    "norm2.": "residual.3.",
    "conv2.": "residual.6.",
    "conv_shortcut.": "shortcut.",
}
_FIXED = {
    "quant_conv.": "conv1.",
    "post_quant_conv.": "conv2.",
    "encoder.conv_in.": "encoder.conv1.",
    "encoder.norm_out.": "encoder.head.0.",
    "encoder.conv_out.": "encoder.head.2.",
    "decoder.conv_in.": "decoder.conv1.",
    "decoder.norm_out.": "decoder.head.0.",
    "decoder.conv_out.": "decoder.head.2.",
}


def original_name(name: str, num_res_blocks: int = 2) -> str:
    """Return the published checkpoint's name of a tensor that diffusers calls `name`."""
    for ours, theirs in _FIXED.items():
        if name.startswith(ours):
            return theirs + name.removeprefix(ours)
    name = re.sub(r"mid_block\.attentions\.0\.", "middle.1.", name)
    name = re.sub(r"mid_block\.resnets\.(\d)\.", lambda found: f"middle.{2 * int(found[1])}.", name)
    name = re.sub(r"encoder\.down_blocks\.(\d+)\.", r"encoder.downsamples.\1.", name)
    # diffusers groups a level's blocks with its upsampler; the checkpoint counts them all in one list.
    level = num_res_blocks + 2

    def resnet(found: re.Match[str]) -> str:
        return f"decoder.upsamples.{level * int(found[1]) + int(found[2])}."

    name = re.sub(r"decoder\.up_blocks\.(\d+)\.resnets\.(\d+)\.", resnet, name)
    name = re.sub(
        r"decoder\.up_blocks\.(\d+)\.upsamplers\.0\.",
        lambda found: f"decoder.upsamples.{level * int(found[1]) + level - 1}.",
        name,
    )
    for ours, theirs in _RESNET.items():
        name = name.replace("." + ours, "." + theirs)
    return name


def vae_names(config: VaeConfig) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return published name -> (diffusers' name, shape) of every tensor, decoder included, without allocating any."""
    state = make_empty(lambda: _build_wan(config)).state_dict()
    return {original_name(name, config.num_res_blocks): (name, tuple(tensor.shape)) for name, tensor in state.items()}


def expected_vae_shapes(config: VaeConfig) -> Shapes:
    """Return the published checkpoint's names and shapes for a VAE of these sizes."""
    return {name: shape for name, (_, shape) in vae_names(config).items()}


def infer_vae_config(state: Mapping[str, Any], base: VaeConfig) -> VaeConfig:
    """Return the sizes of a stored VAE: its own base width, and the rest from `base`, which loading then checks."""
    first = state.get("encoder.conv1.weight")
    if not isinstance(first, Tensor):
        return base
    size = check_size("The width of the image encoder's first layer", first.shape[0] if first.ndim else 0)
    return replace(base, base_dim=size)


class CausalEncoder(nn.Module):
    """The encoder half of the VAE, from pictures to normalised latent frames."""

    mean: Tensor
    std: Tensor

    def __init__(self, wan: Any):
        super().__init__()
        self.encoder = wan.encoder
        self.quant_conv = wan.quant_conv
        for name in ("mean", "std"):
            published = torch.tensor(wan.config[f"latents_{name}"], dtype=torch.float32).view(1, -1, 1, 1, 1)
            self.register_buffer(name, published, persistent=False)
        self._black_size: tuple[int, int] | None = None
        self._black_latents: list[Tensor] = []
        self._black_cache: list[Tensor | None] = []

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the weights."""
        dtype: torch.dtype = self.encoder.conv_in.weight.dtype
        return dtype

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        device: torch.device = self.encoder.conv_in.weight.device
        return device

    def _encode_chunk(self, frames: Tensor, cache: list[Tensor | None]) -> Tensor:
        """Encode the pixel frames of one latent frame; `cache`: state of the causal convolutions, read and updated."""
        moments = self.quant_conv(self.encoder(frames, feat_cache=cache, feat_idx=[0]))
        mean = moments.chunk(2, dim=1)[0]
        # The moments have the precision of the weights, and so have the reference's constants.
        normalised: Tensor = (mean - self.mean.to(mean.dtype)) / self.std.to(mean.dtype)
        return normalised.float()

    def _after_black(self, height: int, width: int) -> tuple[list[Tensor], list[Tensor | None]]:
        """The two latents of the five black frames, and the state of the convolutions after them."""
        if self._black_size != (height, width):
            cache: list[Tensor | None] = [None] * sum(1 for _ in self.encoder.modules())
            latents = []
            for count in (1, FRAMES_PER_LATENT):
                black = torch.full((1, 3, count, height, width), BLACK, dtype=self.dtype, device=self.device)
                latents.append(self._encode_chunk(black, cache))
            self._black_size, self._black_latents, self._black_cache = (height, width), latents, cache
        return self._black_latents, list(self._black_cache)

    @torch.no_grad()
    def encode(self, pictures: list[Tensor]) -> Tensor:
        """Return (1, channel, 2 + pictures, row, column) float32: blank, place of proprioception, then the pictures.

        Each picture is (1, 3, 1, height, width) in -1..1, and is repeated for four pixel frames.
        """
        height, width = pictures[0].shape[-2:]
        black, cache = self._after_black(height, width)
        # In this order, because the convolutions of a picture continue from the cache of the picture before it.
        shown = [self._encode_chunk(picture.expand(-1, -1, FRAMES_PER_LATENT, -1, -1), cache) for picture in pictures]
        return torch.cat([*black, *shown], dim=2)


def build_encoder(
    config: VaeConfig,
    state: Mapping[str, Any],
    *,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> CausalEncoder:
    """Build the encoder from a VAE's tensors by their published names, strictly (the decoder's too)."""
    names = vae_names(config)
    tensors = {name: value for name, value in state.items() if isinstance(value, Tensor)}
    check_shapes(shapes_of(tensors), {name: shape for name, (_, shape) in names.items()}, "the image encoder")
    filled = {names[name][0]: tensor.to(device=device, dtype=dtype) for name, tensor in tensors.items()}
    wan = fill(make_empty(lambda: _build_wan(config)), filled)
    return CausalEncoder(wan).eval().to(device)
