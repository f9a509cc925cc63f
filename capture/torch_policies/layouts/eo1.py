"""EO-1 of LeRobot: Qwen 2.5 VL, whose last tokens are the noisy actions. An action sees those before it.

The prefix is computed once: system text, pictures, the state, the task. Where they are is read from one batch.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vla_attention.capture.torch_policies.layouts.layout_building import (
    LEROBOT_06,
    FoundModule,
    camera_name,
    qwen_pictures,
    text_and_pictures,
)
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, PromptText
from vla_attention.schemas.errors import BadArgument

_NAME = "eo1"


def eo1(policy: object, batch: Mapping[str, Any], *, prompt_tokens: int = 0) -> PolicyLayout:
    """Return the layout of an `EO1Policy`, or of an object that holds one.

    Site `joint`: each camera's patches and the text around them, the state, the prompt, the actions. The tokenizer is
    `_processor.tokenizer` of the step `EO1QwenProcessorStep` of LeRobot's processor.

    Args:
        batch: of one environment, as LeRobot's processor gives it to the policy, without padding.
        prompt_tokens: the longest text between the state and the actions, in tokens; 0: twice that of `batch`.

    Raises:
        NotThisPolicy: no EO1Policy.
        BadArgument: the batch has no state token or no action tokens, or not one picture for each camera.
    """
    found = FoundModule(policy, ("EO1Policy",), _NAME)
    config, model = found.module.config, found.module.model.vlm_backbone.config
    ids = [int(token) for token in batch["input_ids"][0]]
    state, action = int(batch["state_token_id"]), int(batch["action_token_id"])
    if not (state in ids and action in ids and ids.index(state) < ids.index(action)):
        raise BadArgument(
            f"The ids of the batch hold {ids.count(state)} state tokens (id {state}) and {ids.count(action)} action "
            f"tokens (id {action}); expected a state token before {config.chunk_size} action tokens."
        )
    first, start = ids.index(state), ids.index(action)
    cameras = [camera_name(feature) for feature in config.image_features]
    pictures = qwen_pictures(batch["image_grid_thw"].tolist(), model.vision_config)
    keys, texts = text_and_pictures(ids[:first], model.image_token_id, cameras, pictures, _NAME)
    keys.add("state", "state", 1, "state")
    keys.add("prompt", "text", prompt_tokens or 2 * (start - first - 1), "instruction")
    keys.add("actions", "action", config.chunk_size, "action")
    layers = r"model\.vlm_backbone\.model\.language_model\.layers\.(?P<block>\d+)\.self_attn"
    steps = config.num_denoise_steps
    return keys.layout(
        _NAME,
        (-config.chunk_size, None),
        (model.text_config.num_hidden_layers, model.text_config.num_attention_heads),
        [
            found.rule(layers, "joint", queries=config.chunk_size),
            found.rule(layers, tokens="joint"),
            found.rule(r"model\.vlm_backbone\.model\.visual\..*"),
        ],
        cameras,
        num_denoise_steps=steps,
        denoise_times=tuple(1.0 - step / steps for step in range(steps)),
        text=PromptText(
            (*texts, "prompt"),
            found.inside("model.vlm_backbone.model.language_model.embed_tokens"),
            skip_ids=(model.image_token_id, state, action),
            skip_last=len(ids) - start - config.chunk_size,
        ),
        action_horizon=config.chunk_size,
        action_dim=config.action_feature.shape[0],
        versions=LEROBOT_06,
    )
