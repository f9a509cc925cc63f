"""The key axes of the two attention sites: latent frames for `self`, text positions for `cross`."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.policies.cosmos.config import CosmosConfig
from vla_attention.capture.policies.cosmos.preprocess import visible_area
from vla_attention.schemas.layout import PatchGrid, Role, SiteLayout, Span, roles_from_spans
from vla_attention.schemas.stores.store_format import PolicyCameraView

SELF: Final = "self"
CROSS: Final = "cross"
TEXT_SPAN = "text"

#: Latent frame -> the simulator's camera that it shows now.
CAMERA_OF_FRAME = {"wrist": "robot0_eye_in_hand", "primary": "agentview"}

_ROLES = {
    "blank": Role.BLANK,
    "proprio": Role.PROPRIO,
    "wrist": Role.IMAGE,
    "primary": Role.IMAGE,
    "action": Role.ACTION,
    "value": Role.VALUE,
}


def patch_grid(config: CosmosConfig) -> PatchGrid:
    """Return how the tokens of an image frame tile the model's image."""
    rows, columns = config.dit.grid(config.latent_size, config.latent_size)
    return PatchGrid(rows, columns, config.image_size, config.image_size)


def cameras(config: CosmosConfig) -> tuple[PolicyCameraView, ...]:
    """Return the cameras in key order: wrist, then primary."""
    return tuple(
        PolicyCameraView(name, source=CAMERA_OF_FRAME[name], upright=True, mirrored=False, visible=visible_area())
        for name in config.frames.names
        if name in CAMERA_OF_FRAME
    )


def self_layout(config: CosmosConfig) -> SiteLayout:
    """Return the key axis of self-attention: one span of kind `latent` per latent frame."""
    tokens = config.tokens_per_frame
    spans = []
    for number, name in enumerate(config.frames.names):
        start, stop = number * tokens, (number + 1) * tokens
        if name in CAMERA_OF_FRAME:
            spans.append(Span(name, "latent", start, stop, camera=name, grid=patch_grid(config)))
        else:
            spans.append(Span(name, "latent", start, stop))
    return SiteLayout(SELF, tuple(spans))


def cross_layout(config: CosmosConfig) -> SiteLayout:
    """Return the key axis of cross-attention: the text's positions."""
    return SiteLayout(CROSS, (Span(TEXT_SPAN, "text", 0, config.text_length),))


def self_roles(config: CosmosConfig) -> NDArray[np.uint8]:
    """Return the role codes of self-attention's keys, the same at every replan."""
    roles = {name: _ROLES.get(name, Role.FUTURE) for name in config.frames.names}
    return roles_from_spans(self_layout(config), roles)
