"""MolmoAct2 of LeRobot: action tokens that read each other (`self`), then Molmo's tokens (`cross`), in every block.

The keys and values of `cross` in block n are those of Molmo's own block n, projected once more. Where pictures and
state are among the text is read from one call's ids.
"""

from __future__ import annotations

from collections.abc import Sequence

from vla_attention.capture.torch_policies.layouts.layout_building import (
    LEROBOT_06,
    FoundModule,
    KeyOrder,
    NotThisPolicy,
    prompt_with_pictures,
)
from vla_attention.capture.torch_policies.policy_layout import CameraPicture, PolicyLayout, PromptText

_NAME = "molmoact2"


def molmoact2(
    policy: object, input_ids: Sequence[int], *, cameras: Sequence[str], prompt_tokens: int = 0
) -> PolicyLayout:
    """Return the layout of a `MolmoAct2Policy` that acts by flow matching, or of an object that holds one.

    Sites: `self` (keys: the actions of the chunk) and `cross` (keys: pictures and text). A picture's 14 x 14 tokens
    stand for 27 x 27 patches, two by two: maps are off by half a token at the right and lower edge. The tokenizer is
    `processor.tokenizer` of the step `MolmoAct2PackInputsProcessorStep` of LeRobot's processor.

    Args:
        input_ids: the ids of one call without padding, (token,): `batch["input_ids"][0]` behind LeRobot's processor.
        cameras: names of the pictures, in the order of their tokens.
        prompt_tokens: the longest text between the last picture and the state, in tokens; 0: twice that of `input_ids`.

    Raises:
        NotThisPolicy: no MolmoAct2Policy, one that writes its actions as tokens, or one that replays CUDA graphs.
        BadArgument: the ids do not hold one picture for each camera, as those of several crops.
    """
    config = FoundModule(policy, ("MolmoAct2Policy",), _NAME).module.config
    if "discrete" in (config.action_mode, config.inference_action_mode):
        raise NotThisPolicy(
            f"This MolmoAct2 writes its actions as tokens (action_mode='{config.action_mode}', inference_action_mode="
            f"'{config.inference_action_mode}'); expected inference_action_mode='continuous'."
        )
    if config.enable_inference_cuda_graph:
        raise NotThisPolicy(
            "This MolmoAct2 replays its denoise steps as a CUDA graph on a GPU (enable_inference_cuda_graph=True, "
            "LeRobot's default), in which no attention is seen. Load it with enable_inference_cuda_graph=False, or set "
            "policy.config.enable_inference_cuda_graph = False and call policy.eval(), before its first call."
        )
    found = FoundModule(policy, ("MolmoAct2Model",), _NAME)
    model = found.module.config
    placeholder, size = model.image_patch_id, model.vit_config.image_default_input_size[0]
    ids = [int(token) for token in input_ids]
    first = model.state_token_start_id
    states = range(first, first + model.num_state_tokens) if first is not None else range(0)
    numbers = [place for place, token in enumerate(ids) if token in states]
    start, stop = (numbers[0], numbers[-1] + 1) if numbers else (len(ids), len(ids))
    prompt, texts = prompt_with_pictures(ids[:start], placeholder, cameras, size, prompt_tokens, _NAME)
    prompt.add("state", "state", stop - start, "state")
    prompt.add("prompt_end", "text", len(ids) - stop, "template")
    returned = min(config.n_action_steps, config.chunk_size)
    chunk = KeyOrder()
    chunk.add("actions", "action", returned, "action")
    chunk.add("later_actions", "action", config.chunk_size - returned, "action")
    steps, queries = config.num_inference_steps or model.flow_matching_num_steps, (0, returned)
    return PolicyLayout(
        name=_NAME,
        family=_NAME,
        sites=(prompt.site("cross", queries, variable="prompt"), chunk.site("self", queries)),
        rules=(
            found.rule(r"action_expert\.blocks\.(?P<block>\d+)\.cross_attn", "cross"),
            found.rule(r"action_expert\.blocks\.(?P<block>\d+)\.self_attn", "self"),
            found.rule(r"transformer\..*", tokens="cross"),
            found.rule(r"vision_backbone\..*"),
        ),
        num_layers=model.action_expert_config.num_layers,
        num_heads=model.action_expert_config.num_heads,
        num_denoise_steps=steps,
        denoise_times=tuple(step / steps for step in range(steps)),
        cameras=tuple(CameraPicture(camera) for camera in cameras),
        text=PromptText(
            (*texts, "prompt_end") if stop < len(ids) else tuple(texts),
            found.inside("transformer.wte"),
            skip_ids=(placeholder, *states),
        ),
        action_horizon=returned,
        action_dim=config.action_feature.shape[0],
        versions=LEROBOT_06,
    )
