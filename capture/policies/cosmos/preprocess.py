"""Preprocessing of camera pictures and proprioception for the networks, and of their actions for the robot."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from vla_attention.capture.foreign_files.checked_files import read_object
from vla_attention.capture.policies.checkpoints import CheckpointNotFound, UnreadableCheckpoint
from vla_attention.schemas.errors import BadArgument

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


@dataclass(frozen=True)
class Ranges:
    """Ranges of the training data's actions and proprioception, each (dim,) float64."""

    actions_min: NDArray[np.float64]
    actions_max: NDArray[np.float64]
    proprio_min: NDArray[np.float64]
    proprio_max: NDArray[np.float64]

    def normalise_proprio(self, proprio: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return 2 (x - min) / (max - min) - 1 (dim,)."""
        scaled: NDArray[np.float64] = 2 * (proprio - self.proprio_min) / (self.proprio_max - self.proprio_min) - 1
        return scaled

    def environment_actions(self, actions: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return normalised actions (step, dim) in the robot's units: 0.5 (a + 1) (max - min) + min, not cut."""
        scaled: NDArray[np.float64] = 0.5 * (actions + 1) * (self.actions_max - self.actions_min) + self.actions_min
        return scaled

    def as_json(self) -> dict[str, list[float]]:
        """Return the ranges as plain JSON values."""
        return {name: [float(x) for x in getattr(self, name)] for name in _FIELDS}


_FIELDS = ("actions_min", "actions_max", "proprio_min", "proprio_max")


def make_ranges(content: Mapping[str, object], where: str, action_dim: int, proprio_dim: int) -> Ranges:
    """Check ranges and return them; `UnreadableCheckpoint` names the entry that is missing or of the wrong length.

    where: completes the sentence "The dataset statistics ..." in an error."""
    arrays = {}
    for name in _FIELDS:
        if name not in content:
            raise UnreadableCheckpoint(f"The dataset statistics {where} have no '{name}'.")
        try:
            array = np.asarray(content[name], dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise UnreadableCheckpoint(f"'{name}' of the dataset statistics {where} is no list of numbers.") from None
        dim = action_dim if name.startswith("actions") else proprio_dim
        if array.shape != (dim,) or not np.isfinite(array).all():
            raise UnreadableCheckpoint(
                f"'{name}' of the dataset statistics {where} has shape {array.shape}; expected {dim} finite numbers."
            )
        arrays[name] = array
    if not (arrays["actions_max"] >= arrays["actions_min"]).all():
        raise UnreadableCheckpoint(f"The dataset statistics {where} have an 'actions_max' below 'actions_min'.")
    if not (arrays["proprio_max"] > arrays["proprio_min"]).all():
        raise UnreadableCheckpoint(
            f"The dataset statistics {where} have a 'proprio_max' that is not above 'proprio_min'."
        )
    return Ranges(**arrays)


def read_ranges(path: str | Path, action_dim: int = 7, proprio_dim: int = 9) -> Ranges:
    """Read a file of dataset statistics (JSON)."""
    path = Path(path)
    try:
        content = read_object(path, UnreadableCheckpoint)
    except FileNotFoundError:
        raise CheckpointNotFound(
            f"There are no dataset statistics at '{path}'; give --dataset-stats-path (libero_dataset_statistics.json "
            "of the checkpoint)."
        ) from None
    return make_ranges(content, f"in '{path}'", action_dim, proprio_dim)


def proprio_of(
    gripper_qpos: NDArray[np.float64], eef_pos: NDArray[np.float64], eef_quat: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the 9 numbers that the policy reads: finger joints, position, quaternion as the simulator gives it."""
    proprio = np.concatenate([gripper_qpos, eef_pos, eef_quat]).astype(np.float64)
    if proprio.shape != (9,):
        raise BadArgument(f"Proprioception has 9 numbers (2 fingers, 3 position, 4 quaternion), not {len(proprio)}.")
    return proprio
