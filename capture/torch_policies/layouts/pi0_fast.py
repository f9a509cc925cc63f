"""pi0-FAST of LeRobot: PaliGemma writes action tokens one after another; each token is one action query.

The first token's query is the last of the prefix (its closing BOS), the others' are the tokens before them. The policy
always writes `max_decoding_steps` tokens, with or without a cache of keys.
"""

from __future__ import annotations

from vla_attention.capture.torch_policies.layouts.find_policy import camera_name, find_policy, inside, rule_path
from vla_attention.capture.torch_policies.layouts.key_order import KeyOrder
from vla_attention.capture.torch_policies.policy_layout import CallRule, CameraPicture, PolicyLayout, PromptText

_NAME = "pi0_fast"


def pi0_fast(policy: object) -> PolicyLayout:
    """Return the layout of a `PI0FastPolicy`, or of an object that holds one.

    Site `joint`: each camera's patches, the prompt (with its padding and a BOS that ends it), the tokens so far.

    Raises:
        NotThisPolicy: no PI0FastPolicy.
    """
    path, found = find_policy(policy, ("PI0FastPolicy",), _NAME)
    config = found.config
    paligemma = found.model.paligemma_with_expert.paligemma
    vision, text = paligemma.config.vision_config, paligemma.config.text_config
    height, width = config.image_resolution
    keys = KeyOrder()
    cameras = [camera_name(feature) for feature in config.image_features]
    for camera in cameras:
        keys.add_picture(camera, height // vision.patch_size, width // vision.patch_size, height, width)
    keys.add("prompt", "text", config.tokenizer_max_length + 1, "instruction")
    keys.add_growing("action_tokens", config.max_decoding_steps - 1)
    decoder = inside(path, "model.paligemma_with_expert.paligemma.model.language_model")
    site = keys.site("joint", (-1, None), projection=f"{decoder}.layers.{{block}}.self_attn.o_proj", variable="prompt")
    return PolicyLayout(
        name=_NAME,
        family="pi0_fast",
        sites=(site,),
        rules=(
            CallRule(rule_path(decoder, r"layers\.(?P<block>\d+)\.self_attn"), "joint"),
            CallRule(rule_path(path, r".*vision_tower\..*"), None),
        ),
        num_layers=text.num_hidden_layers,
        num_heads=text.num_attention_heads,
        cameras=tuple(CameraPicture(camera, "pad") for camera in cameras),
        text=PromptText(("prompt",), f"{decoder}.embed_tokens", state_between=("State:", ";")),
        action_horizon=config.n_action_steps,
        action_dim=config.action_feature.shape[0],
        autoregressive=True,
        num_action_tokens=config.max_decoding_steps,
        versions={"lerobot": ("0.4.",)},
    )
