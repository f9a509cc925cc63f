"""The robot of a data set for a pi checkpoint: cameras, sizes of state and actions, relative actions."""

from __future__ import annotations

from collections.abc import Mapping

from vla_attention.capture.policies.pi.config import CAMERA_SLOTS
from vla_attention.capture.policies.pi.lerobot_config import LerobotConfig
from vla_attention.capture.policies.pi.preprocess import NormStats
from vla_attention.capture.policies.robot import IMAGES, Robot, RobotData
from vla_attention.schemas.errors import BadArgument

#: Slots of openpi's models -> the columns of its own conversions of LIBERO, DROID and ALOHA, and of LeRobot's.
OPENPI_COLUMNS = {
    "base_0_rgb": (
        "image",
        "observation.images.image",
        "exterior_image_1_left",
        "observation.images.exterior_1_left",
        "observation.images.cam_high",
    ),
    "left_wrist_0_rgb": (
        "wrist_image",
        "observation.images.wrist_image",
        "observation.images.image2",
        "wrist_image_left",
        "observation.images.wrist_left",
        "observation.images.cam_left_wrist",
    ),
    "right_wrist_0_rgb": ("observation.images.cam_right_wrist",),
}
#: openpi masks it for robots with one hand.
_OPTIONAL_SLOTS = ("right_wrist_0_rgb",)
#: Numbers of state and actions of openpi's models, into which those of a robot are padded.
_PADDED = 32
_EMPTY_CAMERA = f"{IMAGES}empty_camera_"


def lerobot_robot(stated: LerobotConfig, rename: Mapping[str, str], data: RobotData) -> Robot:
    """Return the robot of a data set for a LeRobot checkpoint, whose config.json lists its features.

    rename: columns -> features, of its saved pipeline. Raises `BadArgument` or `UnknownName` where a camera of the
    policy has no pictures, or state or actions have other sizes.
    """
    usual: dict[str, list[str]] = {}
    for column, feature in rename.items():
        usual.setdefault(feature, []).append(column)
    optional = [camera for camera in stated.cameras if camera.startswith(_EMPTY_CAMERA)]
    cameras = data.match_cameras(stated.cameras, usual, optional)
    state, actions = data.state_columns(), data.action_columns()
    data.check_size("states", "--state", state, stated.state_dim)
    if actions:
        data.check_size("actions", "--action", actions, stated.action_dim)
    if data.relative_actions:
        raise BadArgument("--relative-actions is for openpi's checkpoints; a LeRobot checkpoint says it itself.")
    return Robot(
        cameras={camera.removeprefix(IMAGES): column for camera, column in cameras.items()},
        state=state,
        state_dim=stated.state_dim,
        actions=actions,
        action_dim=stated.action_dim,
    )


def openpi_robot(data: RobotData, stats: NormStats | None, relative_actions: int = 0) -> Robot:
    """Return the robot of a data set for an openpi checkpoint, whose statistics tell the sizes.

    stats: None for random weights, which take any sizes up to openpi's. relative_actions: as the policy's configuration
    says.
    """
    cameras = data.match_cameras(CAMERA_SLOTS, OPENPI_COLUMNS, _OPTIONAL_SLOTS)
    state, actions = data.state_columns(), data.action_columns()
    state_dim, action_dim = data.size(state), data.size(actions)
    if stats is not None:
        # Older checkpoints hold statistics padded to the model's size, which say nothing of the robot.
        if len(stats.state.mean) != _PADDED:
            data.check_size("states", "--state", state, len(stats.state.mean))
        if len(stats.actions.mean) != _PADDED and actions:
            data.check_size("actions", "--action", actions, len(stats.actions.mean))
        action_dim = action_dim or len(stats.actions.mean)
    for what, size in (("state", state_dim), ("actions", action_dim)):
        if size > _PADDED:
            raise BadArgument(
                f"The {what} of the data set '{data.name}' have {size} numbers; openpi's models take {_PADDED} at most."
            )
    relative = relative_actions if data.relative_actions is None else data.relative_actions
    if not 0 <= relative <= min(state_dim, action_dim or _PADDED):
        raise BadArgument(
            f"Cannot use --relative-actions {relative}: the state has {state_dim} numbers and an action {action_dim}."
        )
    return Robot(cameras, state, state_dim, actions, action_dim or _PADDED, relative)
