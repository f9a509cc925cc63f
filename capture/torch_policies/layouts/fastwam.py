"""FastWAM of LeRobot: noisy actions that read the picture and each other (`joint`), then the text (`cross`).

The cameras stand beside each other in one picture, which Wan's video transformer reads first, with the words: its
tokens' keys and values in every block are those of `joint`. A camera's patches are one span for each row of patches.
"""

from __future__ import annotations

from vla_attention.capture.torch_policies.layouts.layout_building import LEROBOT_06, FoundModule, KeyOrder, camera_name
from vla_attention.capture.torch_policies.policy_layout import CameraPicture, PolicyLayout, PromptText
from vla_attention.schemas.layout import PatchGrid

_NAME = "fastwam"


def fastwam(policy: object) -> PolicyLayout:
    """Return the layout of a `FastWAMPolicy`, or of an object that holds one.

    Sites: `joint` (keys: pictures, actions) and `cross` (keys: the prompt with its padding, which is not masked, and
    the state), in every block. Words also reach the actions by the tokens of the picture: give effects
    `readers=("action",)`. The tokenizer is `policy.model.tokenizer.tokenizer`.

    Raises:
        NotThisPolicy: no FastWAMPolicy.
    """
    found = FoundModule(policy, ("FastWAMPolicy",), _NAME)
    config, model = found.module.config, found.module.model
    cameras = sorted(camera_name(feature) for feature in config.image_features)
    height, width = config.image_size[0], config.image_size[1] // len(cameras)
    patch = model.vae.upsampling_factor * model.video_expert.patch_size[1]
    rows, columns = height // patch, width // patch
    keys, context = KeyOrder(), KeyOrder()
    for row in range(rows):
        for camera in cameras:
            grid = PatchGrid(1, columns, height, width, part=(row / rows, 0.0, 1 / rows, 1.0))
            keys.add(f"{camera}_row_{row}", "image", columns, "image", camera=camera, grid=grid)
    keys.add("actions", "action", config.action_horizon, "action")
    context.add("prompt", "text", config.tokenizer_max_len, "instruction")
    context.add("state", "state", int(config.proprio_dim is not None), "state")
    steps, queries = config.num_inference_steps, (0, config.action_horizon)
    shift = config.sigma_shift or model.infer_action_scheduler.shift
    noise = [1.0 - step / steps for step in range(steps)]
    embedding = found.inside("model.text_encoder.model.encoder.embed_tokens")
    return PolicyLayout(
        name=_NAME,
        family=_NAME,
        sites=(keys.site("joint", queries), context.site("cross", queries)),
        rules=(
            found.rule(r"model\.mot\.layers\.(?P<block>\d+)", "joint", keys=keys.num_keys),
            found.rule(r"model\.mot\.mixtures\.action\.blocks\.(?P<block>\d+)", "cross"),
            found.rule(r"model\.(mot|vae|text_encoder)\..*"),
        ),
        num_layers=model.mot.num_layers,
        num_heads=model.mot.num_heads,
        num_denoise_steps=steps,
        denoise_times=tuple(shift * part / (1.0 + (shift - 1.0) * part) for part in noise),
        cameras=tuple(CameraPicture(camera) for camera in cameras),
        text=None if model.text_encoder is None else PromptText(("prompt",), embedding),
        action_horizon=config.action_horizon,
        action_dim=config.action_dim,
        versions=LEROBOT_06,
    )
