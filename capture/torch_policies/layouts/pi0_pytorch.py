"""pi0 and pi0.5 of openpi's PyTorch code and of LeRobot, which copied it: prefix keys, the state's (pi0), the actions'.

This project has these networks itself (`vla-capture pi`, which needs neither package); the layout is for recording them
where they run already: inside openpi's websocket server, inside lerobot-eval.
"""

from __future__ import annotations

from collections.abc import Sequence

from vla_attention.capture.torch_policies.layouts.find_policy import camera_name, find_policy, inside, rule_path
from vla_attention.capture.torch_policies.layouts.key_order import KeyOrder
from vla_attention.capture.torch_policies.policy_layout import CallRule, CameraPicture, PolicyLayout, PromptText

_NAME = "pi0_pytorch"
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
    path, found = find_policy(policy, ("PI0Pytorch", "PI05Pytorch"), _NAME)
    config, networks = found.config, found.paligemma_with_expert
    vision, expert = networks.paligemma.config.vision_config, networks.gemma_expert.config
    chunk = getattr(config, "chunk_size", 0) or config.action_horizon
    prompt = getattr(config, "tokenizer_max_length", 0) or config.max_token_len
    steps = num_steps or getattr(config, "num_inference_steps", 0) or 10
    five = not hasattr(found, "state_proj")  # pi0.5 has no token of the state
    features = getattr(config, "image_features", None) or {}
    names = list(cameras) or [camera_name(feature) for feature in features] or list(_OPENPI_CAMERAS)
    side = vision.image_size // vision.patch_size
    keys = KeyOrder()
    for camera in names:
        keys.add_picture(camera, side, side, vision.image_size, vision.image_size)
    keys.add("prompt", "text", prompt, "instruction")
    keys.add("state", "state", int(not five), "state")
    keys.add("actions", "action", chunk, "action")
    decoder = "paligemma_with_expert.gemma_expert.model.layers"
    site = keys.site(
        "joint",
        (-chunk, None),
        projection=inside(path, f"{decoder}.{{block}}.self_attn.o_proj"),
        variable="prompt",
    )
    embedding = inside(path, "paligemma_with_expert.paligemma.model.language_model.embed_tokens")
    return PolicyLayout(
        name="pi05_pytorch" if five else _NAME,
        family="pi0_pytorch",
        sites=(site,),
        rules=(
            CallRule(rule_path(path, decoder.replace(".", r"\.") + r"\.(?P<block>\d+)\.self_attn"), "joint"),
            CallRule(rule_path(path, r"paligemma_with_expert\.paligemma\..*"), None),
        ),
        num_layers=expert.num_hidden_layers,
        num_heads=expert.num_attention_heads,
        num_denoise_steps=steps,
        denoise_times=tuple(1.0 - step / steps for step in range(steps)),
        cameras=tuple(CameraPicture(camera, "pad") for camera in names),
        text=PromptText(("prompt",), embedding, state_between=("State:", ";") if five else None),
        action_horizon=chunk,
        action_dim=getattr(config, "max_action_dim", 0) or config.action_dim,
    )
