"""openpi's LIBERO preprocessing: images, state, normalisation statistics, and actions back to the environment.

Pure functions on arrays, and a reader of norm_stats.json. Formulas: openpi `examples/libero/main.py` (images, state)
and `transforms.py` (normalisation); each is checked against arrays that openpi computed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vla_attention.capture.policies.checkpoints import CheckpointNotFound, UnreadableCheckpoint
from vla_attention.schemas.checked_files import read_object
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.fitted_pictures import fitted_box
from vla_attention.schemas.jsonable import MalformedDocument, from_json

NormalisationMode = Literal["quantile", "z-score"]

#: Prevents a division by zero for constant dimensions (openpi's value).
NORMALISATION_EPS = 1e-6

#: Action dimensions that a LIBERO or robosuite arm takes: translation, rotation, gripper.
ENVIRONMENT_ACTION_DIM = 7
#: Of these, openpi's pi0_libero gives differences to the state: all but the gripper's.
RELATIVE_ACTIONS = 6


def turn(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a simulator's picture turned by 180°, as policies of LIBERO see it."""
    return np.ascontiguousarray(picture[::-1, ::-1])


def resize_with_pad(image: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Resize (height, width, 3) to fit (size, size, 3) with the aspect ratio kept, centred on black."""
    height, width = image.shape[:2]
    if (height, width) == (size, size):
        return image
    top, left, rows, columns = fitted_box((height, width), (size, size))
    resized = Image.fromarray(image).resize((columns, rows), Image.Resampling.BILINEAR)
    canvas = np.zeros((size, size, 3), dtype=np.uint8)
    canvas[top : top + rows, left : left + columns] = np.asarray(resized)
    return canvas


def axis_angle(quaternion: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return axis times angle (3,) of a unit quaternion xyzw (4,): xyz · 2 arccos(w) / sqrt(1 - w²).

    The sign of the quaternion is not changed, as in openpi and robosuite: w < 0 gives angles above pi.
    """
    w = min(1.0, max(-1.0, float(quaternion[3])))
    sine = math.sqrt(1.0 - w * w)
    if math.isclose(sine, 0.0):
        return np.zeros(3)
    return np.asarray(quaternion[:3], dtype=np.float64) * 2.0 * math.acos(w) / sine


def libero_state(
    eef_pos: NDArray[np.floating], eef_quat: NDArray[np.floating], gripper_qpos: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the state (8,): gripper position (3), its axis-angle orientation (3), the two finger joints (2)."""
    return np.concatenate([eef_pos, axis_angle(eef_quat), gripper_qpos]).astype(np.float64)


@dataclass(frozen=True)
class Normaliser:
    """Normalisation of one vector: (x - offset) / divisor, and where that is a share of a range, 0..1 becomes -1..1.

    mode: its name, for the store. offset, divisor, factor: each (dim,), in the precision of the arithmetic; the factor
    undoes the divisor.
    """

    mode: str
    offset: NDArray[np.floating]
    divisor: NDArray[np.floating]
    factor: NDArray[np.floating]
    is_range: bool = False

    def normalise(self, x: NDArray[np.floating]) -> NDArray[np.floating]:
        """Map (..., dim) to the model's range, without clipping.

        Statistics longer than the data are cut to it (older checkpoints hold padded ones).
        """
        dim = x.shape[-1]
        scaled: NDArray[np.floating] = (np.asarray(x, dtype=self.offset.dtype) - self.offset[:dim]) / self.divisor[:dim]
        return scaled * 2.0 - 1.0 if self.is_range else scaled

    def unnormalise(self, x: NDArray[np.floating]) -> NDArray[np.floating]:
        """Invert `normalise` on (..., dim); dimensions beyond the statistics pass through."""
        x = np.asarray(x, dtype=self.offset.dtype)
        dim = min(x.shape[-1], len(self.offset))
        known = (x[..., :dim] + 1.0) / 2.0 if self.is_range else x[..., :dim]
        return np.concatenate([known * self.factor[:dim] + self.offset[:dim], x[..., dim:]], axis=-1)


class Statistics(msgspec.Struct, frozen=True):
    """Statistics of one vector, each a number per dimension; the quantiles are absent in some checkpoints."""

    mean: list[float]
    std: list[float]
    q01: list[float] | None = None
    q99: list[float] | None = None

    def check(self, name: str) -> None:
        """Raise `UnreadableCheckpoint` for unequal lengths, NaN and infinity."""
        for key, numbers in msgspec.structs.asdict(self).items():
            if not np.isfinite(numbers or 0).all():
                raise UnreadableCheckpoint(f"The statistics have NaN or infinity in '{key}' of '{name}'.")
            if numbers is not None and len(numbers) != len(self.mean):
                raise UnreadableCheckpoint(f"The statistics '{key}' and 'mean' of '{name}' have unequal lengths.")

    def normaliser(self, mode: NormalisationMode) -> Normaliser:
        """Return openpi's normalisation: (x - mean)/(std + eps), or q01..q99 to -1..1."""
        if mode == "z-score":
            divisor = np.array(self.std) + NORMALISATION_EPS
            return Normaliser(mode, np.array(self.mean), divisor, divisor)
        if self.q01 is None or self.q99 is None:
            raise UnreadableCheckpoint("The normalisation statistics have no q01 and q99, which quantile mode needs.")
        span = np.array(self.q99) - np.array(self.q01) + NORMALISATION_EPS
        return Normaliser(mode, np.array(self.q01), span, span, is_range=True)


class NormStats(msgspec.Struct, frozen=True):
    """Statistics of state and actions."""

    state: Statistics
    actions: Statistics

    def check(self, state_dim: int, action_dim: int, padded_dim: int) -> None:
        """Raise `UnreadableCheckpoint` unless they fit the state and the environment's actions.

        Older checkpoints hold statistics padded to the model's `padded_dim`; any other length belongs to another robot.
        """
        for name, statistics, needed in (("state", self.state, state_dim), ("actions", self.actions, action_dim)):
            if len(statistics.mean) not in (needed, padded_dim):
                raise UnreadableCheckpoint(
                    f"The normalisation statistics of '{name}' have {len(statistics.mean)} numbers; {needed} are "
                    f"needed (or {padded_dim}, padded)."
                )


def pad_to(x: NDArray[np.floating], dim: int) -> NDArray[np.float64]:
    """Return (..., dim) with zeros after the given dimensions."""
    return np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, dim - x.shape[-1])])


class _File(msgspec.Struct, frozen=True):
    norm_stats: NormStats


def parse_norm_stats(content: object, where: str) -> NormStats:
    """Build the statistics from the content of openpi's norm_stats.json; `where` names it in errors."""
    try:
        stats = from_json(_File, content, where).norm_stats
        stats.state.check("state")
        stats.actions.check("actions")
    except (MalformedDocument, UnreadableCheckpoint) as error:
        raise UnreadableCheckpoint(f"{where} has no statistics that can be used: {error}") from None
    return stats


def read_norm_stats(checkpoint: str | Path, given: Path | None = None, asset_id: str | None = None) -> NormStats:
    """Read the statistics of a checkpoint folder, assets/<asset id>/norm_stats.json, or of the given file.

    The asset id may be several folders deep. Without `asset_id` there must be one of them.

    Raises:
        CheckpointNotFound: there is no such file.
        UnknownName, BadArgument: there are others than `asset_id`, or several without it.
        UnreadableCheckpoint: the file holds something else.
    """
    if given is not None:
        return _read_norm_stats(given.expanduser(), inside=None)
    folder = Path(checkpoint)
    by_name = find_norm_stats(folder)
    if not by_name:
        raise CheckpointNotFound(
            f"The checkpoint '{checkpoint}' has no norm_stats.json below '{folder / 'assets'}'; give the one of its "
            "training with --norm-stats FILE (openpi's is assets/CONFIG/ASSET_ID/norm_stats.json where it was trained)."
        )
    if asset_id is not None and asset_id not in by_name:
        raise unknown_name(f"asset id of '{checkpoint}'", asset_id, by_name)
    if asset_id is None and len(by_name) > 1:
        raise BadArgument(
            f"The checkpoint '{checkpoint}' has statistics of {listing(by_name)}; say which with --asset-id NAME, or "
            "give a file with --norm-stats FILE."
        )
    return _read_norm_stats(by_name[asset_id or next(iter(by_name))], inside=folder)


def _read_norm_stats(path: Path, inside: Path | None) -> NormStats:
    if path.is_dir():
        raise CheckpointNotFound(f"'{path}' is a folder; expected a file norm_stats.json.")
    try:
        content = read_object(path, UnreadableCheckpoint, inside=inside)
    except FileNotFoundError:
        if path.is_symlink():
            raise UnreadableCheckpoint(f"'{path}' is a link to a file that does not exist.") from None
        raise CheckpointNotFound(f"There is no file of statistics at '{path}'.") from None
    return parse_norm_stats(content, f"'{path}'")


def find_norm_stats(checkpoint: Path) -> dict[str, Path]:
    """Return asset id -> norm_stats.json of the files below the folder `assets` of a checkpoint, in their order."""
    assets = checkpoint / "assets"
    files = sorted(path for path in assets.glob("**/norm_stats.json") if not path.is_dir())
    return {path.parent.relative_to(assets).as_posix(): path for path in files}
