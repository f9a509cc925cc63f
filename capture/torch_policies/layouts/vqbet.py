"""VQ-BeT of LeRobot: a GPT over the last observations, whose current action token sees all tokens before it.

Of each observation there is one token of the picture, one of the state, and one that asks for an action. There is no
text: VQ-BeT reads no instruction, and ratios of vision to language are undefined.
"""

from __future__ import annotations

from vla_attention.capture.torch_policies.layouts.layout_building import LEROBOT, FoundModule, KeyOrder, camera_name
from vla_attention.capture.torch_policies.policy_layout import CameraPicture, PolicyLayout
from vla_attention.schemas.layout import PatchGrid

_NAME = "vqbet"


def vqbet(policy: object) -> PolicyLayout:
    """Return the layout of a `VQBeTPolicy`, or of an object that holds one.

    Site `self` (keys: of each observation, the oldest first, the whole picture, the state, the action token; then the
    tokens of later chunks, which the query does not see). The query is the last observation's action token.

    Raises:
        NotThisPolicy: no VQBeTPolicy.
    """
    found = FoundModule(policy, ("VQBeTPolicy",), _NAME)
    config = found.module.config
    cameras = {camera_name(feature): config.image_features[feature].shape for feature in config.image_features}
    keys = KeyOrder()
    for step in range(config.n_obs_steps):
        for camera, (_, height, width) in cameras.items():
            grid = PatchGrid(1, 1, *(config.crop_shape or (height, width)))
            keys.add(f"{camera}_{step}", "image", 1, "image", camera=camera, grid=grid)
        keys.add(f"state_{step}", "state", 1, "state")
        keys.add(f"action_token_{step}", "state", 1, "learned")
    query = keys.num_keys - 1
    keys.add("later_action_tokens", "state", config.n_action_pred_token - 1, "learned")
    return PolicyLayout(
        name=_NAME,
        family=_NAME,
        sites=(keys.site("self", (query, query + 1)),),
        rules=(
            found.rule(r"vqbet\.policy\.transformer\.h\.(?P<block>\d+)\.attn", "self", tokens="self"),
            found.rule(r"vqbet\.rgb_encoder\..*"),
        ),
        num_layers=config.gpt_n_layer,
        num_heads=config.gpt_n_head,
        cameras=tuple(CameraPicture(camera) for camera in cameras),
        action_horizon=config.action_chunk_size,
        action_dim=config.action_feature.shape[0],
        versions=LEROBOT,
    )
