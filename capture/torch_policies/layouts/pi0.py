"""pi0, pi0.5 and pi0-FAST as other packages run them: openpi's PyTorch code, LeRobot, transformers 5.

This project has the networks of pi0 and pi0.5 itself (`capture pi`, which needs none of these packages); the
layouts are for recording them where they run already: inside openpi's websocket server, inside lerobot-eval.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from vla_attention.capture.torch_policies.layouts.layout_building import LEROBOT, FoundModule, KeyOrder, camera_name
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, PromptText
from vla_attention.schemas.errors import BadArgument

_OPENPI_CAMERAS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")


def pi0_pytorch(policy: object, *, cameras: Sequence[str] = (), num_steps: int = 0) -> PolicyLayout:
    """Return the layout of a `PI0Pytorch` or `PI05Pytorch`, or of an object that holds one (openpi's `Policy`).

    Site `joint`: each camera's patches, the prompt, the state (pi0; pi0.5 writes it into the prompt), the actions.

    Args:
        cameras: names of the pictures, in the policy's order; none: those of LeRobot's configuration, or openpi's.
        num_steps: number of denoise steps; 0: that of LeRobot's configuration, or openpi's 10.

    Raises:
        NotThisPolicy: no such class.
    """
    found = FoundModule(policy, ("PI0Pytorch", "PI05Pytorch"), "pi0_pytorch")
    module = found.module
    config, networks = module.config, module.paligemma_with_expert
    vision, expert = networks.paligemma.config.vision_config, networks.gemma_expert.config
    chunk = getattr(config, "chunk_size", 0) or config.action_horizon
    prompt = getattr(config, "tokenizer_max_length", 0) or config.max_token_len
    steps = num_steps or getattr(config, "num_inference_steps", 0) or 10
    five = not hasattr(module, "state_proj")  # pi0.5 has no token of the state
    features = getattr(config, "image_features", None) or {}
    names = list(cameras) or [camera_name(feature) for feature in features] or list(_OPENPI_CAMERAS)
    keys = _prefix(names, (vision.image_size,) * 2, vision.patch_size, prompt)
    keys.add("state", "state", int(not five), "state")
    keys.add("actions", "action", chunk, "action")
    prefix = r"paligemma_with_expert\.paligemma"
    embedding = found.inside("paligemma_with_expert.paligemma.model.language_model.embed_tokens")
    return keys.layout(
        "pi05_pytorch" if five else "pi0_pytorch",
        (-chunk, None),
        (expert.num_hidden_layers, expert.num_attention_heads),
        [
            found.rule(r"paligemma_with_expert\.gemma_expert\.model\.layers\.(?P<block>\d+)\.self_attn", "joint"),
            found.rule(rf"{prefix}\.model\.language_model\..*", tokens="joint"),
            found.rule(rf"{prefix}\..*"),
        ],
        names,
        "pad",
        family="pi0_pytorch",
        num_denoise_steps=steps,
        denoise_times=tuple(1.0 - step / steps for step in range(steps)),
        text=PromptText(("prompt",), embedding, state_between=("State:", ";") if five else None),
        action_horizon=chunk,
        action_dim=getattr(config, "max_action_dim", 0) or config.action_dim,
    )


def pi0_fast(policy: object) -> PolicyLayout:
    """Return the layout of LeRobot's `PI0FastPolicy`, or of an object that holds one.

    Site `joint`: each camera's patches, the prompt (with its padding and a BOS that ends it), the tokens so far.
    PaliGemma writes action tokens one after another; each token is one action query. The first token's query is the
    last of the prefix (its closing BOS), the others' are the tokens before them. The policy always writes
    `max_decoding_steps` tokens, with or without a cache of keys.

    Raises:
        NotThisPolicy: no PI0FastPolicy.
    """
    found = FoundModule(policy, ("PI0FastPolicy",), "pi0_fast")
    config, paligemma = found.module.config, found.module.model.paligemma_with_expert.paligemma.config
    cameras = [camera_name(feature) for feature in config.image_features]
    patch, longest = paligemma.vision_config.patch_size, config.tokenizer_max_length + 1
    keys = _prefix(cameras, tuple(config.image_resolution), patch, longest)
    keys.add("action_tokens", "action", config.max_decoding_steps - 1, "action", growing=True)
    decoder = "model.paligemma_with_expert.paligemma.model.language_model"
    return keys.layout(
        "pi0_fast",
        (-1, None),
        (paligemma.text_config.num_hidden_layers, paligemma.text_config.num_attention_heads),
        [
            found.rule(re.escape(decoder) + r"\.layers\.(?P<block>\d+)\.self_attn", "joint", tokens="joint"),
            found.rule(r".*vision_tower\..*"),
        ],
        cameras,
        "pad",
        text=PromptText(("prompt",), found.inside(f"{decoder}.embed_tokens"), state_between=("State:", ";")),
        action_horizon=config.n_action_steps,
        action_dim=config.action_feature.shape[0],
        autoregressive=True,
        num_action_tokens=config.max_decoding_steps,
        versions=LEROBOT,
    )


def pi0_transformers(
    policy: object, *, cameras: Sequence[str] = ("base", "left_wrist", "right_wrist"), prompt_tokens: int = 48
) -> PolicyLayout:
    """Return the layout of a `PI0ForConditionalGeneration` (transformers 5), or of an object that holds one.

    Site `joint`: each camera's patches, the prompt, the state, the action tokens.

    Args:
        cameras: names of the pictures of one call, in the order in which the processor is given them.
        prompt_tokens: the longest prompt in tokens, without the placeholders for patches.

    Raises:
        NotThisPolicy: no PI0ForConditionalGeneration.
    """
    found = FoundModule(policy, ("PI0ForConditionalGeneration",), "pi0_transformers")
    if not cameras or prompt_tokens < 1:
        raise BadArgument(f"pi0 needs at least one camera and one prompt token; got {list(cameras)}, {prompt_tokens}.")
    config = found.module.config
    vision, steps = config.vlm_config.vision_config, config.num_inference_steps
    keys = _prefix(cameras, (vision.image_size,) * 2, vision.patch_size, prompt_tokens)
    patches = keys.num_keys - prompt_tokens
    keys.add("state", "state", 1, "state")
    keys.add("actions", "action", config.chunk_size, "action")
    return keys.layout(
        "pi0_transformers",
        (-config.chunk_size, None),
        (config.dit_config.num_hidden_layers, config.dit_config.num_attention_heads),
        [
            found.rule(r"model\.dit\.layers\.(?P<block>\d+)\.self_attn", "joint"),
            found.rule(r"model\.vlm\.language_model\..*", tokens="joint"),
            found.rule(r"model\.vlm\..*"),
        ],
        cameras,
        num_denoise_steps=steps,
        denoise_times=tuple(1.0 - step / steps for step in range(steps)),
        # The model replaces the placeholders for patches by 0 before it embeds the ids: their number tells them.
        text=PromptText(("prompt",), found.inside("model.vlm.language_model.embed_tokens"), skip_first=patches),
        action_horizon=config.chunk_size,
        action_dim=config.max_action_dim,
        versions={"transformers": ("5.",)},
    )


def _prefix(cameras: Sequence[str], size: tuple[int, int], patch: int, prompt: int) -> KeyOrder:
    """The keys of pictures of (height, width) in pixels, and of the prompt."""
    keys = KeyOrder()
    for camera in cameras:
        keys.add_picture(camera, size[0] // patch, size[1] // patch, *size)
    keys.add("prompt", "text", prompt, "instruction")
    return keys
