"""SigLIP, the image encoder of PaliGemma: patches of one image to as many tokens.

Module names are those of openpi's PyTorch checkpoints. Architecture: Zhai et al. 2023 (SigLIP), So400m/14 shape, without
class token and pooling.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from vla_attention.capture.policies.pi.config import SiglipConfig
from vla_attention.capture.recording.attention import attend

LAYER_NORM_EPS = 1e-6


class PatchEmbeddings(nn.Module):
    """Cut an image into patches, project them and add a learned position each."""

    def __init__(self, config: SiglipConfig):
        super().__init__()
        self.patch_embedding = nn.Conv2d(3, config.width, config.patch_size, stride=config.patch_size)
        self.position_embedding = nn.Embedding(config.num_tokens, config.width)

    def forward(self, images: Tensor) -> Tensor:
        """Map (image, 3, height, width) float32 to (image, patch, width), patches row by row from the top left."""
        weight, bias = self.patch_embedding.weight, self.patch_embedding.bias
        size = weight.shape[-1]
        pixels = images.unflatten(3, (-1, size)).unflatten(2, (-1, size))
        # (image, 3, row, y, column, x) -> (image, row · column, 3 · y · x): patches do not overlap, so the convolution is
        # one matrix product. Convolutions on a GPU are rounded to TF32 unless a global switch says otherwise.
        patches = pixels.permute(0, 2, 4, 1, 3, 5).flatten(3).flatten(1, 2)
        return F.linear(patches.to(weight.dtype), weight.flatten(1), bias) + self.position_embedding.weight


class SiglipAttention(nn.Module):
    """Full self-attention over the patches of one image, with biases."""

    def __init__(self, config: SiglipConfig):
        super().__init__()
        self.num_heads = config.num_heads
        self.scale = (config.width // config.num_heads) ** -0.5
        self.q_proj = nn.Linear(config.width, config.width)
        self.k_proj = nn.Linear(config.width, config.width)
        self.v_proj = nn.Linear(config.width, config.width)
        self.out_proj = nn.Linear(config.width, config.width)

    def _heads(self, x: Tensor) -> Tensor:
        """Split (image, patch, width) into (image, head, patch, dim)."""
        return x.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)

    def forward(self, x: Tensor) -> Tensor:
        """Map (image, patch, width) to the same shape."""
        query, key, value = self._heads(self.q_proj(x)), self._heads(self.k_proj(x)), self._heads(self.v_proj(x))
        mixed = attend(query, key, value, None, self.scale)
        return self.out_proj(mixed.transpose(1, 2).flatten(2))


class SiglipMlp(nn.Module):
    """Two dense layers with tanh-GELU between them."""

    def __init__(self, config: SiglipConfig):
        super().__init__()
        self.fc1 = nn.Linear(config.width, config.mlp_dim)
        self.fc2 = nn.Linear(config.mlp_dim, config.width)

    def forward(self, x: Tensor) -> Tensor:
        """Map (image, patch, width) to the same shape."""
        return self.fc2(F.gelu(self.fc1(x), approximate="tanh"))


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
        x = x + self.self_attn(self.layer_norm1(x))
        return x + self.mlp(self.layer_norm2(x))


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
    """Patches, blocks and a last norm. Patches and positions stay in float32 in every precision, as in the reference."""

    def __init__(self, config: SiglipConfig):
        super().__init__()
        self.embeddings = PatchEmbeddings(config)
        self.encoder = SiglipEncoder(config)
        self.post_layernorm = nn.LayerNorm(config.width, eps=LAYER_NORM_EPS)

    def forward(self, images: Tensor) -> Tensor:
        """Map (image, 3, height, width) in [-1, 1] to (image, patch, width)."""
        patches = self.embeddings(images)
        return self.post_layernorm(self.encoder(patches.to(self.post_layernorm.weight.dtype)))


class VisionTower(nn.Module):
    """The level that checkpoints call `vision_tower`."""

    def __init__(self, config: SiglipConfig):
        super().__init__()
        self.vision_model = SiglipVisionModel(config)

    def forward(self, images: Tensor) -> Tensor:
        """Map (image, 3, height, width) in [-1, 1] to (image, patch, width)."""
        return self.vision_model(images)


class Projector(nn.Module):
    """One dense layer from the image encoder's width to the language model's."""

    def __init__(self, vision_width: int, text_width: int):
        super().__init__()
        self.linear = nn.Linear(vision_width, text_width)

    def forward(self, x: Tensor) -> Tensor:
        """Map (image, patch, vision width) to (image, patch, text width)."""
        return self.linear(x)
