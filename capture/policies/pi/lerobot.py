"""LeRobot's pi0 and pi0.5 policies: model and processing, from config.json and the saved pipelines.

LeRobot computes times and their waves in float64 and steps time as 1 + step · dt; its policies do so here too.
In bfloat16 its image encoder stays in float32. Formulas of the processing: LeRobot's LiberoProcessorStep, the policies'
own image preparation and the saved pipelines; checked against arrays that LeRobot computed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.environments.episode_protocol import LEROBOT
from vla_attention.capture.policies.checkpoints import CheckpointMismatch, UnsupportedCheckpoint
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.lerobot_config import LerobotConfig
from vla_attention.capture.policies.pi.lerobot_pipeline import LerobotPipeline
from vla_attention.capture.policies.pi.processing import Processing, simulated_arm, simulator_cameras
from vla_attention.capture.policies.pi.sizes import stated_config
from vla_attention.capture.policies.robot import IMAGES, Robot
from vla_attention.schemas.fitted_pictures import fitted_box

#: LeRobot's names for the pictures of its LIBERO environment -> the simulator's cameras.
LIBERO_CAMERAS = {IMAGES + "image": "agentview", IMAGES + "image2": "robot0_eye_in_hand"}


def lerobot_image(picture: NDArray[np.uint8], size: int) -> Tensor:
    """Return the model's image (1, 3, size, size) float32 in [-1, 1] of a picture (height, width, 3).

    Resized bilinearly without antialiasing with the aspect ratio kept, centred on black.
    """
    image = torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1)))[None].float() / 255.0
    height, width = image.shape[2:]
    if (height, width) != (size, size):
        top, left, rows, columns = fitted_box((height, width), (size, size))
        image = F.interpolate(image, size=(rows, columns), mode="bilinear", align_corners=False).clamp(0.0, 1.0)
        image = F.pad(image, (left, size - columns - left, top, size - rows - top))
    return image * 2.0 - 1.0


def lerobot_pictures(picture: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], Tensor]:
    """Resize in float32; the stored picture is the same, rounded to whole grey levels."""
    image = lerobot_image(picture, size)
    kept = ((image[0].permute(1, 2, 0) + 1.0) * 127.5).round().clamp(0, 255).to(torch.uint8)
    return kept.numpy(), image


def slots(config: LerobotConfig) -> list[str]:
    """Return the cameras of the model: the names of their features without "observation.images."."""
    return [feature.removeprefix(IMAGES) for feature in config.cameras]


def lerobot_arm(config: LerobotConfig, rename: Mapping[str, str], chosen: Mapping[str, str]) -> Robot:
    """Return the arm of the simulators; chosen: `--camera` with names of slots or features, see `simulator_cameras`."""
    usual = {rename.get(feature, feature).removeprefix(IMAGES): camera for feature, camera in LIBERO_CAMERAS.items()}
    by_slot = {name.removeprefix(IMAGES): seen for name, seen in chosen.items()}
    return simulated_arm(simulator_cameras(slots(config), usual, by_slot))


def lerobot_processing(config: LerobotConfig, pipeline: LerobotPipeline, robot: Robot) -> Processing:
    """Return the processing of a LeRobot policy outside its model, from its checkpoint."""
    for what, given, needed in (
        ("state", config.state_dim, robot.state_dim),
        ("action", config.action_dim, robot.action_dim),
    ):
        if given != needed:
            raise UnsupportedCheckpoint(
                f"The policy has {what}s of {given} numbers, and those of the environments have {needed}: it was "
                "made for another robot."
            )
    return Processing(
        "lerobot",
        robot,
        pipeline.state,
        pipeline.action,
        normalisation=f"state {pipeline.state.mode}, action {pipeline.action.mode}",
        resize=lerobot_pictures,
        image_resize="torch bilinear without antialiasing",
        whole_grey_levels=False,
        prompt_format=pipeline.prompt_format,
        cut_long_prompts=pipeline.cut_long_prompts,
        protocol=LEROBOT,
        default_replan_steps=config.n_action_steps,
    )


def lerobot_model(stated: LerobotConfig, has_pi05: bool, sizes: PiConfig | None, robot: Robot) -> PiConfig:
    """Return the model's configuration, as config.json states it.

    has_pi05: whether the tensors are pi0.5's. sizes: widths and heads, which config.json does not state where they are
    not openpi's; only the sizes of the transformers and of the image encoder are taken. Slots with a camera of the
    robot come first; the others are black and masked.
    """
    if has_pi05 != stated.pi05:
        names = {True: "pi05", False: "pi0"}
        raise CheckpointMismatch(
            f"The checkpoint's config.json says type '{names[stated.pi05]}', but its tensors are those of "
            f"{names[has_pi05]}."
        )
    named = {
        "action_horizon": stated.chunk_size,
        "action_dim": stated.max_action_dim,
        "paligemma_variant": stated.paligemma_variant,
        "action_expert_variant": stated.action_expert_variant,
    }
    base = sizes or stated_config(named, pi05=stated.pi05, image_size=stated.image_resolution[0])
    if base.siglip.image_size != stated.image_resolution[0]:
        raise CheckpointMismatch(
            f"The checkpoint's config.json says image_resolution {stated.image_resolution}, but its sizes are for "
            f"images of {base.siglip.image_size} pixels."
        )
    return dataclasses.replace(
        base,
        pi05=stated.pi05,
        action_horizon=stated.chunk_size,
        action_dim=stated.max_action_dim,
        max_token_len=stated.max_token_len,
        num_denoise_steps=stated.num_inference_steps,
        discrete_state_input=stated.pi05,
        cameras=tuple(sorted(slots(stated), key=lambda slot: slot not in robot.cameras)),
        time_convention="stepped",
        min_period=stated.min_period,
        max_period=stated.max_period,
        float32_vision=True,
    )
