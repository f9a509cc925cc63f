"""Small random pi0, pi0.5 and pi0-FAST of LeRobot 0.4.4 and 0.6.1: copies of openpi's PyTorch code."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest import mock

import torch

from tests.policies.lerobot_models import IS_04, NONE, features


@contextmanager
def own_transformers() -> Iterator[None]:
    """Answer the check of LeRobot 0.4 for a transformers of its own; 0.6 has none."""
    if not IS_04:
        yield
        return
    check = ModuleType("transformers.models.siglip.check")
    check.check_whether_transformers_replace_is_installed_correctly = lambda: True  # type: ignore[attr-defined]
    with (
        mock.patch.dict(sys.modules, {"transformers.models.siglip.check": check}),
        mock.patch("transformers.models.siglip.check", check, create=True),
    ):
        yield


def small_pi0_fast(sizes: Mapping[str, int] = NONE, picture: int = 56, **changes: Any) -> Any:
    """A PI0FastPolicy of three blocks. The check for LeRobot's own transformers is answered, its tokenizers are none.

    The class fixes sizes that a small model cannot have: its configuration and its projector are made smaller here.
    `sizes` are of its language model, `changes` of the policy's configuration; `picture` is a side in pixels.
    """
    from lerobot.policies.pi0_fast import modeling_pi0_fast as module
    from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig
    from transformers import PaliGemmaConfig

    def configuration() -> Any:
        vision = {
            **{"model_type": "siglip_vision_model", "hidden_size": 32, "intermediate_size": 48},
            **{"num_hidden_layers": 2, "num_attention_heads": 2, "image_size": picture, "patch_size": 14},
            "vision_use_head": False,
        }
        return PaliGemmaConfig(vision_config=vision, text_config={"model_type": "gemma"}, projection_dim=width)

    language = {
        **{"width": 32, "depth": 3, "mlp_dim": 48, "num_heads": 4, "num_kv_heads": 1, "head_dim": 8},
        **sizes,
    }
    width = language["width"]
    settings: dict[str, Any] = {
        **features(picture, picture),
        **{"n_action_steps": 3, "chunk_size": 3, "max_decoding_steps": 5, "tokenizer_max_length": 9},
        **{"image_resolution": (picture, picture)},
    }
    tokenizer = SimpleNamespace(bos_token_id=2, convert_tokens_to_ids=lambda token: 2)
    torch.manual_seed(0)
    with (
        own_transformers(),
        mock.patch.object(module, "CONFIG_MAPPING", {"paligemma": configuration}),
        mock.patch.object(module, "get_gemma_config", return_value=module.GemmaConfig(**language)),
        mock.patch("transformers.AutoProcessor.from_pretrained", return_value=tokenizer),
        mock.patch("transformers.AutoTokenizer.from_pretrained", return_value=tokenizer),
    ):
        policy = module.PI0FastPolicy(PI0FastConfig(**{**settings, **changes}))
    policy.model.paligemma_with_expert.paligemma.model.multi_modal_projector.linear = torch.nn.Linear(32, width)
    # The tokens themselves, as actions: what turns them into actions is another network's tokenizer.
    policy.detokenize_actions = lambda tokens, action_horizon, action_dim: tokens[:, :action_horizon, None].float()
    return policy.eval()


def small_pi0_lerobot(**changes: Any) -> Any:
    """LeRobot's PI0Policy, whose network is a copy of openpi's PyTorch pi0, of three blocks.

    Its transformers leaves the cache of the prefix alone where none is to be kept; the plain one appends to it: each
    denoise step gets a copy here.
    """
    from copy import deepcopy

    from lerobot.policies.pi0 import modeling_pi0 as module
    from lerobot.policies.pi0.configuration_pi0 import PI0Config
    from transformers import GemmaConfig, PaliGemmaConfig

    def configuration() -> Any:
        vision = {
            **{"model_type": "siglip_vision_model", "hidden_size": 32, "intermediate_size": 48},
            **{"num_hidden_layers": 2, "num_attention_heads": 2, "image_size": 56, "patch_size": 14},
            "vision_use_head": False,
        }
        return PaliGemmaConfig(vision_config=vision, text_config={"model_type": "gemma"}, projection_dim=32)

    sizes = module.GemmaConfig(width=32, depth=3, mlp_dim=48, num_heads=4, num_kv_heads=1, head_dim=8)
    settings: dict[str, Any] = {
        **features(56, 56),
        **{"n_action_steps": 5, "chunk_size": 5, "num_inference_steps": 3, "tokenizer_max_length": 9},
        **{"image_resolution": (56, 56), "max_state_dim": 8, "max_action_dim": 8},
    }
    torch.manual_seed(0)
    with (
        own_transformers(),
        mock.patch.object(module, "CONFIG_MAPPING", {"paligemma": configuration, "gemma": GemmaConfig}),
        mock.patch.object(module, "get_gemma_config", return_value=sizes),
    ):
        policy = module.PI0Policy(PI0Config(**{**settings, **changes}))
    policy.model.paligemma_with_expert.paligemma.model.multi_modal_projector.linear = torch.nn.Linear(32, 32)
    own = policy.model.denoise_step
    policy.model.denoise_step = lambda past_key_values, **given: own(past_key_values=deepcopy(past_key_values), **given)
    return policy.eval()


class AdaptiveNorm(torch.nn.Module):
    """The norm of openpi's transformers: scale, shift and a gate from the condition."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.dense = torch.nn.Linear(width, 3 * width)

    def forward(self, x: torch.Tensor, condition: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the normed x (batch, token, width) and the gate (batch, 1, width)."""
        normed = x * torch.rsqrt(x.square().mean(-1, keepdim=True) + 1e-6)
        scale, shift, gate = self.dense(condition)[:, None].chunk(3, dim=-1)
        return normed * (1 + scale) + shift, gate


class FinalNorm(AdaptiveNorm):
    """The same after the last layer, which leaves the condition here."""

    condition: torch.Tensor

    def forward(self, x: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        """Return the normed x."""
        return super().forward(x, self.condition)[0]


def small_pi05_lerobot(config: Any, state: Mapping[str, torch.Tensor]) -> Any:
    """LeRobot's PI05Pytorch with the sizes and weights of a `PiModel`; cameras: those of `config`.

    The transformers of 0.4 has other Gemma layers: adaptive norms, `_gated_residual`, no factor before the first layer.
    They are put in here, written after openpi's transformers_replace/models/gemma/modeling_gemma.py. 0.6 has its own.
    """
    from copy import deepcopy

    from lerobot.policies.pi05 import modeling_pi05 as module
    from lerobot.policies.pi05.configuration_pi05 import PI05Config
    from transformers import GemmaConfig, PaliGemmaConfig
    from transformers.models.gemma.modeling_gemma import GemmaDecoderLayer

    class Layer(GemmaDecoderLayer):
        def forward(self, hidden_states: Any, *, adarms_cond: Any, **given: Any) -> Any:
            residual = hidden_states
            hidden_states, gate = self.input_layernorm(hidden_states, adarms_cond)
            hidden_states, _ = self.self_attn(hidden_states=hidden_states, **given)
            residual = hidden_states = residual + hidden_states * gate
            hidden_states, gate = self.post_attention_layernorm(hidden_states, adarms_cond)
            final.condition = adarms_cond
            return residual + self.mlp(hidden_states) * gate

    vision, width = config.siglip, config.action_expert.width

    def configuration() -> Any:
        sizes = {
            **{"model_type": "siglip_vision_model", "hidden_size": vision.width, "intermediate_size": vision.mlp_dim},
            **{"num_hidden_layers": vision.depth, "num_attention_heads": vision.num_heads, "vision_use_head": False},
            **{"image_size": vision.image_size, "patch_size": vision.patch_size},
        }
        text = {"model_type": "gemma"}
        return PaliGemmaConfig(vision_config=sizes, text_config=text, projection_dim=config.paligemma.width)

    def sizes_of(part: Any) -> Any:
        return module.GemmaConfig(
            part.width, part.depth, part.mlp_dim, part.num_heads, part.num_kv_heads, part.head_dim
        )

    settings = PI05Config(
        **features(vision.image_size, vision.image_size, config.cameras),
        n_action_steps=config.action_horizon,
        chunk_size=config.action_horizon,
        num_inference_steps=config.num_denoise_steps,
        tokenizer_max_length=config.max_token_len,
        image_resolution=(vision.image_size, vision.image_size),
        max_action_dim=config.action_dim,
    )
    with (
        own_transformers(),
        mock.patch.object(module, "CONFIG_MAPPING", {"paligemma": configuration, "gemma": GemmaConfig}),
        mock.patch.object(
            module, "get_gemma_config", side_effect=[sizes_of(config.paligemma), sizes_of(config.action_expert)]
        ),
    ):
        policy = module.PI05Pytorch(settings)
    networks = policy.paligemma_with_expert
    inner, expert = networks.paligemma.model, networks.gemma_expert.model
    inner.multi_modal_projector.linear = torch.nn.Linear(vision.width, config.paligemma.width)
    if IS_04:
        final = expert.norm = FinalNorm(width)
        for layer in expert.layers:
            layer.__class__ = Layer
            layer.input_layernorm, layer.post_attention_layernorm = AdaptiveNorm(width), AdaptiveNorm(width)
        # The factors on embeddings and picture features, which openpi's transformers leaves out.
        for part in (inner.language_model.config, inner.config.text_config, expert.config):
            part.hidden_size = 1
    own = policy.denoise_step
    policy.denoise_step = lambda past_key_values, **given: own(past_key_values=deepcopy(past_key_values), **given)
    names = dict(policy.named_parameters())
    for name, values in state.items():
        names[name].data = values.clone()
    left = set(names) - set(state)
    assert all("lm_head" in name for name in left), left
    return policy.eval()
