"""X-VLA of LeRobot: one sequence without a mask. Actions come first, then Florence 2's tokens, further views, prompts.

Florence 2's encoder has mixed the first camera's tokens and the text before: keys are named by their positions. An
empty view has features of zero; its keys hold no picture but take attention, as Cosmos's blank frames do. Padding of
the prompt is not masked either.
"""

from __future__ import annotations

from typing import Any

from vla_attention.capture.torch_policies.layouts.layout_building import (
    LEROBOT,
    FoundModule,
    KeyOrder,
    NotThisPolicy,
    camera_name,
)
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, PromptText

_NAME = "xvla"
#: Those of transformers' own Florence 2, which LeRobot 0.6 has and whose configuration does not name them.
_SOURCES = ("spatial_avg_pool", "temporal_avg_pool")


def xvla(policy: object) -> PolicyLayout:
    """Return the layout of an `XVLAPolicy`, or of an object that holds one.

    Site `joint`: action tokens, the first camera (its mean, then its patches), the prompt, further cameras, empty
    views, soft prompts.

    Raises:
        NotThisPolicy: no XVLAPolicy, or one with other picture features than means and patches.
    """
    found = FoundModule(policy, ("XVLAPolicy",), _NAME)
    config, vlm = found.module.config, found.module.model.vlm
    vision = vlm.config.vision_config
    language = "model.vlm.language_model" + (".model" if hasattr(vlm.language_model, "model") else "")
    cameras = [(camera_name(feature), config.image_features[feature].shape) for feature in config.image_features]
    views = max(config.num_image_views or 0, len(cameras))
    keys = KeyOrder()
    keys.add("actions", "action", config.chunk_size, "action")
    for number in range(views):
        if number < len(cameras):
            _add_view(keys, *cameras[number], config, vision)
        else:
            rows, columns = _patches(*_picture_size(cameras[0][1], config), vision)
            count = sum(_tokens_of(source, rows * columns) for source in _sources(vision))
            keys.add(f"empty_view_{number}", "image", count, "blank")
        if number == 0:
            keys.add("prompt", "text", config.tokenizer_max_length, "instruction")
    keys.add("soft_prompts", "state", config.len_soft_prompts, "learned")
    return keys.layout(
        _NAME,
        (0, config.chunk_size),
        (config.depth, config.num_heads),
        [
            found.rule(r"model\.transformer\.blocks\.(?P<block>\d+)\.attn", "joint"),
            found.rule(r"model\.vlm\..*"),
        ],
        [name for name, _ in cameras],
        "pad_left_top" if config.resize_imgs_with_padding else "stretch",
        num_denoise_steps=max(1, config.num_denoising_steps),
        denoise_times=tuple(step / config.num_denoising_steps for step in range(config.num_denoising_steps, 0, -1)),
        text=PromptText(("prompt",), found.inside(f"{language}.shared")),
        action_horizon=config.chunk_size,
        action_dim=found.module.model.dim_action,
        versions=LEROBOT,
    )


def _picture_size(shape: tuple[int, ...], config: Any) -> tuple[int, int]:
    height, width = config.resize_imgs_with_padding or shape[1:]
    return height, width


def _patches(height: int, width: int, vision: Any) -> tuple[int, int]:
    """Rows and columns of the picture network's last stage."""
    for size, stride, padding in zip(vision.patch_size, vision.patch_stride, vision.patch_padding, strict=True):
        height, width = ((side + 2 * padding - size) // stride + 1 for side in (height, width))
    return height, width


def _sources(vision: Any) -> tuple[str, ...]:
    return tuple(getattr(vision, "image_feature_source", _SOURCES))


def _tokens_of(source: str, patches: int) -> int:
    counts = {"spatial_avg_pool": 1, "temporal_avg_pool": patches, "last_frame": patches}
    if source not in counts:
        raise NotThisPolicy(f"The layout '{_NAME}' does not know the picture features '{source}'.")
    return counts[source]


def _add_view(keys: KeyOrder, camera: str, shape: tuple[int, ...], config: Any, vision: Any) -> None:
    height, width = _picture_size(shape, config)
    rows, columns = _patches(height, width, vision)
    sources = [(source, _tokens_of(source, rows * columns)) for source in _sources(vision)]
    if sum(source != "spatial_avg_pool" for source, _ in sources) != 1:
        raise NotThisPolicy(
            f"The layout '{_NAME}' is for one token a patch; this policy's picture features are "
            f"{', '.join(_sources(vision))}."
        )
    for source, count in sources:
        if source == "spatial_avg_pool":
            keys.add(f"{camera}_mean", "image", count, "image")
        else:
            keys.add_picture(camera, rows, columns, height, width)
