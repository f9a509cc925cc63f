"""Tokens as pi0.5 has them in LIBERO: three cameras of 16 x 16 patches (one of them masked), 200 prompt slots, ten actions."""

from __future__ import annotations

import numpy as np

from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, ObjectKind, SceneObject
from vla_attention.schemas.layout import PatchGrid, Piece, Prompt, Role, SiteLayout, Span

WORDS = ["put", "both", "the", "alphabet", "soup", "and", "the", "tomato", "sauce", "in", "the", "basket"]
_KINDS: dict[str, ObjectKind] = {
    "alphabet_soup_1": "object",
    "tomato_sauce_1": "object",
    "basket_1": "object",
    "cream_cheese_1": "object",
    "milk_1": "object",
    "robot": "robot",
    "background": "background",
}


def libero_tokens(replans: int, seed: int = 0) -> EpisodeTokens:
    """An episode's tokens; the state is written into the prompt, so that every replan has another one. Objects lie anywhere."""
    spans = []
    for i, camera in enumerate(("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")):
        grid = PatchGrid(16, 16, 224, 224)
        spans.append(Span(camera, "image", 256 * i, 256 * (i + 1), camera=camera, grid=grid))
    spans += [Span("prompt", "text", 768, 968), Span("actions", "action", 968, 978)]
    layout = SiteLayout("joint", tuple(spans))
    generator = np.random.default_rng(seed)
    prompts, roles = [], np.zeros((replans, layout.num_keys), dtype=np.uint8)
    for replan in range(replans):
        roles[replan, :512], roles[replan, 512:768], roles[replan, 968:] = Role.IMAGE, Role.MASKED_IMAGE, Role.ACTION
        roles[replan, 768:968], roles[replan, 768] = Role.PADDING, Role.BOS
        pieces, position = [], 0
        digits = [str(generator.integers(256)) for _ in range(8)]
        for i, text in enumerate([*WORDS, *digits]):
            length = len(text) + (i > 0)
            pieces.append(Piece(769 + i, (" " if i else "") + text, position, position + length))
            roles[replan, 769 + i] = Role.INSTRUCTION if i < len(WORDS) else Role.STATE
            position += length
        prompts.append(Prompt(" ".join([*WORDS, *digits]), tuple(pieces), (0, len(" ".join(WORDS)))))
    objects = tuple(SceneObject(name, kind, i < 3) for i, (name, kind) in enumerate(_KINDS.items()))
    coverage = {
        camera: generator.dirichlet(np.full(len(objects), 0.2), (replans, 256)).astype(np.float32)
        for camera in layout.cameras[:2]
    }
    return EpisodeTokens(layout, roles, tuple(prompts), np.arange(replans), objects, coverage)
