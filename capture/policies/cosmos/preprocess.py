"""Preprocessing of camera pictures and proprioception for the networks, and of their actions for the robot."""

from __future__ import annotations

import io
from pathlib import Path

import msgspec
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from vla_attention.capture.policies.checkpoints import CheckpointNotFound, UnreadableCheckpoint
from vla_attention.schemas.checked_files import read_object
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.jsonable import MalformedDocument, from_json

JPEG_QUALITY = 95
#: Share of the area that the reference crops out of the middle when the policy was trained with image augmentation.
CROP_AREA = 0.9


def upright(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the simulator's picture with its rows reversed; the columns stay."""
    return np.ascontiguousarray(picture[::-1])


def compress(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture (height, width, 3) after JPEG compression and decompression, as in the training data."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="JPEG", quality=JPEG_QUALITY)
    return np.asarray(Image.open(buffer, formats=("JPEG",)).convert("RGB"))


def crop_size(size: int) -> int:
    """Side of the square that is cut out of a picture of `size` pixels."""
    return int(size * np.sqrt(CROP_AREA))


def crop_and_enlarge(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Cut the middle out of a square picture and resize it back: bilinear with antialiasing, rounded."""
    size = picture.shape[0]
    side = crop_size(size)
    offset = round((size - side) / 2)  # half to even, as in the reference
    cut = picture[offset : offset + side, offset : offset + side]
    pixels = torch.from_numpy(np.ascontiguousarray(cut)).permute(2, 0, 1)[None].float()
    large = F.interpolate(pixels, size=(size, size), mode="bilinear", antialias=True, align_corners=False)
    return large[0].round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0).numpy()


def compressed_picture(picture: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Return the model's image (size, size, 3) uint8 of an upright picture: JPEG, bicubic resize, middle crop."""
    resized = Image.fromarray(compress(picture)).resize((size, size))
    return crop_and_enlarge(np.asarray(resized))


def visible_area() -> float:
    """Return the side of the visible middle of a camera picture, as a share of the picture's side."""
    return crop_size(224) / 224


def pixels(picture: NDArray[np.uint8], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return (1, 3, 1, height, width) in -1..1: a video of one frame, in the reference's arithmetic."""
    raw = torch.from_numpy(np.array(picture)).permute(2, 0, 1)[None, :, None].to(device)
    return raw.to(dtype) / 127.5 - 1.0


class Ranges(msgspec.Struct, frozen=True):
    """Ranges of the training data's actions and proprioception, each a number per dimension."""

    actions_min: list[float]
    actions_max: list[float]
    proprio_min: list[float]
    proprio_max: list[float]

    def normalise_proprio(self, proprio: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return 2 (x - min) / (max - min) - 1 (dim,)."""
        low, high = np.array(self.proprio_min), np.array(self.proprio_max)
        scaled: NDArray[np.float64] = 2 * (proprio - low) / (high - low) - 1
        return scaled

    def environment_actions(self, actions: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return normalised actions (step, dim) in the robot's units: 0.5 (a + 1) (max - min) + min, not cut."""
        low, high = np.array(self.actions_min), np.array(self.actions_max)
        scaled: NDArray[np.float64] = 0.5 * (actions + 1) * (high - low) + low
        return scaled


def read_ranges(path: str | Path, action_dim: int = 7, proprio_dim: int = 9) -> Ranges:
    """Read a file of dataset statistics (JSON); `UnreadableCheckpoint` names the entry that is missing or wrong."""
    path = Path(path)
    try:
        content = read_object(path, UnreadableCheckpoint)
    except FileNotFoundError:
        raise CheckpointNotFound(
            f"There are no dataset statistics at '{path}'; give --dataset-stats-path (libero_dataset_statistics.json "
            "of the checkpoint)."
        ) from None
    what = f"the dataset statistics in '{path}'"
    try:
        ranges = from_json(Ranges, content, f"{what} at $")
    except MalformedDocument as error:
        raise UnreadableCheckpoint(str(error)) from None
    for name, numbers in msgspec.structs.asdict(ranges).items():
        dim = action_dim if name.startswith("actions") else proprio_dim
        if len(numbers) != dim or not np.isfinite(numbers).all():
            raise UnreadableCheckpoint(
                f"'{name}' of {what} has {len(numbers)} numbers; expected {dim}, all of them finite."
            )
    if np.less(ranges.actions_max, ranges.actions_min).any():
        raise UnreadableCheckpoint(f"In {what} an 'actions_max' is below 'actions_min'.")
    if np.less_equal(ranges.proprio_max, ranges.proprio_min).any():
        raise UnreadableCheckpoint(f"In {what} a 'proprio_max' is not above 'proprio_min'.")
    return ranges


def proprio_of(
    gripper_qpos: NDArray[np.float64], eef_pos: NDArray[np.float64], eef_quat: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the 9 numbers that the policy reads: finger joints, position, quaternion as the simulator gives it."""
    proprio = np.concatenate([gripper_qpos, eef_pos, eef_quat]).astype(np.float64)
    if proprio.shape != (9,):
        raise BadArgument(f"Proprioception has 9 numbers (2 fingers, 3 position, 4 quaternion), not {len(proprio)}.")
    return proprio
