"""SmolVLA of LeRobot: an action expert whose blocks alternate between `self` and `cross`.

Keys of a prefix: for each camera two tokens that begin it (where the checkpoint has them), its patches, one that ends
it; the prompt; the state. Blocks of `self` see the prefix and the action tokens up to the query's own, those of `cross`
the prefix only. All of them compute in one module, `vlm_with_expert`, with a softmax by hand.
"""

from __future__ import annotations

import re
from typing import Any

from vla_attention.capture.torch_policies.layouts.layout_building import (
    LEROBOT,
    FoundModule,
    KeyOrder,
    NotThisPolicy,
    camera_name,
    square,
)
from vla_attention.capture.torch_policies.policy_layout import CallRule, CameraPicture, PolicyLayout, PromptText

_NAME = "smolvla"


def smolvla(policy: object) -> PolicyLayout:
    """Return the layout of a `SmolVLAPolicy`, or of an object that holds one.

    Sites: `self` (keys: prefix and action tokens) and `cross` (keys: prefix), where the policy has blocks of both.

    Raises:
        NotThisPolicy: no SmolVLAPolicy, or one whose calls cannot be told from the prefix's by their numbers.
    """
    found = FoundModule(policy, ("SmolVLAPolicy",), _NAME)
    config, model = found.module.config, found.module.model.vlm_with_expert
    if config.prefix_length > 0 and config.pad_language_to != "max_length":
        raise NotThisPolicy(
            f"This SmolVLA pads its prefix to {config.prefix_length} keys after prompts of different lengths "
            f"(pad_language_to='{config.pad_language_to}'), so that no key has a place of its own; expected "
            "pad_language_to='max_length', or no prefix_length."
        )
    if not config.use_cache:
        raise NotThisPolicy("This SmolVLA has use_cache=False, with which it cannot act; set use_cache=True.")
    order, cameras = _sequence(model), [camera_name(feature) for feature in config.image_features]
    most = _prefix(config, model, cameras).num_keys
    fewest = most if config.pad_language_to == "max_length" else most - config.tokenizer_max_length
    if fewest <= config.chunk_size <= most:
        raise NotThisPolicy(
            f"This SmolVLA's prefix of {fewest} to {most} keys may be as long as its chunk of {config.chunk_size} "
            "actions; then its two passes cannot be told apart."
        )
    sites = []
    for kind in dict.fromkeys(site for site, _ in order):
        keys = _prefix(config, model, cameras)
        keys.add("actions", "action", config.chunk_size if kind == "self" else 0, "action")
        blocks = tuple(block for site, block in order if site == kind)
        sites.append(keys.site(kind, (0, config.chunk_size), layers=blocks, variable="prompt"))
    expert = found.inside("model.vlm_with_expert")
    of_expert, tokens = re.escape(expert), "self" if "self" in [site.name for site in sites] else "cross"
    return PolicyLayout(
        name=_NAME,
        family="smolvla",
        sites=tuple(sites),
        rules=(
            CallRule(of_expert, None, queries=config.chunk_size, sequence=tuple(order)),
            CallRule(of_expert, None, tokens=tokens),
            CallRule(of_expert + r"\.vlm\..*", None),
        ),
        num_layers=max(block for _, block in order) + 1,
        num_heads=model.num_attention_heads,
        num_denoise_steps=config.num_steps,
        denoise_times=tuple(1.0 - step / config.num_steps for step in range(config.num_steps)),
        cameras=tuple(CameraPicture(camera, "pad_left_top") for camera in cameras),
        text=PromptText(("prompt",), f"{expert}.vlm.model.text_model.embed_tokens"),
        action_horizon=config.chunk_size,
        action_dim=config.action_feature.shape[0],
        versions=LEROBOT,
    )


def _sequence(model: Any) -> list[tuple[str, int]]:
    """The site and block of each call of a denoise step, in order; the block is the expert's layer."""
    calls = []
    multiple = model.num_vlm_layers // model.num_expert_layers
    every = model.self_attn_every_n_layers
    for layer in range(model.num_vlm_layers):
        if multiple > 1 and layer % multiple:
            continue
        is_self = "cross" not in model.attention_mode or (every > 0 and layer % every == 0)
        calls.append(("self" if is_self else "cross", layer // max(multiple, 1)))
    return calls


def _prefix(config: Any, model: Any, cameras: list[str]) -> KeyOrder:
    keys = KeyOrder()
    vision = model.config.vision_config
    for feature, camera in zip(config.image_features, cameras, strict=True):
        size = config.resize_imgs_with_padding
        width, height = size if size is not None else reversed(config.image_features[feature].shape[1:])
        patches = (height // vision.patch_size) * (width // vision.patch_size)
        side = square(patches, "pictures", _NAME) // model.config.scale_factor
        if config.add_image_special_tokens:
            keys.add(f"{camera}_begin", "text", 2, "template")
        keys.add_picture(camera, side, side, height, width)
        if config.add_image_special_tokens:
            keys.add(f"{camera}_end", "text", 1, "template")
    keys.add("prompt", "text", config.tokenizer_max_length, "instruction")
    keys.add("state", "state", 1, "state")
    keys.add("prefix_padding", "text", max(0, config.prefix_length - keys.num_keys), "padding")
    return keys
