"""ACT of LeRobot: a decoder with one query per action, which reads itself (`self`) and the encoder's tokens (`cross`).

Keys of `cross`: the latent (zeros when acting), the state, the environment's state, and each camera's feature map.
There is no text: ACT reads no instruction, and ratios of vision to language are undefined.
"""

from __future__ import annotations

from vla_attention.capture.torch_policies.layouts.layout_building import LEROBOT, FoundModule, KeyOrder, camera_name
from vla_attention.capture.torch_policies.policy_layout import CameraPicture, PolicyLayout

_NAME = "act"
#: Pixels of the picture for one token, with and without LeRobot's `replace_final_stride_with_dilation`.
_STRIDE, _STRIDE_DILATED = 32, 16


def act(policy: object) -> PolicyLayout:
    """Return the layout of an `ACTPolicy`, or of an object that holds one.

    Sites: `cross` (keys: latent, state, feature maps of the cameras) and `self` (keys: the chunk's queries).

    Raises:
        NotThisPolicy: no ACTPolicy.
    """
    found = FoundModule(policy, ("ACTPolicy",), _NAME)
    config = found.module.config
    keys = KeyOrder()
    keys.add("latent", "state", 1, "learned")
    keys.add("state", "state", int(bool(config.robot_state_feature)), "state")
    keys.add("environment_state", "state", int(bool(config.env_state_feature)), "state")
    stride = _STRIDE_DILATED if config.replace_final_stride_with_dilation else _STRIDE
    cameras = {camera_name(feature): tuple(config.image_features[feature].shape) for feature in config.image_features}
    for camera, (_, height, width) in cameras.items():
        keys.add_picture(camera, -(-height // stride), -(-width // stride), height, width)
    chunk = KeyOrder()
    chunk.add("actions", "action", config.chunk_size, "action")
    queries = (0, config.chunk_size)
    return PolicyLayout(
        name=_NAME,
        family="act",
        sites=(keys.site("cross", queries), chunk.site("self", queries)),
        rules=(
            found.rule(r"model\.decoder\.layers\.(?P<block>\d+)\.multihead_attn", "cross"),
            found.rule(r"model\.decoder\.layers\.(?P<block>\d+)\.self_attn", "self"),
            found.rule(r"model\.encoder\..*", tokens="cross"),
            found.rule(r"model\.vae_encoder\..*"),
        ),
        num_layers=config.n_decoder_layers,
        num_heads=config.n_heads,
        cameras=tuple(CameraPicture(camera) for camera in cameras),
        action_horizon=config.chunk_size,
        action_dim=config.action_feature.shape[0],
        versions=LEROBOT,
    )
