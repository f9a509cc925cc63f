"""Pictures that the caller gives, in the size of the model's input image. Needs numpy, and torch to resize."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.torch_policies.policy_layout import PictureFit
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.layout import PatchGrid


def model_picture(picture: Any, camera: str, grid: PatchGrid, fit: PictureFit) -> NDArray[np.uint8]:
    """Return a camera's picture as (height, width, 3) uint8 of the model's input size.

    picture: (height, width, 3) uint8, or (3, height, width) with numbers from 0 to 1, as an array or a tensor; a batch
    axis of length 1 may come first. fit: how other sizes become the model's, see `CameraPicture`.

    Raises:
        BadArgument: another shape or type.
    """
    levels = _levels(picture, camera)
    height, width = grid.image_height, grid.image_width
    if levels.shape[:2] == (height, width):
        return levels
    if fit == "stretch":
        return _resized(levels, height, width)
    factor = max(levels.shape[0] / height, levels.shape[1] / width)
    inner = _resized(levels, max(1, int(levels.shape[0] / factor)), max(1, int(levels.shape[1] / factor)))
    below, beside = height - inner.shape[0], width - inner.shape[1]
    top, left = (below, beside) if fit == "pad_left_top" else (below // 2, beside // 2)
    fitted = np.zeros((height, width, 3), dtype=np.uint8)
    fitted[top : top + inner.shape[0], left : left + inner.shape[1]] = inner
    return fitted


def _levels(picture: Any, camera: str) -> NDArray[np.uint8]:
    """The picture as (row, column, channel) uint8."""
    if hasattr(picture, "detach"):
        picture = picture.detach().cpu()
        picture = (picture.float() if picture.is_floating_point() else picture).numpy()
    values = np.asarray(picture)
    values = values[0] if values.ndim == 4 and len(values) == 1 else values
    if not values.size:
        raise BadArgument(f"The picture of camera '{camera}' is empty: its shape is {values.shape}.")
    if values.ndim == 3 and values.shape[-1] == 3 and values.dtype == np.uint8:
        return np.ascontiguousarray(values)
    if values.ndim == 3 and values.shape[0] == 3 and values.dtype == np.uint8:
        return np.ascontiguousarray(values.transpose(1, 2, 0))
    if values.ndim == 3 and 3 in (values.shape[0], values.shape[-1]) and values.dtype.kind == "f":
        if values.min() >= 0 and values.max() <= 1:
            channels_last = values if values.shape[-1] == 3 else values.transpose(1, 2, 0)
            return np.ascontiguousarray(np.rint(channels_last * 255).astype(np.uint8))
        raise BadArgument(
            f"The picture of camera '{camera}' has numbers from {values.min():.3g} to {values.max():.3g}; give it "
            "before normalising, as uint8 or from 0 to 1."
        )
    raise BadArgument(
        f"The picture of camera '{camera}' has the shape {values.shape} and type {values.dtype}; expected (height, "
        "width, 3) uint8, or (3, height, width) with numbers from 0 to 1."
    )


def _resized(picture: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """The picture in another size, bilinear with smoothing."""
    import torch

    with torch.no_grad():
        values = torch.from_numpy(picture).permute(2, 0, 1)[None].float()
        small = torch.nn.functional.interpolate(
            values, (height, width), mode="bilinear", align_corners=False, antialias=True
        )
        result: NDArray[np.uint8] = small[0].permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8).numpy()
    return np.ascontiguousarray(result)
