"""WALL-X (WALL-OSS) of LeRobot: Qwen 2.5 VL with experts; its last tokens are the noisy actions, which see each other.

All tokens are computed again at every denoise step. Where they are is read from one batch.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vla_attention.capture.torch_policies.layouts.layout_building import (
    LEROBOT_06,
    FoundModule,
    NotThisPolicy,
    camera_name,
    prompt_with_pictures,
    qwen_pictures,
)
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, PromptText

_NAME = "wall_x"
#: What LeRobot's policy never changes.
_STEPS = 10


def wall_x(policy: object, batch: Mapping[str, Any], *, prompt_tokens: int = 0) -> PolicyLayout:
    """Return the layout of a `WallXPolicy` that acts by flow matching, or of an object that holds one.

    Site `joint`: each camera's patches and the text around them, the prompt, the state, the actions. The tokenizer is
    `policy.model.processor.tokenizer`.

    Args:
        batch: of one environment, as LeRobot's processor gives it to the policy.
        prompt_tokens: the longest text between the last picture and the state, in tokens; 0: twice that of `batch`.

    Raises:
        NotThisPolicy: no WallXPolicy, one that writes its actions as tokens, or one whose pictures are encoded by
            attention that gives no rows.
    """
    found = FoundModule(policy, ("WallXPolicy",), _NAME)
    config, model = found.module.config, found.module.model.config
    for name, wanted in (("prediction_mode", "diffusion"), ("vision_attn_implementation", "sdpa")):
        if getattr(config, name) != wanted:
            raise NotThisPolicy(
                f"This WALL-X has {name}='{getattr(config, name)}'; expected '{wanted}'. Load the policy with it."
            )
    inputs = found.module.preprocess_inputs(dict(batch))
    ids = [int(token) for token in inputs["input_ids"][0]]
    special = found.module.model.action_token_id_set
    state, action = special["propri_token_id"], special["action_token_id"]
    place, start = ids.index(state), ids.index(action)
    cameras = [camera_name(feature) for feature in config.image_features if feature in batch]
    pictures = qwen_pictures(inputs["image_grid_thw"].tolist(), model.vision_config)
    keys, texts = prompt_with_pictures(ids[:place], model.image_token_id, cameras, pictures, prompt_tokens, _NAME)
    keys.add("state", "state", 1, "state")
    keys.add("prompt_end", "text", start - place - 1, "template")
    keys.add("actions", "action", config.chunk_size, "action")
    return keys.layout(
        _NAME,
        (-config.chunk_size, None),
        (model.text_config.num_hidden_layers, model.text_config.num_attention_heads),
        [
            found.rule(r"model\.model\.layers\.(?P<block>\d+)\.self_attn", "joint", tokens="joint"),
            found.rule(r"model\.visual\..*"),
        ],
        cameras,
        num_denoise_steps=_STEPS,
        denoise_times=tuple(step / _STEPS for step in range(_STEPS)),
        text=PromptText(
            (*texts, "prompt_end"),
            found.inside("model.model.embed_tokens"),
            skip_ids=(model.image_token_id, state, action),
        ),
        action_horizon=config.chunk_size,
        action_dim=config.action_feature.shape[0],
        versions=LEROBOT_06,
    )
