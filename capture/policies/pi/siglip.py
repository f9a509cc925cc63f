"""SigLIP, the image encoder of PaliGemma: one token per patch of an image.

Module names are those of openpi's PyTorch checkpoints. Architecture: Zhai et al. 2023 (SigLIP), So400m/14 shape,
without class token and pooling.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla_attention.capture.policies.pi.config import SiglipConfig
from vla_attention.capture.recording.attention import attend_unseen, join_heads, split_heads

LAYER_NORM_EPS = 1e-6


class PatchEmbeddings(nn.Module):
    """Cut an image into patches, project them and add learned positions."""

    def __init__(self, config: SiglipConfig):
        super().__init__()
        self.patch_embedding = nn.Conv2d(3, config.width, config.patch_size, stride=config.patch_size)
        self.position_embedding = nn.Embedding(config.num_tokens, config.width)

    def forward(self, images: Tensor) -> Tensor:
        """Map (image, 3, height, width) float32 to (image, patch, width), patches row by row from the top left."""
        weight, bias = self.patch_embedding.weight, self.patch_embedding.bias
        size = weight.shape[-1]
        pixels = torch.unflatten(torch.unflatten(images, 3, (-1, size)), 2, (-1, size))
        # (image, 3, row, y, column, x) -> (image, row · column, 3 · y · x): patches do not overlap, so the convolution
        # is one matrix product. Convolutions on a GPU are rounded to TF32 unless a global switch says otherwise.
        patches = pixels.permute(0, 2, 4, 1, 3, 5).flatten(3).flatten(1, 2)
        return F.linear(patches.to(weight.dtype), weight.flatten(1), bias) + self.position_embedding.weight


class SiglipAttention(nn.Module):
    """Full self-attention over the patches of one image, with biases."""

    def __init__(self, config: SiglipConfig):
        super().__init__()
        self.head_dim = config.width // config.num_heads
        self.scale = self.head_dim**-0.5
        self.q_proj = nn.Linear(config.width, config.width)
        self.k_proj = nn.Linear(config.width, config.width)
        self.v_proj = nn.Linear(config.width, config.width)
        self.out_proj = nn.Linear(config.width, config.width)

    def forward(self, x: Tensor) -> Tensor:
        """Map (image, patch, width) to the same shape."""
        query, key, value = (split_heads(layer(x), self.head_dim) for layer in (self.q_proj, self.k_proj, self.v_proj))
        update: Tensor = self.out_proj(join_heads(attend_unseen(query, key, value, None, self.scale)))
        return update


class SiglipMlp(nn.Module):
    """Two dense layers with tanh-GELU between them."""

    def __init__(self, config: SiglipConfig):
        super().__init__()
        self.fc1 = nn.Linear(config.width, config.mlp_dim)
        self.fc2 = nn.Linear(config.mlp_dim, config.width)

    def forward(self, x: Tensor) -> Tensor:
        """Map (image, patch, width) to the same shape."""
        update: Tensor = self.fc2(F.gelu(self.fc1(x), approximate="tanh"))
        return update


class SiglipBlock(nn.Module):
    """A pre-norm transformer block."""

    def __init__(self, config: SiglipConfig):
        super().__init__()
        self.layer_norm1 = nn.LayerNorm(config.width, eps=LAYER_NORM_EPS)
        self.self_attn = SiglipAttention(config)
        self.layer_norm2 = nn.LayerNorm(config.width, eps=LAYER_NORM_EPS)
        self.mlp = SiglipMlp(config)

    def forward(self, x: Tensor) -> Tensor:
        """Map (image, patch, width) to the same shape."""
        attended: Tensor = x + self.self_attn(self.layer_norm1(x))
        updated: Tensor = attended + self.mlp(self.layer_norm2(attended))
        return updated


class SiglipEncoder(nn.Module):
    """The stack of blocks."""

    def __init__(self, config: SiglipConfig):
        super().__init__()
        self.layers = nn.ModuleList(SiglipBlock(config) for _ in range(config.depth))

    def forward(self, x: Tensor) -> Tensor:
        """Map (image, patch, width) to the same shape."""
        for layer in self.layers:
            x = layer(x)
        return x


class SiglipVisionModel(nn.Module):
    """Patches, blocks and a last norm. Patches and positions are always float32, as in the reference."""

    def __init__(self, config: SiglipConfig):
        super().__init__()
        self.embeddings = PatchEmbeddings(config)
        self.encoder = SiglipEncoder(config)
        self.post_layernorm = nn.LayerNorm(config.width, eps=LAYER_NORM_EPS)

    def forward(self, images: Tensor) -> Tensor:
        """Map (image, 3, height, width) in [-1, 1] to (image, patch, width)."""
        patches = self.embeddings(images)
        encoded: Tensor = self.post_layernorm(self.encoder(patches.to(self.post_layernorm.weight.dtype)))
        return encoded


class VisionTower(nn.Module):
    """The level that checkpoints call `vision_tower`."""

    def __init__(self, config: SiglipConfig):
        super().__init__()
        self.vision_model = SiglipVisionModel(config)

    def forward(self, images: Tensor) -> Tensor:
        """Map (image, 3, height, width) in [-1, 1] to (image, patch, width)."""
        encoded: Tensor = self.vision_model(images)
        return encoded


class Projector(nn.Module):
    """One dense layer from the image encoder's width to the language model's."""

    def __init__(self, vision_width: int, text_width: int):
        super().__init__()
        self.linear = nn.Linear(vision_width, text_width)

    def forward(self, x: Tensor) -> Tensor:
        """Map (image, patch, vision width) to (image, patch, text width)."""
        projected: Tensor = self.linear(x)
        return projected
