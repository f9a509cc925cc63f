"""The cameras that a policy sees, maps of their pictures, and the mean attention on every key over a selection."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.measures.masses import uniform_keys
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.cached_property import cached_property
from vla_attention.schemas.errors import listing
from vla_attention.schemas.layout import PatchGrid, Role, SiteLayout

#: Cells along a side of a map that adds several grids.
_MOST_CELLS = 128


@dataclass(frozen=True)
class PictureMap:
    """How the patches of a camera lie on a map of its picture: `rows` x `columns` even cells.

    The cells of one grid over the whole picture are its patches. Of several grids (tiles, a thumbnail, frames of other
    times), or of one over a part, they are as small as the smallest patches, at most 128 along a side: each patch's
    mass is spread evenly over its area, and masses of patches at one place are added, so that a map sums to the mass of
    all patches.

    Attributes:
        grids: of the camera, in key order.
        keys: of the patches of these grids, one grid after another, shape (patch,).
    """

    grids: tuple[PatchGrid, ...]
    keys: NDArray[np.int64]

    @classmethod
    def of(cls, layout: SiteLayout, camera: str) -> PictureMap:
        """The map of a camera that has patches."""
        return cls(layout.grids(camera), layout.patch_keys(camera))

    @property
    def rows(self) -> int:
        """Number of rows of cells."""
        return self._cells([(grid.rows, grid.part[2]) for grid in self.grids], self.grids[0].image_height)

    @property
    def columns(self) -> int:
        """Number of columns of cells."""
        return self._cells([(grid.columns, grid.part[3]) for grid in self.grids], self.grids[0].image_width)

    def _cells(self, sides: Sequence[tuple[int, float]], pixels: int) -> int:
        """Cells along a side: (number of patches, part of the side) of each grid, and the picture's pixels."""
        if self.cells_are_patches:
            return sides[0][0]
        return min(max(math.ceil(patches / length - 1e-6) for patches, length in sides), pixels, _MOST_CELLS)

    @property
    def cells_are_patches(self) -> bool:
        """Whether the camera has one grid over its whole picture."""
        return len(self.grids) == 1 and self.grids[0].covers_all

    def spread(self, masses: NDArray[Any]) -> NDArray[Any]:
        """Masses of patches (..., patch) as maps (..., row, column) of the same sum."""
        if self.cells_are_patches:
            return masses.reshape(*masses.shape[:-1], self.rows, self.columns)
        total = np.zeros((*masses.shape[:-1], self.rows, self.columns), dtype=masses.dtype)
        first = 0
        for grid, (down, across) in zip(self.grids, self._shares, strict=True):
            own = masses[..., first : first + grid.num_patches].reshape(*masses.shape[:-1], grid.rows, grid.columns)
            total += (down.T @ own @ across).astype(masses.dtype)
            first += grid.num_patches
        return total

    def finest(self, values: NDArray[Any]) -> NDArray[Any]:
        """The values (..., patch) of the smallest patch at each cell's centre, (..., cell); 0 without a patch."""
        below = np.concatenate([values, np.zeros_like(values[..., :1])], axis=-1)
        smallest = np.full(self.rows * self.columns, -1)
        for patch in self._at[::-1]:
            smallest = np.where(patch.ravel() >= 0, patch.ravel(), smallest)
        return below[..., smallest]

    def highest(self, values: NDArray[Any]) -> NDArray[Any]:
        """The highest of the values (..., patch) at each cell's centre, (..., row, column); 0 without a patch."""
        below = np.concatenate([values, np.zeros_like(values[..., :1])], axis=-1)
        return np.asarray(below[..., self._at].max(axis=-3))

    @cached_property
    def _shares(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        return [grid.shares(self.rows, self.columns) for grid in self.grids]

    @cached_property
    def _at(self) -> NDArray[np.int64]:
        """The patch of each grid at the centres of the cells (grid, row, column), smallest first; -1: none."""
        found, first = [], 0
        for grid in self.grids:
            top, left, height, width = grid.part
            row = np.floor(((np.arange(self.rows) + 0.5) / self.rows - top) * grid.rows / height).astype(int)
            column = np.floor(((np.arange(self.columns) + 0.5) / self.columns - left) * grid.columns / width).astype(
                int
            )
            inside = np.outer((row >= 0) & (row < grid.rows), (column >= 0) & (column < grid.columns))
            patch = np.where(inside, first + row[:, None] * grid.columns + column, -1)
            found.append((height * width / grid.num_patches, first, patch))
            first += grid.num_patches
        return np.stack([patch for _, _, patch in sorted(found, key=lambda one: one[:2])])


def map_note(layout: SiteLayout, camera: str, outside: float | None) -> str:
    """What a camera's map adds up and leaves out, in a sentence; empty where its keys are the patches of one grid.

    outside: part of the camera's attention on keys that lie nowhere in the picture, 0 to 1; None: not known.
    """
    spans = layout.camera_spans(camera)
    placed = [span.name for span in spans if span.grid is not None]
    others = [span.name for span in spans if span.grid is None]
    notes = []
    if len(placed) > 1:
        notes.append(f"adds the attention on {listing(placed)}")
    if others:
        share = "" if outside is None else f", with {100 * outside:.1f}% of the camera's attention"
        notes.append(f"leaves out the keys of {listing(others)}, which lie nowhere in the picture{share}")
    return f"The map of {camera} {' and '.join(notes)}." if notes else ""


def seen_cameras(item: SelectedEpisode) -> tuple[str, ...]:
    """Cameras of the site whose patches are not all masked, in key order."""
    layout, roles = item.tokens.layout, item.tokens.static_roles
    return tuple(camera for camera in layout.pictured if (roles[:, layout.patch_keys(camera)] == Role.IMAGE).any())


def mean_rows(item: SelectedEpisode, selection: Selection, site: str) -> NDArray[np.float64]:
    """Probability of every key, shape (replan, key): mean over the selected layers, denoise steps and heads.

    A block that was named by two layer numbers counts once.
    """
    total, count = 0.0, 0
    for part in layer_rows(item.store.attributes, item.episode, selection, site, per_head=True):
        if part.layer in selection.once:
            total, count = total + part.rows.mean(axis=1, dtype=np.float64), count + 1
    return np.asarray(total) / count


def mean_uniform(item: SelectedEpisode, selection: Selection) -> NDArray[np.float64]:
    """What `mean_rows` is for uniform attention, shape (replan or 1, key)."""
    uniform = uniform_keys(item, selection).mean(axis=(2, 3))
    means: NDArray[np.float64] = (uniform[:, list(selection.once)] if uniform.shape[1] > 1 else uniform).mean(axis=1)
    return means
