"""VLA-JEPA of LeRobot: Qwen 3 VL, whose "embodied" tokens alone are read by the action head.

Words and pictures are keys in Qwen only. Its embodied tokens are the queries that carry them to the actions; an action
reads those tokens (`cross`), the state and the other actions (`self`), and none of the words.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from vla_attention.capture.torch_policies.layouts.layout_building import (
    LEROBOT_06,
    FoundModule,
    KeyOrder,
    camera_name,
    prompt_with_pictures,
    qwen_pictures,
)
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, PromptText

_NAME = "vla_jepa"


def vla_jepa(policy: object, batch: Mapping[str, Any], *, head: bool = False, prompt_tokens: int = 0) -> PolicyLayout:
    """Return the layout of a `VLAJEPAPolicy`, or of an object that holds one.

    Site `joint`, in Qwen, once a call: pictures, prompt, tokens for frames, embodied tokens, which are the queries.
    With `head`, the action head's sites instead, at every denoise step: `cross` (embodied tokens) in even blocks,
    `self` (state, learned tokens, actions) in odd ones. No key there is a picture or a word. The tokenizer is
    `policy.model.qwen.processor.tokenizer`.

    Args:
        batch: of one environment, as LeRobot's processor gives it to the policy.
        head: record the action head.
        prompt_tokens: the longest text between the last picture and the tokens for frames; 0: twice that of `batch`.

    Raises:
        NotThisPolicy: no VLAJEPAPolicy.
    """
    found = FoundModule(policy, ("VLAJEPAPolicy",), _NAME)
    return _head(found) if head else _language_model(found, batch, prompt_tokens)


def _language_model(found: FoundModule, batch: Mapping[str, Any], prompt_tokens: int) -> PolicyLayout:
    config, model = found.module.config, found.module.model
    vlm = model.qwen.model.config
    given = found.module._prepare_model_inputs(dict(batch), training=False)
    inputs = model.qwen.build_inputs(
        given["images"], given["instructions"], model.replace_prompt, model.embodied_replace_prompt
    )
    ids = [int(token) for token in inputs["input_ids"][0]]
    frames = [place for place, token in enumerate(ids) if token in model.action_token_ids]
    embodied = [place for place, token in enumerate(ids) if token == model.embodied_action_token_id]
    cameras = [camera_name(feature) for feature in config.image_features]
    pictures = qwen_pictures(inputs["image_grid_thw"].tolist(), vlm.vision_config)
    keys, texts = prompt_with_pictures(
        ids[: (frames or embodied)[0]], vlm.image_token_id, cameras, pictures, prompt_tokens, _NAME
    )
    keys.add("frame_tokens", "state", len(frames), "learned")
    between = embodied[0] - frames[-1] - 1 if frames else 0
    keys.add("prompt_between", "text", between, "template")
    keys.add("embodied", "state", len(embodied), "learned")
    behind = len(ids) - embodied[-1] - 1
    keys.add("prompt_end", "text", behind, "template")
    return keys.layout(
        _NAME,
        (-len(embodied) - behind, -behind or None),
        (vlm.text_config.num_hidden_layers, vlm.text_config.num_attention_heads),
        [
            found.rule(
                r"model\.qwen\.model\.model\.language_model\.layers\.(?P<block>\d+)\.self_attn", "joint", tokens="joint"
            ),
            found.rule(r"model\.qwen\.model\.model\.visual\..*"),
            found.rule(r"model\.action_model\..*"),
        ],
        cameras,
        text=PromptText(
            (*texts, *["prompt_between"] * bool(between), "prompt_end"),
            found.inside("model.qwen.model.model.language_model.embed_tokens"),
            skip_ids=(vlm.image_token_id, *model.action_token_ids, model.embodied_action_token_id),
        ),
        action_horizon=config.chunk_size,
        action_dim=config.action_dim,
        versions=LEROBOT_06,
    )


def _head(found: FoundModule) -> PolicyLayout:
    config, head = found.module.config, found.module.model.action_model
    blocks, steps = head.model.transformer_blocks, config.num_inference_timesteps
    learned = config.num_embodied_action_tokens_per_instruction
    context, tokens = KeyOrder(), KeyOrder()
    context.add("embodied", "state", learned, "learned")
    tokens.add("state", "state", int(found.module.config.robot_state_feature is not None), "state")
    tokens.add("learned", "state", learned, "learned")
    tokens.add("actions", "action", config.chunk_size, "action")
    queries = (-config.chunk_size, None)

    def numbers(is_cross: bool) -> tuple[int, ...]:
        return tuple(number for number, block in enumerate(blocks) if block.is_cross_attention == is_cross)

    def places(layers: Sequence[int]) -> str:
        return rf"model\.action_model\.model\.transformer_blocks\.(?P<block>{'|'.join(map(str, layers))})\.attn1"

    sites = {"cross": (context, numbers(True)), "self": (tokens, numbers(False))}
    return PolicyLayout(
        name="vla_jepa_head",
        family="vla_jepa_head",
        sites=tuple(keys.site(name, queries, layers=layers) for name, (keys, layers) in sites.items()),
        rules=(
            *(found.rule(places(layers), name) for name, (_, layers) in sites.items()),
            found.rule(r"model\.qwen\..*"),
        ),
        num_layers=len(blocks),
        num_heads=blocks[0].attn1.heads,
        num_denoise_steps=steps,
        denoise_times=tuple(step / steps for step in range(steps)),
        action_horizon=config.chunk_size,
        action_dim=config.action_dim,
        versions=LEROBOT_06,
    )
