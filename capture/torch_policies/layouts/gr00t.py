"""GR00T N1.5 and N1.7: a diffusion transformer over state and action tokens, which reads a vision-language model.

N1.5 (LeRobot 0.4, 0.5): even blocks read all tokens of that model (`cross`), odd ones the state, learned and action
tokens (`self`). N1.7 (LeRobot 0.6): even blocks take turns between the text only (`cross_text`) and the pictures only
(`cross_image`), so that a ratio of both inside one block is undefined.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Any

from vla_attention.capture.torch_policies.layouts.layout_building import (
    FoundModule,
    KeyOrder,
    NotThisPolicy,
    prompt_with_pictures,
)
from vla_attention.capture.torch_policies.policy_layout import CameraPicture, PolicyLayout, PromptText

_NAME = "gr00t"


def gr00t(
    policy: object,
    input_ids: Sequence[int],
    *,
    cameras: Sequence[str],
    picture_size: int = 224,
    prompt_tokens: int = 0,
    image_token: int | None = None,
    state_tokens: int = 1,
) -> PolicyLayout:
    """Return the layout of a `GR00TN15` or `GR00TN17` model, or of an object that holds one (LeRobot's `GrootPolicy`).

    Where the pictures are among the text is read from one call's ids: its chat template is the processor's.

    Args:
        input_ids: the ids of one call without padding, (token,): `batch["eagle_input_ids"][0]`, or `input_ids`.
        cameras: names of the pictures, in the order of their tokens.
        picture_size: height and width of the pictures as the model gets them.
        prompt_tokens: the longest text after the last picture, in tokens; 0: twice that of `input_ids`.
        image_token: the id of the placeholder for a patch; None: the model's configuration says it.
        state_tokens: number of state tokens.

    Raises:
        NotThisPolicy: no GR00TN15 or GR00TN17.
        BadArgument: the ids do not hold one picture for each camera.
    """
    found = FoundModule(policy, ("GR00TN15", "GR00TN17"), _NAME)
    head = found.module.action_head
    placeholder = _placeholder(found.module.backbone) if image_token is None else image_token
    ids = [int(token) for token in input_ids]
    keys, texts = prompt_with_pictures(ids, placeholder, cameras, picture_size, prompt_tokens, _NAME)
    blocks = len(head.model.transformer_blocks)
    interleaved = bool(head.model.config.interleave_self_attention)
    self_blocks = tuple(range(1, blocks, 2)) if interleaved else ()
    cross = tuple(block for block in range(blocks) if block not in self_blocks)
    horizon = int(head.action_horizon)
    learned = head.future_tokens.num_embeddings if hasattr(head, "future_tokens") else 0
    queries = (-horizon, None)
    every = getattr(head.model, "attend_text_every_n_blocks", None)
    groups = {"cross": cross}
    if every is not None:
        text = tuple(block for block in cross if block % (2 * every) == 0)
        groups = {"cross_text": text, "cross_image": tuple(block for block in cross if block not in text)}
    groups = {name: layers for name, layers in groups.items() if layers}
    sites = [keys.site(name, queries, layers=layers, variable=texts[-1]) for name, layers in groups.items()]
    if self_blocks:
        tokens = KeyOrder()
        tokens.add("state", "state", state_tokens, "state")
        tokens.add("learned", "state", learned, "learned")
        tokens.add("actions", "action", horizon, "action")
        groups["self"] = self_blocks
        sites.append(tokens.site("self", queries, layers=self_blocks))
    steps, head_blocks = int(head.num_inference_timesteps), r"action_head\.model\.transformer_blocks\."
    return PolicyLayout(
        name="gr00t_n1.7" if every is not None else "gr00t_n1.5",
        family="gr00t",
        sites=tuple(sites),
        rules=(
            *(
                found.rule(rf"{head_blocks}(?P<block>{'|'.join(map(str, groups[name]))})\.attn1", name)
                for name in groups
            ),
            found.rule(r"action_head\.vl_self_attention\..*"),
            found.rule(r"backbone\..*"),
        ),
        num_layers=blocks,
        num_heads=head.model.config.num_attention_heads,
        num_denoise_steps=steps,
        denoise_times=tuple(step / steps for step in range(steps)),
        cameras=tuple(CameraPicture(camera) for camera in cameras),
        text=PromptText(tuple(texts), _embedding(found), skip_ids=(placeholder,)),
        action_horizon=horizon,
        action_dim=int(head.action_dim),
        versions={"lerobot": ("0.4.", "0.5.") if every is None else ("0.6.",)},
    )


def _placeholder(backbone: Any) -> int:
    for path in ("eagle_model.image_token_index", "model.config.image_token_id"):
        try:
            return int(attrgetter(path)(backbone))
        except AttributeError:
            continue
    raise NotThisPolicy("The model does not say which id stands for a patch; give gr00t(..., image_token=...).")


def _embedding(found: FoundModule) -> str:
    names = (
        *("backbone.eagle_model.language_model.model.embed_tokens", "backbone.model.language_model.embed_tokens"),
        "backbone.model.model.language_model.embed_tokens",
    )
    known = dict(found.module.named_modules())
    for name in names:
        if name in known:
            return found.inside(name)
    raise NotThisPolicy(
        f"The model's text embedding is at none of the places of GR00T N1.5 and N1.7: {', '.join(names)}."
    )
