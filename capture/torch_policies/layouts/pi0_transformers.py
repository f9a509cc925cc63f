"""pi0 of transformers 5 (`PI0ForConditionalGeneration`): prefix keys, then the state's, then the action tokens'."""

from __future__ import annotations

from collections.abc import Sequence

from vla_attention.capture.torch_policies.layouts.find_policy import find_policy, inside, rule_path
from vla_attention.capture.torch_policies.layouts.key_order import KeyOrder
from vla_attention.capture.torch_policies.policy_layout import CallRule, CameraPicture, PolicyLayout, PromptText
from vla_attention.schemas.errors import BadArgument

_NAME = "pi0_transformers"


def pi0_transformers(
    policy: object, *, cameras: Sequence[str] = ("base", "left_wrist", "right_wrist"), prompt_tokens: int = 48
) -> PolicyLayout:
    """Return the layout of a `PI0ForConditionalGeneration`, or of an object that holds one.

    Site `joint`: each camera's patches, the prompt, the state, the action tokens.

    Args:
        cameras: names of the pictures of one call, in the order in which the processor is given them.
        prompt_tokens: the longest prompt in tokens, without the placeholders for patches.

    Raises:
        NotThisPolicy: no PI0ForConditionalGeneration.
    """
    path, found = find_policy(policy, ("PI0ForConditionalGeneration",), _NAME)
    if not cameras or prompt_tokens < 1:
        raise BadArgument(f"pi0 needs at least one camera and one prompt token; got {list(cameras)}, {prompt_tokens}.")
    config = found.config
    vision, dit = config.vlm_config.vision_config, config.dit_config
    side = vision.image_size // vision.patch_size
    keys = KeyOrder()
    for camera in cameras:
        keys.add_picture(camera, side, side, vision.image_size, vision.image_size)
    patches = keys.num_keys
    keys.add("prompt", "text", prompt_tokens, "instruction")
    keys.add("state", "state", 1, "state")
    keys.add("actions", "action", config.chunk_size, "action")
    steps = config.num_inference_steps
    site = keys.site(
        "joint",
        (-config.chunk_size, None),
        projection=inside(path, "model.dit.layers.{block}.self_attn.o_proj"),
        variable="prompt",
    )
    return PolicyLayout(
        name=_NAME,
        family="pi0_transformers",
        sites=(site,),
        rules=(
            CallRule(rule_path(path, r"model\.dit\.layers\.(?P<block>\d+)\.self_attn"), "joint"),
            CallRule(rule_path(path, r"model\.vlm\..*"), None),
        ),
        num_layers=dit.num_hidden_layers,
        num_heads=dit.num_attention_heads,
        num_denoise_steps=steps,
        denoise_times=tuple(1.0 - step / steps for step in range(steps)),
        cameras=tuple(CameraPicture(camera) for camera in cameras),
        # The model replaces the placeholders for patches by 0 before it embeds the ids: their number tells them.
        text=PromptText(("prompt",), inside(path, "model.vlm.language_model.embed_tokens"), skip_first=patches),
        action_horizon=config.chunk_size,
        action_dim=config.max_action_dim,
        versions={"transformers": ("5.",)},
    )
