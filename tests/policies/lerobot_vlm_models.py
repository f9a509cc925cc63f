"""Small random policies of LeRobot 0.6's real classes whose words and pictures are read by a large model's class."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import torch

from tests.policies.lerobot_models import (
    ACTION_DIM,
    STATE_DIM,
    chunk_of,
    features,
    frames_of,
    observation,
    preprocessor_of,
)
from tests.policies.policy_checks import PolicyCase
from tests.policies.word_tokenizer import INSTRUCTION, WORDS, WordTokenizer
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout


def case_of(policy: Any, layout_of: Callable[[Any], PolicyLayout], height: int = 24, width: int = 32) -> PolicyCase:
    """A policy that is called through LeRobot's own processor. layout_of: a processed batch -> the layout."""
    given, before = {**observation(height, width), "task": [INSTRUCTION]}, preprocessor_of(policy)
    chunk = chunk_of(policy)
    return PolicyCase(
        policy,
        layout_of(before(dict(given))),
        lambda batch: chunk(before(dict(batch))),
        given,
        frames_of(given),
        given["observation.state"],
    )


def small_molmoact2(folder: Path, **changes: Any) -> Any:
    """LeRobot 0.6's MolmoAct2Policy of three blocks; a small checkpoint with its processor is written into `folder`."""
    from lerobot.policies.molmoact2.configuration_molmoact2 import MolmoAct2Config
    from lerobot.policies.molmoact2.modeling_molmoact2 import MolmoAct2Policy
    from lerobot.policies.molmoact2.molmoact2_hf_model import configuration_molmoact2 as parts
    from lerobot.policies.molmoact2.molmoact2_hf_model.modeling_molmoact2 import MolmoAct2ForConditionalGeneration
    from transformers import Qwen2Tokenizer

    pictures = {
        **{"image_patch_id": "<im_patch>", "image_col_id": "<im_col>", "image_start_token_id": "<im_start>"},
        **{"low_res_image_start_token_id": "<low_res_im_start>", "image_end_token_id": "<im_end>"},
        **{"image_low_res_id": "<im_low>", "frame_start_token_id": "<frame_start>"},
        "frame_end_token_id": "<frame_end>",
    }
    names = [*("setup", "control", "state", "action"), "|im"]
    marks = [f"<{name}_{end}>" for name in names[:-1] for end in ("start", "end")] + ["<|im_start|>", "<|im_end|>"]
    bins = [f"<state_{number}>" for number in range(16)]
    # Words are tokens, those around the instruction too.
    words = f"Image 1 2<|im_start|>user\nThe task is to {' '.join(WORDS)}. The setup The current state of The expected"
    words += (
        " control mode. Given these, what action should the robot take to complete the task?<|im_end|>\nassistant\n"
    )
    tokenizer = Qwen2Tokenizer().train_new_from_iterator([words] * 2, 500)
    tokenizer.add_special_tokens(
        {
            "eos_token": "<|im_end|>",
            "additional_special_tokens": [*pictures.values(), *marks, *bins, "<action_output>", "<|image|>"],
        }
    )
    tokenizer.save_pretrained(folder)
    size = {"size": {"height": 16, "width": 16}, "patch_size": 4, "crop_mode": "resize"}
    processor = {"image_processor": size, "use_single_crop_col_tokens": False}
    (folder / "processor_config.json").write_text(json.dumps(processor))
    heads = {"num_attention_heads": 2, "num_key_value_heads": 2, "head_dim": 8}
    settings: dict[str, Any] = {
        **{name: tokenizer.convert_tokens_to_ids(token) for name, token in pictures.items()},
        **{"eos_token_id": tokenizer.eos_token_id, "num_state_tokens": len(bins)},
        "state_token_start_id": tokenizer.convert_tokens_to_ids(bins[0]),
        "vit_config": parts.MolmoAct2VitConfig(
            **{"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 2, **heads},
            **{"image_default_input_size": (16, 16), "image_patch_size": 4, "image_num_pos": 16},
        ),
        "adapter_config": parts.MolmoAct2AdapterConfig(
            **{"vit_layers": (-1,), "hidden_size": 16, "intermediate_size": 24, "text_hidden_size": 24, **heads}
        ),
        "text_config": parts.MolmoAct2TextConfig(
            **{"hidden_size": 24, "intermediate_size": 32, "num_hidden_layers": 3, "vocab_size": len(tokenizer)},
            **{**heads, "num_key_value_heads": 1, "max_position_embeddings": 256, "use_qk_norm": True},
        ),
        "action_expert_config": parts.MolmoAct2ActionExpertConfig(
            **{"hidden_size": 16, "num_layers": 3, "num_heads": 2, "ffn_multiple_of": 8, "timestep_embed_dim": 8}
        ),
        "flow_matching_num_steps": 3,
    }
    torch.manual_seed(0)
    model = MolmoAct2ForConditionalGeneration(parts.MolmoAct2Config(**settings))
    for name, value in model.named_parameters():
        # Modulation is zero in a policy that was not trained, and pictures are hardly seen.
        if "modulation" in name or "final_layer" in name or "vision" in name:
            torch.nn.init.normal_(value, std=0.2)
    model.save_pretrained(folder)
    settings = {
        **features(24, 24),
        **{"checkpoint_path": str(folder), "model_dtype": "float32", "action_mode": "continuous"},
        **{"inference_action_mode": "continuous", "enable_inference_cuda_graph": False, "num_state_tokens": 16},
        **{"chunk_size": 5, "n_action_steps": 4, "setup_type": "robot", "control_mode": "robot"},
    }
    return MolmoAct2Policy(MolmoAct2Config(**{**settings, **changes})).eval()


#: As Qwen 2.5 VL's own template, for texts and pictures.
QWEN_TEMPLATE = (
    "{% for message in messages %}<|im_start|>{{ message.role }}\n{% for part in message.content %}"
    "{% if part.type == 'image' %}<|vision_start|><|image_pad|><|vision_end|>{% else %}{{ part.text }}{% endif %}"
    "{% endfor %}<|im_end|>\n{% endfor %}{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)


def small_qwen_vl(
    folder: Path, text: str, marks: tuple[str, ...] = (), processor: str = "Qwen2_5_VLProcessor"
) -> dict[str, Any]:
    """Write the processor of a small Qwen VL into `folder`, and return its configuration's arguments, those of 2.5.

    text: whose words are tokens, with those of the instruction. marks: special tokens besides Qwen's.
    """
    import transformers
    from transformers import Qwen2Tokenizer, Qwen2VLImageProcessor
    from transformers.models.qwen2_vl.video_processing_qwen2_vl import Qwen2VLVideoProcessor

    words = f"{INSTRUCTION} {' '.join(WORDS)} {text} system\nuser\nassistant\n"
    tokenizer = Qwen2Tokenizer().train_new_from_iterator([words] * 2, 400)
    names = {"vision_start_token_id": "<|vision_start|>", "vision_end_token_id": "<|vision_end|>"}
    names |= {"image_token_id": "<|image_pad|>", "video_token_id": "<|video_pad|>"}
    others = ["<|im_start|>", "<|im_end|>", *names.values(), *marks]
    tokenizer.add_special_tokens({"additional_special_tokens": others, "pad_token": "<|endoftext|>"})
    patches = {"patch_size": 4, "merge_size": 2, "temporal_patch_size": 2, "min_pixels": 64, "max_pixels": 768}
    getattr(transformers, processor)(
        Qwen2VLImageProcessor(**patches), tokenizer, Qwen2VLVideoProcessor(**patches), chat_template=QWEN_TEMPLATE
    ).save_pretrained(folder)
    return {
        "text_config": {
            **{"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 3, "num_attention_heads": 2},
            **{"num_key_value_heads": 1, "vocab_size": len(tokenizer) + 8, "max_position_embeddings": 256},
            "rope_parameters": {"rope_type": "default", "rope_theta": 1e4, "mrope_section": [2, 1, 1]},
            "initializer_range": 0.2,
        },
        "vision_config": {
            **{"depth": 2, "hidden_size": 16, "intermediate_size": 24, "num_heads": 2, "out_hidden_size": 16},
            **{"patch_size": 4, "spatial_merge_size": 2, "temporal_patch_size": 2, "window_size": 16},
            **{"fullatt_block_indexes": [1], "initializer_range": 0.2},
        },
        "initializer_range": 0.2,
        **{name: tokenizer.convert_tokens_to_ids(token) for name, token in names.items()},
    }


def small_eo1(folder: Path, **changes: Any) -> Any:
    """LeRobot 0.6's EO1Policy of three blocks; a small Qwen 2.5 VL with its processor is written into `folder`."""
    from lerobot.policies.eo1.configuration_eo1 import EO1Config
    from lerobot.policies.eo1.modeling_eo1 import EO1Policy
    from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

    vlm = Qwen2_5_VLConfig(**small_qwen_vl(folder, "You are a helpful physical assistant."))
    torch.manual_seed(0)
    Qwen2_5_VLForConditionalGeneration(vlm).save_pretrained(folder)
    settings: dict[str, Any] = {
        **features(24, 32),
        **{"vlm_base": str(folder), "dtype": "float32", "image_min_pixels": 64, "image_max_pixels": 768},
        **{"chunk_size": 5, "n_action_steps": 5, "max_state_dim": 8, "max_action_dim": 8, "num_denoise_steps": 3},
    }
    return EO1Policy(EO1Config(**{**settings, **changes})).eval()


def small_vla_jepa(folder: Path, **changes: Any) -> Any:
    """LeRobot 0.6's VLAJEPAPolicy, three blocks in Qwen and in the head; a small Qwen 3 VL is written into `folder`."""
    from lerobot.policies.vla_jepa.configuration_vla_jepa import VLAJEPAConfig
    from lerobot.policies.vla_jepa.modeling_vla_jepa import VLAJEPAPolicy
    from transformers import Qwen3VLConfig, Qwen3VLForConditionalGeneration

    text = "Your task is Infer the temporal dynamics from frames and produce the corresponding policy actions."
    vlm = small_qwen_vl(folder, text, processor="Qwen3VLProcessor")
    vlm["text_config"]["head_dim"] = 8
    vlm["vision_config"] |= {"num_position_embeddings": 16, "deepstack_visual_indexes": [0]}
    torch.manual_seed(0)
    Qwen3VLForConditionalGeneration(Qwen3VLConfig(**vlm)).save_pretrained(folder)
    settings: dict[str, Any] = {
        **features(24, 32),
        **{"qwen_model_name": str(folder), "torch_dtype": "float32", "enable_world_model": False},
        **{"chunk_size": 5, "n_action_steps": 5, "num_video_frames": 4, "num_action_tokens_per_timestep": 2},
        **{"num_embodied_action_tokens_per_instruction": 4, "num_inference_timesteps": 3, "action_num_layers": 3},
        **{"action_model_type": "DiT-test", "action_hidden_size": 16},
    }
    return VLAJEPAPolicy(VLAJEPAConfig(**{**settings, **changes})).eval()


def small_wall_x(folder: Path, **changes: Any) -> Any:
    """LeRobot 0.6's WallXPolicy of three blocks and two experts; a small checkpoint is written into `folder`.

    It computes in float32, but for the embedding, from which LeRobot's code takes bfloat16.
    """
    from lerobot.policies.wall_x.configuration_wall_x import WallXConfig
    from lerobot.policies.wall_x.modeling_wall_x import WallXPolicy
    from lerobot.policies.wall_x.qwen_model import Qwen2_5_VLConfig
    from safetensors.torch import save_file

    text = (
        "You are a helpful assistant. Observation: top view: wrist view: Instruction: Predict the next action in robot"
    )
    marks = ("<|propri|>", "<|action|>", "<|action_fast|>")
    vlm = small_qwen_vl(folder, f"{text} action.\nProprioception: \n", marks)
    expert = {"hidden_size": 16, "intermediate_size": 24, "hidden_act": "silu"}
    vlm["text_config"] |= {"num_experts": 2, "experts": [expert] * 2, "dim_inputs": [16, 16], "mlp_moe": True}
    vlm["text_config"]["dof_config"] = {"arm": 8}
    Qwen2_5_VLConfig(**vlm, agent_pos_config={"arm": 8}).save_pretrained(folder)
    save_file({}, folder / "model.safetensors")
    settings: dict[str, Any] = {
        **features(24, 32),
        **{"pretrained_name_or_path": str(folder), "vision_attn_implementation": "sdpa"},
        **{"chunk_size": 5, "n_action_steps": 5, "max_state_dim": 8, "max_action_dim": 8},
    }
    torch.manual_seed(0)
    policy = WallXPolicy(WallXConfig(**{**settings, **changes})).float().eval()
    policy.model.model.embed_tokens.to(torch.bfloat16)
    return policy


class WanWords:
    """The calls of FastWAM's tokenizer, with whole words."""

    def __init__(self, longest: int) -> None:
        self.longest = longest

    def __call__(self, texts: list[str], **_: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """Return ids and mask (text, token), padded to the longest."""
        rows = [WordTokenizer().encode(text) for text in texts]
        ids = torch.tensor([row + [0] * (self.longest - len(row)) for row in rows])
        return ids, (ids != 0).long()


def small_fastwam(**changes: Any) -> Any:
    """LeRobot 0.6's FastWAMPolicy of three blocks, with a small Wan VAE and UMT5; its tokenizer is a stand-in."""
    from diffusers import AutoencoderKLWan
    from lerobot.policies.fastwam import modeling_fastwam as module
    from lerobot.policies.fastwam.configuration_fastwam import FastWAMConfig
    from lerobot.policies.fastwam.wan.adapters import WanVideoVAE38
    from lerobot.policies.fastwam.wan.components import WanTextEncoder
    from transformers import UMT5Config, UMT5EncoderModel

    torch.manual_seed(0)
    vae = AutoencoderKLWan(
        **{"base_dim": 4, "z_dim": 48, "dim_mult": [1, 1, 1, 1], "num_res_blocks": 1, "is_residual": True},
        **{"in_channels": 12, "out_channels": 12, "patch_size": 2, "scale_factor_spatial": 16},
        **{"latents_mean": [0.0] * 48, "latents_std": [1.0] * 48},
    )
    words = UMT5EncoderModel(UMT5Config(vocab_size=100, d_model=16, d_kv=8, d_ff=24, num_layers=2, num_heads=2)).eval()
    sizes = {"ffn_dim": 24, "text_dim": 16, "freq_dim": 8, "num_heads": 2, "attn_head_dim": 8, "num_layers": 3}
    settings: dict[str, Any] = {
        **features(64, 64),
        **{"torch_dtype": "float32", "image_size": (64, 128), "tokenizer_max_len": 12, "num_inference_steps": 3},
        **{"action_dim": ACTION_DIM, "proprio_dim": STATE_DIM, "action_horizon": 4, "n_action_steps": 4},
        **{"num_video_frames": 5, "action_video_freq_ratio": 1},
        "prompt_template": "robot task {task}",
        "video_dit_config": {
            **{**sizes, "hidden_dim": 16, "in_dim": 48, "out_dim": 48, "patch_size": [1, 2, 2], "eps": 1e-6},
            **{"seperated_timestep": True, "video_attention_mask_mode": "first_frame_causal"},
        },
        "action_dit_config": {**sizes, "hidden_dim": 12, "action_dim": ACTION_DIM, "eps": 1e-6},
    }
    config = FastWAMConfig(**{**settings, **changes})
    parts = {
        "load_pretrained_wan_vae": WanVideoVAE38(device="cpu", pretrained=vae),
        "load_pretrained_wan_text_encoder": WanTextEncoder(torch.float32, "cpu", pretrained=words),
        "build_wan_tokenizer": WanWords(config.tokenizer_max_len),
    }
    with mock.patch.multiple(module, **{name: mock.Mock(return_value=part) for name, part in parts.items()}):
        return module.FastWAMPolicy(config).eval()
