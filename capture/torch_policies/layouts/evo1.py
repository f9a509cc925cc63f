"""EVO-1 of LeRobot: action tokens that read InternVL 3's tokens and the state, but not each other (`cross`).

InternVL's language model has mixed pictures and words before: keys are named by their positions. Views without a camera
are masked. Every prompt has `Image-1: ` and so on before its pictures, and the task behind the last one.
"""

from __future__ import annotations

from vla_attention.capture.torch_policies.layouts.layout_building import (
    LEROBOT_06,
    FoundModule,
    NotThisPolicy,
    camera_name,
    prompt_with_pictures,
)
from vla_attention.capture.torch_policies.policy_layout import CameraPicture, PolicyLayout, PromptText

_NAME = "evo1"


def evo1(policy: object) -> PolicyLayout:
    """Return the layout of an `Evo1Policy`, or of an object that holds one.

    Site `cross`: the views and the text around them, as the policy's own tokenizer writes them, the prompt, the state.

    Raises:
        NotThisPolicy: no Evo1Policy, or one whose actions read a single token of all pictures and words.
    """
    found = FoundModule(policy, ("Evo1Policy",), _NAME)
    config, embedder = found.module.config, found.module.model.embedder
    if config.return_cls_only:
        raise NotThisPolicy(
            "This EVO-1 has return_cls_only=True: its actions read one token of all pictures and words, and the state. "
            "Attention cannot tell pictures from words there; expected return_cls_only=False."
        )
    cameras = [camera_name(feature) for feature in config.image_features]
    views = cameras + [f"empty_view_{number}" for number in range(len(cameras), config.max_views)]
    texts = embedder._build_multimodal_prompts([[1] * len(views)], [""])
    ids, placeholder = embedder.tokenizer(texts)["input_ids"][0], embedder.img_context_token_id
    longest = config.max_text_length - len(ids) + ids[::-1].index(placeholder)
    keys, spans = prompt_with_pictures(ids, placeholder, views, embedder.image_size, longest, _NAME)
    keys.add("state", "state", 1, "state")
    steps = config.num_inference_timesteps
    return PolicyLayout(
        name=_NAME,
        family="evo1",
        sites=(keys.site("cross", (0, config.chunk_size), variable=spans[-1]),),
        rules=(
            found.rule(r"model\.action_head\.transformer_blocks\.(?P<block>\d+)\.attn", "cross"),
            found.rule(r"model\.embedder\.model\.language_model\..*", tokens="cross"),
            found.rule(r"model\.embedder\..*"),
        ),
        num_layers=config.num_layers,
        num_heads=config.num_heads,
        num_denoise_steps=steps,
        denoise_times=tuple(step / steps for step in range(steps)),
        cameras=tuple(CameraPicture(view) for view in views),
        text=PromptText(
            tuple(spans), found.inside("model.embedder.model.language_model.embed_tokens"), skip_ids=(placeholder,)
        ),
        action_horizon=config.chunk_size,
        action_dim=config.max_action_dim,
        versions=LEROBOT_06,
    )
