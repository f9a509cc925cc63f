"""Pictures that are fitted into a model's with their shape kept: where they lie, and what beside them shows nothing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.layout import Part, Role, SiteLayout


def fitted_box(given: tuple[int, int], size: tuple[int, int], towards: float = 0.5) -> tuple[int, int, int, int]:
    """Top, left, height and width in pixels of a camera's picture in a model's, resized with its aspect ratio kept.

    given, size: height and width in pixels of the camera's picture and of the model's. towards: where it lies in the
    room that is left, 0.5 in the middle.
    """
    factor = max(mine / other for mine, other in zip(given, size, strict=True))
    height, width = (max(1, int(side / factor)) for side in given)
    top, left = (int((whole - side) * towards) for whole, side in zip(size, (height, width), strict=True))
    return top, left, height, width


def fitted_part(given: tuple[int, int], size: tuple[int, int], towards: float = 0.5) -> Part:
    """`fitted_box` in fractions of the model's picture."""
    top, left, height, width = fitted_box(given, size, towards)
    return top / size[0], left / size[1], height / size[0], width / size[1]


def border_of_keys(layout: SiteLayout, shown: Mapping[str, Part]) -> NDArray[np.float32] | None:
    """How much of each key's patch shows no picture, (key,); None where all patches show one.

    shown: camera -> the part of the model's picture that shows the camera's; all of it for others.
    """
    found = np.zeros(layout.num_keys, dtype=np.float32)
    for camera, part in shown.items():
        if camera in layout.pictured:
            found[layout.patch_keys(camera)] = 1.0 - np.concatenate([grid.shown(part) for grid in layout.grids(camera)])
    return found if found.any() else None


def with_borders(layout: SiteLayout, roles: NDArray[np.uint8], shown: Mapping[str, Part]) -> NDArray[np.uint8]:
    """Roles (key,) with `border` for the patches that show no picture at all."""
    border = border_of_keys(layout, shown)
    if border is None:
        return roles
    marked = roles.copy()
    marked[(border == 1.0) & (roles == Role.IMAGE)] = Role.BORDER
    return marked
