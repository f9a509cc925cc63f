"""Sizes of the pi models, and the lengths of the key and query axes that follow from them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from vla_attention.capture.policies.checkpoints import Blocks, Size
from vla_attention.capture.policies.pi.flow_time import MAX_PERIOD, MIN_PERIOD, TimeConvention
from vla_attention.schemas.errors import BadArgument, look_up

#: openpi's camera slots, in the order of their keys. The preprocessing assigns cameras to slots.
CAMERA_SLOTS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")

#: Vocabulary of PaliGemma's tokenizer.
PALIGEMMA_VOCABULARY = 257_152


@dataclass(frozen=True)
class GemmaConfig:
    """Sizes of one Gemma transformer: the vision-language model or the action expert."""

    width: Size
    depth: Blocks
    mlp_dim: Size
    num_heads: Size = 8
    num_kv_heads: Size = 1
    head_dim: Size = 256


@dataclass(frozen=True)
class SiglipConfig:
    """Sizes of the image encoder; the defaults are So400m/14."""

    width: Size = 1152
    depth: Blocks = 27
    mlp_dim: Size = 4304
    num_heads: Size = 16
    patch_size: Size = 14
    image_size: Size = 224

    @property
    def grid(self) -> int:
        """Patches along one side of an image."""
        return self.image_size // self.patch_size

    @property
    def num_tokens(self) -> int:
        """Tokens of one camera."""
        return self.grid**2


GEMMA_VARIANTS: dict[str, GemmaConfig] = {
    "gemma_2b": GemmaConfig(width=2048, depth=18, mlp_dim=16_384),
    "gemma_300m": GemmaConfig(width=1024, depth=18, mlp_dim=4096),
    # openpi's own test size
    "dummy": GemmaConfig(width=64, depth=4, mlp_dim=128, head_dim=16),
    # the policy that comes with this package; depth and heads of the reference, so that its layer numbers exist
    "embedded": GemmaConfig(width=128, depth=18, mlp_dim=256, head_dim=32),
    "embedded_expert": GemmaConfig(width=96, depth=18, mlp_dim=192, head_dim=32),
}


def find_variant(name: str) -> GemmaConfig:
    """Return the sizes of a Gemma variant by openpi's name for it."""
    return look_up("Gemma variant", name, GEMMA_VARIANTS)


@dataclass(frozen=True)
class PiConfig:
    """Everything that determines the shapes of a pi0 (`pi05=False`) or pi0.5 model.

    discrete_state_input: the prompt contains the robot's state as digits; openpi's released LIBERO policy has False.
    float32_vision: in bfloat16 the image encoder and its projector stay in float32, as in LeRobot and not in openpi.
    """

    paligemma: GemmaConfig
    action_expert: GemmaConfig
    siglip: SiglipConfig
    action_horizon: int
    max_token_len: int
    vocab_size: int = PALIGEMMA_VOCABULARY
    action_dim: int = 32
    pi05: bool = True
    discrete_state_input: bool = False
    num_denoise_steps: int = 10
    cameras: tuple[str, ...] = CAMERA_SLOTS
    time_convention: TimeConvention = "accumulated"
    min_period: float = MIN_PERIOD
    max_period: float = MAX_PERIOD
    float32_vision: bool = False

    def __post_init__(self) -> None:
        vlm, expert = self.paligemma, self.action_expert
        for name in ("depth", "num_heads", "num_kv_heads", "head_dim"):
            if getattr(vlm, name) != getattr(expert, name):
                raise BadArgument(
                    f"The two transformers share their attention, so {name} must be equal, but it is "
                    f"{getattr(vlm, name)} in the vision-language model and {getattr(expert, name)} in the expert."
                )
        if self.siglip.image_size % self.siglip.patch_size:
            raise BadArgument(
                f"An image of {self.siglip.image_size} pixels is not a whole number of {self.siglip.patch_size} "
                "pixel patches."
            )

    @property
    def prefix_len(self) -> int:
        """Keys of images and text."""
        return len(self.cameras) * self.siglip.num_tokens + self.max_token_len

    @property
    def first_action_query(self) -> int:
        """Position of the first action on the query axis: pi0 has the state token before it."""
        return 0 if self.pi05 else 1

    @property
    def suffix_len(self) -> int:
        """Queries of a denoise step: [state token, pi0 only] and the actions."""
        return self.first_action_query + self.action_horizon


_PI05_LIBERO = PiConfig(
    paligemma=GEMMA_VARIANTS["gemma_2b"],
    action_expert=GEMMA_VARIANTS["gemma_300m"],
    siglip=SiglipConfig(),
    action_horizon=10,
    max_token_len=200,
)
_PI0_LIBERO = dataclasses.replace(_PI05_LIBERO, action_horizon=50, max_token_len=48, pi05=False)
#: Full-size models by openpi's names for its configurations of LIBERO and DROID.
NAMED_CONFIGS: dict[str, PiConfig] = {
    "pi05_libero": _PI05_LIBERO,
    "pi0_libero": _PI0_LIBERO,
    # The robot of DROID. pi05_droid reads its state in the prompt, which pi05_libero does not.
    "pi05_droid": dataclasses.replace(_PI05_LIBERO, action_horizon=15, discrete_state_input=True),
    "pi0_droid": dataclasses.replace(_PI0_LIBERO, action_horizon=10),
    # The same model; its LoRA arrays are merged when a checkpoint is read.
    "pi0_libero_low_mem_finetune": _PI0_LIBERO,
}


def find_config(name: str) -> PiConfig:
    """Return a full-size model configuration by openpi's name for it."""
    return look_up("pi configuration", name, NAMED_CONFIGS)
