"""Small random policies of the real classes of LeRobot 0.4.4, 0.5 and 0.6.1. Install `stand_in_torchvision` first."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any
from unittest import mock

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import (
    ACTION,
    OBS_LANGUAGE_ATTENTION_MASK,
    OBS_LANGUAGE_TOKENS,
    OBS_STATE,
)

from tests.policies.word_tokenizer import INSTRUCTION, WORDS, WordTokenizer

IS_04, IS_06 = (version("lerobot").startswith(series) for series in ("0.4.", "0.6."))
CAMERAS = ("top", "wrist")
STATE_DIM, ACTION_DIM = 6, 4
#: Sizes that a builder is not given are those of the tests.
NONE: Mapping[str, int] = MappingProxyType({})


def features(height: int, width: int, cameras: tuple[str, ...] = CAMERAS) -> dict[str, Any]:
    """Return the features of a data set with these cameras, a state and actions, as arguments of a configuration."""
    pictures = {
        f"observation.images.{camera}": PolicyFeature(type=FeatureType.VISUAL, shape=(3, height, width))
        for camera in cameras
    }
    return {
        "input_features": {**pictures, OBS_STATE: PolicyFeature(type=FeatureType.STATE, shape=(STATE_DIM,))},
        "output_features": {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(ACTION_DIM,))},
        "device": "cpu",
    }


def environment_features() -> dict[str, Any]:
    """Return the same as an environment of LeRobot says it."""
    given = features(48, 64)
    return given["input_features"] | given["output_features"]


def observation(
    height: int,
    width: int,
    padding: int = 0,
    cameras: tuple[str, ...] = CAMERAS,
    batch: int = 1,
    seed: int = 3,
    instruction: str = INSTRUCTION,
) -> dict[str, torch.Tensor]:
    """Return a preprocessed observation: pictures in [0, 1], a state, the instruction's ids and then padding."""
    generator = torch.Generator().manual_seed(seed)
    words = WordTokenizer().encode(instruction)
    ids = torch.tensor([words + [0] * padding] * batch)
    pictures = {
        f"observation.images.{camera}": torch.rand(batch, 3, height, width, generator=generator) for camera in cameras
    }
    return {
        **pictures,
        OBS_STATE: torch.randn(batch, STATE_DIM, generator=generator),
        OBS_LANGUAGE_TOKENS: ids,
        OBS_LANGUAGE_ATTENTION_MASK: torch.arange(ids.shape[1]).expand(batch, -1) < len(words),
    }


def frames_of(observation: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the pictures of the first row by camera."""
    prefix = "observation.images."
    return {name.removeprefix(prefix): value[0] for name, value in observation.items() if name.startswith(prefix)}


def chunk_of(policy: Any, seed: int = 0) -> Any:
    """Return a function that makes one policy call, with the same noise every time."""

    def call(batch: dict[str, torch.Tensor]) -> torch.Tensor:
        torch.manual_seed(seed)
        return policy.predict_action_chunk(dict(batch))

    return call


def preprocessor_of(policy: Any) -> Any:
    """Return LeRobot's own preparation of an observation for a policy, without statistics."""
    from lerobot.policies.factory import make_pre_post_processors

    return make_pre_post_processors(policy.config)[0]


def small_smolvla(
    folder: Path, text_sizes: Mapping[str, int] = NONE, vision_sizes: Mapping[str, int] = NONE, **changes: Any
) -> Any:
    """A SmolVLAPolicy of four blocks; `folder` is where the configuration of its vision-language model is written.

    `text_sizes` and `vision_sizes` are of that model's configuration, `changes` of the policy's.
    """
    from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
    from transformers import SmolVLMConfig

    vlm = SmolVLMConfig(
        text_config={
            "model_type": "llama",
            **{"hidden_size": 48, "intermediate_size": 64, "num_hidden_layers": 4, "num_attention_heads": 3},
            **{"num_key_value_heads": 1, "head_dim": 16, "vocab_size": 100, "pad_token_id": 0},
            **text_sizes,
        },
        vision_config={
            **{"hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 2},
            **{"image_size": 64, "patch_size": 8},
            **vision_sizes,
        },
        scale_factor=2,
        image_token_id=98,
        pad_token_id=0,
    )
    vlm.save_pretrained(folder)
    processor = SimpleNamespace(tokenizer=SimpleNamespace(fake_image_token_id=96, global_image_token_id=97))
    settings: dict[str, Any] = {
        **features(48, 64),
        **{"chunk_size": 5, "n_action_steps": 5, "num_steps": 3, "resize_imgs_with_padding": (64, 64)},
        **{"vlm_model_name": str(folder), "load_vlm_weights": False, "num_vlm_layers": 4, "max_state_dim": 8},
        **{"max_action_dim": 8, "add_image_special_tokens": True, "tokenizer_max_length": 12},
    }
    torch.manual_seed(0)
    with mock.patch("transformers.AutoProcessor.from_pretrained", return_value=processor):
        return SmolVLAPolicy(SmolVLAConfig(**{**settings, **changes})).eval()


def small_xvla(**changes: Any) -> Any:
    """An XVLAPolicy of three blocks on a small Florence 2."""
    from lerobot.policies.xvla.configuration_xvla import XVLAConfig
    from lerobot.policies.xvla.modeling_xvla import XVLAPolicy

    vision = {
        **{"model_type": "davit", "dim_embed": [8, 8, 16, 16], "num_heads": [2, 2, 2, 2], "num_groups": [2, 2, 2, 2]},
        **{"depths": [1, 1, 1, 1], "window_size": 4, "projection_dim": 32},
        "visual_temporal_embedding": {"type": "COSINE", "max_temporal_embeddings": 10},
        "image_pos_embed": {"type": "learned_abs_2d", "max_pos_embeddings": 10},
        "image_feature_source": ["spatial_avg_pool", "temporal_avg_pool"],
    }
    text = {
        **{"vocab_size": 100, "d_model": 32, "encoder_layers": 2, "decoder_layers": 1, "encoder_attention_heads": 2},
        **{"decoder_attention_heads": 2, "encoder_ffn_dim": 48, "decoder_ffn_dim": 48, "max_position_embeddings": 64},
    }
    settings: dict[str, Any] = {
        **features(64, 64),
        **{"chunk_size": 5, "n_action_steps": 5, "num_denoising_steps": 3, "hidden_size": 32, "depth": 3},
        **{"num_heads": 4, "len_soft_prompts": 3, "num_domains": 2, "dim_time": 8, "max_len_seq": 96},
        **{"tokenizer_max_length": 12, "max_state_dim": 20, "num_image_views": 3, "action_mode": "ee6d"},
        "florence_config": {
            **{"vision_config": vision, "text_config": text, "vocab_size": 100, "projection_dim": 32},
            "pad_token_id": 1,
        },
    }
    torch.manual_seed(0)
    policy = XVLAPolicy(XVLAConfig(**{**settings, **changes})).eval()
    if hasattr(policy.model.vlm, "image_projection"):  # LeRobot 0.4 leaves it as the memory was
        torch.nn.init.normal_(policy.model.vlm.image_projection, std=0.2)
    return policy


def small_act(**changes: Any) -> Any:
    """An ACTPolicy of three decoder blocks, on the stand-in for torchvision's ResNet."""
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    settings: dict[str, Any] = {
        **features(64, 96),
        **{"chunk_size": 5, "n_action_steps": 5, "dim_model": 32, "n_heads": 4, "dim_feedforward": 48},
        **{"n_encoder_layers": 2, "n_decoder_layers": 3, "latent_dim": 8, "pretrained_backbone_weights": None},
    }
    torch.manual_seed(0)
    return ACTPolicy(ACTConfig(**{**settings, **changes})).eval()


class StandInBackbone(torch.nn.Module):
    """A mean over neighbours in the place of GR00T's vision-language model, whose class needs flash-attn."""

    def __init__(self, width: int = 24, image_token: int = 98) -> None:
        super().__init__()
        language = torch.nn.Module()
        language.model = torch.nn.Module()
        language.model.embed_tokens = torch.nn.Embedding(100, width)
        self.eagle_model = torch.nn.Module()
        self.eagle_model.language_model = language
        self.eagle_model.image_token_index = image_token
        self.patches = torch.nn.Linear(12, width)

    def prepare_input(self, batch: dict[str, Any]) -> Any:
        """Return the batch as the real class does."""
        from transformers.feature_extraction_utils import BatchFeature

        return BatchFeature(data=batch)

    def forward(self, batch: Any) -> Any:
        """Return features (batch, token, width), and which tokens are no padding."""
        from transformers.feature_extraction_utils import BatchFeature

        ids = batch["eagle_input_ids"]
        embedded = self.eagle_model.language_model.model.embed_tokens(ids)
        pictures = batch["eagle_pixel_values"].unfold(2, 2, 2).unfold(3, 2, 2)
        pieces = pictures.permute(0, 2, 3, 1, 4, 5).reshape(len(ids), -1, 12)
        embedded = embedded.masked_scatter((ids == self.eagle_model.image_token_index)[..., None], self.patches(pieces))
        return BatchFeature(
            data={"backbone_features": embedded, "backbone_attention_mask": batch["eagle_attention_mask"]}
        )


def small_groot(
    block_sizes: Mapping[str, int] = NONE,
    head_sizes: Mapping[str, int] = NONE,
    backbone: int = 24,
) -> Any:
    """LeRobot's GrootPolicy with the real action head of GR00T N1.5, on a stand-in for its vision-language model.

    `block_sizes` are of the head's transformer, `head_sizes` of the head around it; `backbone` is the stand-in's width.
    """
    from lerobot.policies.groot import groot_n1
    from lerobot.policies.groot.configuration_groot import GrootConfig
    from lerobot.policies.groot.modeling_groot import GrootPolicy

    blocks = {"num_attention_heads": 4, "attention_head_dim": 8, "dropout": 0.0, "final_dropout": True}
    head = {
        "diffusion_model_cfg": {
            **{**blocks, "num_layers": 4, "output_dim": 16, "norm_type": "ada_norm", "positional_embeddings": None},
            **{"interleave_self_attention": True, "cross_attention_dim": backbone, **block_sizes},
        },
        "vl_self_attention_cfg": {
            **{**blocks, "attention_head_dim": backbone // 4, "num_layers": 1, "positional_embeddings": None}
        },
        **{"input_embedding_dim": 32, "backbone_embedding_dim": backbone, "hidden_size": 16, "max_seq_len": 32},
        **{"action_dim": ACTION_DIM, "action_horizon": 5, "num_inference_timesteps": 3, "max_num_embodiments": 2},
        **{"num_target_vision_tokens": 2, "max_state_dim": STATE_DIM, **head_sizes},
    }
    horizon = head["action_horizon"]
    torch.manual_seed(0)
    with mock.patch.object(groot_n1, "EagleBackbone", return_value=StandInBackbone(backbone)):
        model = groot_n1.GR00TN15(
            groot_n1.GR00TN15Config(
                backbone_cfg={},
                action_head_cfg=head,
                action_horizon=horizon,
                action_dim=ACTION_DIM,
                compute_dtype="float32",
            ),
            local_model_path="",
        )
    settings: dict[str, Any] = {
        **features(8, 8),
        **{"use_bf16": False, "chunk_size": horizon, "n_action_steps": horizon, "max_state_dim": STATE_DIM},
        "max_action_dim": ACTION_DIM,
    }
    with mock.patch.object(GrootPolicy, "_create_groot_model", return_value=model):
        return GrootPolicy(GrootConfig(**settings)).eval()


def small_groot_n17(
    width: int, heads: int, dim: int, chunk: int, steps: int, image_token: int, blocks: int
) -> tuple[Any, Any]:
    """LeRobot 0.6's GR00TN17 on a small Qwen3-VL, and its call: of ids (1, token), or of ids and a state."""
    from lerobot.policies.groot import groot_n1_7 as module
    from transformers import Qwen3VLConfig

    text = {
        **{"hidden_size": width, "intermediate_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2},
        **{"num_key_value_heads": 1, "head_dim": 8, "vocab_size": 110, "max_position_embeddings": 64},
        "rope_parameters": {"rope_type": "default", "rope_theta": 1e4, "mrope_section": [2, 1, 1]},
    }
    vision = {
        **{"depth": 1, "hidden_size": 16, "intermediate_size": 24, "num_heads": 2, "out_hidden_size": width},
        **{"patch_size": 2, "spatial_merge_size": 2, "temporal_patch_size": 2, "num_position_embeddings": 16},
        "deepstack_visual_indexes": [0],
    }
    tokens = {"image_token_id": image_token, "video_token_id": 99, "vision_start_token_id": 15}
    vlm = Qwen3VLConfig(text_config=text, vision_config=vision, vision_end_token_id=97, **tokens)
    transformer = {"num_attention_heads": heads, "attention_head_dim": dim, "dropout": 0.0, "final_dropout": True}
    config = module.GR00TN17Config(
        **{"backbone_embedding_dim": width, "hidden_size": width, "input_embedding_dim": heads * dim},
        **{"action_horizon": chunk, "max_action_dim": 4, "max_state_dim": 6, "max_num_embodiments": 2},
        **{"num_inference_timesteps": steps, "select_layer": 2, "max_seq_len": 16},
        diffusion_model_cfg={
            **transformer,
            **{"num_layers": blocks, "output_dim": width, "interleave_self_attention": True},
            **{"norm_type": "ada_norm", "positional_embeddings": None},
        },
        vl_self_attention_cfg={**transformer, "num_layers": 1, "positional_embeddings": None},
    )
    torch.manual_seed(0)
    with mock.patch.object(module, "_cosmos_reason2_qwen3_vl_config", return_value=vlm):
        policy = module.GR00TN17(config, load_backbone_weights=False).float().eval()
    pictures = torch.rand(16, 3 * 2 * 2 * 2, generator=torch.Generator().manual_seed(1))

    def call(observation: Any) -> torch.Tensor:
        ids, state = observation if isinstance(observation, tuple) else (observation, torch.ones(1, 1, 6))
        torch.manual_seed(0)
        given = {"input_ids": ids, "attention_mask": torch.ones_like(ids), "pixel_values": pictures}
        given |= {"image_grid_thw": torch.tensor([[1, 4, 4]]), "state": state}
        return policy.get_action({**given, "embodiment_id": torch.zeros(1, dtype=torch.long)})["action_pred"]

    return policy, call


def groot_observation(patches: int = 4) -> dict[str, torch.Tensor]:
    """Return a preprocessed observation of two pictures, each a row of squares of two pixels, and the instruction."""
    picture = [98] * patches
    ids = torch.tensor([[15, *picture, 16, *picture, *WordTokenizer().encode(INSTRUCTION)]])
    generator = torch.Generator().manual_seed(1)
    return {
        "eagle_input_ids": ids,
        "eagle_attention_mask": torch.ones_like(ids),
        # The two pictures beneath each other.
        "eagle_pixel_values": torch.rand(1, 3, 2 * patches, 4, generator=generator),
        "state": torch.randn(1, 1, STATE_DIM, generator=generator),
        "embodiment_id": torch.zeros(1, dtype=torch.long),
    }


def small_evo1(folder: Path, **changes: Any) -> Any:
    """LeRobot 0.6's Evo1Policy of three blocks; a small InternVL 3 and Qwen 2's tokenizer are written into `folder`."""
    from lerobot.policies.evo1.configuration_evo1 import Evo1Config
    from lerobot.policies.evo1.modeling_evo1 import Evo1Policy
    from transformers import InternVLConfig, InternVLModel, Qwen2Tokenizer

    # Words are tokens, those of other sentences too.
    tokenizer = Qwen2Tokenizer().train_new_from_iterator([" ".join(("", *WORDS)), "\nput", "Image-1: "] * 2, 400)
    tokenizer.add_special_tokens({"additional_special_tokens": ["<img>", "<IMG_CONTEXT>", "</img>"]})
    tokenizer.save_pretrained(folder)
    text = {
        **{"model_type": "qwen2", "hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 3},
        **{"num_attention_heads": 2, "num_key_value_heads": 1, "vocab_size": len(tokenizer)},
    }
    vision = {
        **{"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2},
        **{"image_size": 16, "patch_size": 4},
    }
    placeholder = tokenizer.convert_tokens_to_ids("<IMG_CONTEXT>")
    torch.manual_seed(0)
    vlm = InternVLConfig(text_config=text, vision_config=vision, image_seq_length=4, image_token_id=placeholder)
    InternVLModel(vlm).save_pretrained(folder)
    settings: dict[str, Any] = {
        **features(24, 24),
        **{"vlm_model_name": str(folder), "vlm_num_layers": 2, "vlm_dtype": "float32", "image_resolution": (16, 16)},
        **{"max_text_length": 64, "embed_dim": 16, "hidden_dim": 24, "state_hidden_dim": 16, "num_heads": 2},
        **{
            "num_layers": 3,
            "num_inference_timesteps": 3,
            "chunk_size": 5,
            "n_action_steps": 5,
            "use_flash_attn": False,
        },
    }
    return Evo1Policy(Evo1Config(**{**settings, **changes})).eval()


def small_multi_task_dit(folder: Path, **changes: Any) -> Any:
    """LeRobot 0.6's MultiTaskDiTPolicy of three blocks; small CLIP encoders are written into `folder`."""
    from lerobot.policies.multi_task_dit.configuration_multi_task_dit import MultiTaskDiTConfig
    from lerobot.policies.multi_task_dit.modeling_multi_task_dit import MultiTaskDiTPolicy
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPVisionConfig, CLIPVisionModel

    sizes = {"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2}
    torch.manual_seed(0)
    CLIPTextModel(CLIPTextConfig(**sizes, vocab_size=100, eos_token_id=99)).save_pretrained(folder / "clip_text")
    CLIPVisionModel(CLIPVisionConfig(**sizes, image_size=16, patch_size=8)).save_pretrained(folder / "clip_vision")
    settings: dict[str, Any] = {
        **features(24, 24),
        **{"text_encoder_name": str(folder / "clip_text"), "vision_encoder_name": str(folder / "clip_vision")},
        **{"image_crop_shape": (16, 16), "horizon": 8, "n_action_steps": 4, "hidden_dim": 16, "num_layers": 3},
        **{"num_heads": 2, "timestep_embed_dim": 8, "num_inference_steps": 3, "num_integration_steps": 3},
    }
    policy = MultiTaskDiTPolicy(MultiTaskDiTConfig(**{**settings, **changes})).eval()
    for block in policy.noise_predictor.transformer_blocks:  # zero in a policy that was not trained
        torch.nn.init.normal_(block.adaLN_modulation[-1].weight, std=0.2)
    return policy


def small_vqbet(**changes: Any) -> Any:
    """A VQBeTPolicy of three blocks, three observations and two chunks, whose Residual VQ counts as trained."""
    from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
    from lerobot.policies.vqbet.modeling_vqbet import VQBeTPolicy

    settings: dict[str, Any] = {
        **features(64, 96, ("top",)),
        **{"n_obs_steps": 3, "n_action_pred_token": 2, "action_chunk_size": 5, "crop_shape": (48, 64)},
        **{"spatial_softmax_num_keypoints": 4, "vqvae_n_embed": 4, "vqvae_embedding_dim": 8, "vqvae_enc_hidden_dim": 8},
        **{"gpt_block_size": 32, "gpt_input_dim": 16, "gpt_output_dim": 16, "gpt_n_layer": 3, "gpt_n_head": 2},
        **{"gpt_hidden_dim": 16, "pretrained_backbone_weights": None},
    }
    torch.manual_seed(0)
    policy = VQBeTPolicy(VQBeTConfig(**{**settings, **changes})).eval()
    policy.vqbet.action_head.vqvae_model.discretized.fill_(True)
    for block in policy.vqbet.policy.transformer.h:
        torch.nn.init.normal_(block.attn.c_attn.weight, std=0.3)
    return policy
