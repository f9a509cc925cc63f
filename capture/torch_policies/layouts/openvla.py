"""OpenVLA and OpenVLA-OFT: a Llama whose keys are BOS, the patches, the prompt, and action tokens.

OpenVLA writes one token per action dimension; the first one's query is the prompt's last token. OFT computes the whole
chunk at once, on placeholders, without a causal mask: the query of placeholder i is the position before it, as its code
reads the hidden states (prismatic/extern/hf/modeling_prismatic.py, `_regression_or_discrete_prediction`).

Both are read from their code; no installable package has their classes, so the tests use a stand-in with these calls.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vla_attention.capture.torch_policies.layouts.layout_building import FoundModule, KeyOrder, square
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, PromptText
from vla_attention.schemas.errors import BadArgument

_CLASSES = ("OpenVLAForActionPrediction",)


def openvla(
    policy: object, *, camera: str = "image", action_dim: int = 7, prompt_tokens: int = 64, patches: int = 256
) -> PolicyLayout:
    """Return the layout of OpenVLA's `OpenVLAForActionPrediction`, or of an object that holds one.

    Site `joint`: BOS, the camera's patches, the prompt, and the action tokens written so far. One row per action token.

    Args:
        camera: a name for the picture.
        action_dim: number of action tokens, the dimensions of an action of the checkpoint's data set.
        prompt_tokens: the longest prompt in tokens, without BOS.
        patches: number of patches of the picture.

    Raises:
        NotThisPolicy: no OpenVLAForActionPrediction.
    """
    found = FoundModule(policy, _CLASSES, "openvla")
    keys = _prefix(found, [camera], prompt_tokens, patches, 0, "openvla")
    keys.add("action_tokens", "action", action_dim - 1, "action", growing=True)
    return _layout(
        "openvla",
        found,
        keys,
        (-1, None),
        cameras=[camera],
        action_horizon=1,
        action_dim=action_dim,
        autoregressive=True,
        num_action_tokens=action_dim,
    )


def openvla_oft(
    policy: object,
    *,
    cameras: Sequence[str] = ("image", "wrist_image"),
    action_dim: int = 7,
    chunk: int = 8,
    prompt_tokens: int = 64,
    patches: int = 256,
    proprio: bool = True,
    diffusion_steps: int = 0,
) -> PolicyLayout:
    """Return the layout of OpenVLA-OFT's `OpenVLAForActionPrediction`, or of an object that holds one.

    Site `joint`: BOS, the cameras' patches, the state (and the diffusion step's token), the prompt, a placeholder for
    each number of the chunk, and a stop token.

    Args:
        cameras: names for the pictures, in the order in which they are given.
        action_dim, chunk: dimensions of an action, and actions of a chunk (LIBERO: 7 and 8, ALOHA: 14 and 25).
        prompt_tokens: the longest prompt in tokens, without BOS.
        patches: number of patches of one picture.
        proprio: the state is given.
        diffusion_steps: number of diffusion steps; 0 for regression or discrete tokens, which need one pass.

    Raises:
        NotThisPolicy: no OpenVLAForActionPrediction.
    """
    found = FoundModule(policy, _CLASSES, "openvla_oft")
    placeholders = action_dim * chunk
    keys = _prefix(found, cameras, prompt_tokens, patches, int(proprio), "openvla_oft", diffusion_steps)
    keys.add("actions", "action", placeholders, "action")
    keys.add("stop", "text", 1, "template")
    return _layout(
        "openvla_oft",
        found,
        keys,
        (-(placeholders + 2), -2),
        cameras=cameras,
        num_denoise_steps=max(1, diffusion_steps),
        action_horizon=chunk,
        action_dim=action_dim,
    )


def _prefix(
    found: FoundModule, cameras: Sequence[str], prompt: int, patches: int, state: int, layout: str, diffusion: int = 0
) -> KeyOrder:
    if not cameras or prompt < 1:
        raise BadArgument(f"{layout} needs at least one camera and one prompt token; got {list(cameras)}, {prompt}.")
    sizes = getattr(found.module.config, "image_sizes", None) or [224]
    size, side = int(sizes[0] if isinstance(sizes, list | tuple) else sizes), square(patches, "pictures", layout)
    keys = KeyOrder()
    keys.add("bos", "text", 1, "bos")
    for camera in cameras:
        keys.add_picture(camera, side, side, size, size)
    keys.add("state", "state", state, "state")
    keys.add("diffusion_step", "state", int(diffusion > 0), "learned")
    keys.add("prompt", "text", prompt, "instruction")
    return keys


def _layout(
    name: str, found: FoundModule, keys: KeyOrder, queries: tuple[int, int | None], **others: Any
) -> PolicyLayout:
    text = found.module.config.text_config
    # OFT embeds its placeholders and the stop token with the prompt.
    after = [span.name for span in keys.spans if span.name in ("actions", "stop")]
    return keys.layout(
        name,
        queries,
        (text.num_hidden_layers, text.num_attention_heads),
        [
            found.rule(r"language_model\.model\.layers\.(?P<block>\d+)\.self_attn", "joint", tokens="joint"),
            found.rule(r"vision_backbone(\..*)?"),
        ],
        text=PromptText(("bos", "prompt", *after), found.inside("language_model.model.embed_tokens")),
        **others,
    )
