"""Attention on the pictures of one episode: how patches lie on a picture, and mass and lift of every patch by replan.

The stored frame is what the model sees (turned, resized and cropped already, see `PolicyCameraView`), and a camera's
patches tile all of it evenly, row by row from its top left corner. Frame and map are therefore laid over each other
first, and only then turned to the way a person sees the scene.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.masses import mean_of_layers, uniform_keys
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode, positions_by_task
from vla_attention.analyze.measures.tables import Axis, long_table
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.schemas.cached_property import cached_property
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.layout import PatchGrid, Role, SiteLayout
from vla_attention.schemas.stores.store_format import PolicyCameraView

Array = NDArray[np.float64]
#: A scale ends at this quantile of all values that are shown with it: a single patch must not make the others pale.
_TOP_QUANTILE = 0.995
#: It ends at this many times the value of uniform attention, or above.
_LEAST_TOP = 4.0
#: Lines are drawn around what gets so many times even attention; the second is the highest that fits the scale.
_FIRST_LEVEL, _SECOND_LEVELS = 2.0, (50.0, 20.0, 10.0, 5.0)
#: Cells along a side of a map that adds several grids.
_MOST_CELLS = 128
#: Grey that stands for a picture that was not stored.
NO_PICTURE = 205


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


def seen_cameras(item: SelectedEpisode) -> tuple[str, ...]:
    """Cameras of the site whose patches are not all masked, in key order."""
    layout, roles = item.tokens.layout, item.tokens.static_roles
    return tuple(camera for camera in layout.pictured if (roles[:, layout.patch_keys(camera)] == Role.IMAGE).any())


def upright(image: NDArray[Any], view: PolicyCameraView) -> NDArray[Any]:
    """A stored picture or patch map (row, column, ...) as a person in the camera's place would see it.

    Rows are reversed unless the stored picture is upright; columns are reversed if it is mirrored, so that left is left
    as in the instruction. Turning twice gives the stored picture back.
    """
    return image[:: 1 if view.upright else -1, :: -1 if view.mirrored else 1]


def enlarge(patch_map: NDArray[np.floating], height: int, width: int, smooth: bool = False) -> NDArray[np.float64]:
    """A patch map (row, column) with a value for every pixel, (height, width): patches divide both sides evenly.

    A pixel has the value of the patch in which its centre lies; with `smooth`, values are bilinear between patch
    centres and constant beyond the outermost ones, which shows the map softer than it is known.
    """
    values = np.asarray(patch_map, dtype=np.float64)
    if values.ndim != 2 or not values.size:
        raise BadArgument(f"A patch map has two axes (row, column) and patches; got shape {values.shape}.")
    rows, columns = _centres(height, values.shape[0]), _centres(width, values.shape[1])
    if not smooth:
        return np.asarray(values[np.floor(rows).astype(int)][:, np.floor(columns).astype(int)])
    for axis, centres in ((0, rows), (1, columns)):
        place = np.clip(centres - 0.5, 0.0, values.shape[axis] - 1.0)
        below = np.floor(place).astype(int)
        above = np.minimum(below + 1, values.shape[axis] - 1)
        part = (place - below).reshape((-1, 1) if axis == 0 else (1, -1))
        values = (1.0 - part) * values.take(below, axis) + part * values.take(above, axis)
    return values


def _centres(pixels: int, cells: int) -> NDArray[np.float64]:
    """Where the pixels' centres lie, in units of a cell."""
    return (np.arange(pixels) + 0.5) * cells / pixels


@dataclass(frozen=True)
class CameraMap:
    """Attention on one camera's pictures, in the orientation in which they are stored.

    Attributes:
        picture: how its patches lie on the map.
        view: how the picture was turned.
        mass: of every cell, (replan, row, column): mean over layers, denoise steps and heads.
        lift: mass / what uniform attention gives the cell, (replan, row, column); NaN where that is 0.
        share: mass / mass of all image keys of all cameras, (replan, row, column); NaN where there is none.
        outside: mass of the camera's keys that lie nowhere in the picture, (replan,).
    """

    picture: PictureMap
    view: PolicyCameraView
    mass: Array
    lift: Array
    share: Array
    outside: Array


@dataclass(frozen=True)
class EpisodeMaps:
    """What the policy looks at and reads in one episode.

    Attributes:
        item: the episode.
        env_step: environment step of each replan, (replan,).
        cameras: by name, in key order.
        image_mass: of all image keys of all cameras, (replan,).
        words: for each replan the instruction's words, each with its lift; empty where the site spells none.
    """

    item: SelectedEpisode
    env_step: NDArray[np.int64]
    cameras: Mapping[str, CameraMap]
    image_mass: Array
    words: Sequence[Sequence[tuple[str, float]]]

    def has_frames(self, camera: str) -> bool:
        """Whether the camera's pictures were stored."""
        return self.item.episode.has(f"frames/{camera}")


def stored_picture(item: SelectedEpisode, camera: str, replan: int) -> NDArray[np.uint8] | None:
    """The picture that the policy got, as a person sees the scene, (row, column, 3); None where none was stored."""
    if not item.episode.has(f"frames/{camera}"):
        return None
    picture: NDArray[np.uint8] = item.episode.read(f"frames/{camera}", replan)
    return upright(picture, view_of(item, camera))


def view_of(item: SelectedEpisode, camera: str) -> PolicyCameraView:
    """How a camera's pictures were turned."""
    views = {view.name: view for view in item.store.attributes.policy.cameras}
    return views.get(camera, PolicyCameraView(camera, camera, True, False))


def camera_names(question: Question, wanted: Sequence[str] | None = None) -> tuple[str, ...]:
    """The cameras that the policy sees at the question's site, or the wanted ones among them.

    Raises:
        BadArgument: the site has no camera pictures among its keys.
        UnknownName: a wanted camera is not one of them.
    """
    cameras = seen_cameras(question.selected[0])
    if not cameras:
        sites = [site.name for site in question.stores[0].attributes.sites if site.pictured]
        raise BadArgument(
            f"The tokens of site '{question.site}' are no patches of the pictures; sites with cameras: "
            f"{listing(sites)}. Choose with --site."
        )
    for camera in wanted or ():
        if camera not in cameras:
            raise unknown_name("camera", camera, cameras)
    return cameras if wanted is None else tuple(wanted)


def episode_maps(question: Question, item: SelectedEpisode, cameras: Sequence[str]) -> EpisodeMaps:
    """Read one episode's attention, mean over the selected layers, denoise steps and heads."""
    tokens, selection = item.tokens, question.selection
    mean = mean_rows(question, item)
    # Of a patch beside a picture that was fitted in, what shows the picture counts.
    shown = np.ones(mean.shape[1]) if tokens.border is None else 1.0 - tokens.border
    image = mean * shown * (tokens.static_roles == int(Role.IMAGE))
    uniform = mean_of_layers(uniform_keys(item, selection).mean(axis=(2, 3)), selection)
    uniform = shared_out(mean, uniform, item.valid)
    whole = image.sum(axis=1)
    maps = {}
    with np.errstate(divide="ignore", invalid="ignore"):
        for camera in cameras:
            picture = PictureMap.of(tokens.layout, camera)
            seen = mean * shown, uniform * np.where(shown > 0, shown, 1.0)
            mass, even = (picture.spread(keys[:, picture.keys]) for keys in seen)
            beside = [span for span in tokens.layout.camera_spans(camera) if span.grid is None]
            outside = sum((mean[:, span.start : span.stop].sum(axis=1) for span in beside), np.zeros(len(mean)))
            share = mass / whole[:, None, None]
            maps[camera] = CameraMap(picture, view_of(item, camera), mass, mass / even, share, outside)
        words = [
            [(word.text, float(mean[replan, list(word.keys)].sum() / uniform[replan, list(word.keys)].sum()))
             for word in tokens.words[prompt]]
            for replan, prompt in enumerate(tokens.prompt_index)
        ] if tokens.prompt_index is not None and tokens.words else []  # fmt: skip
    return EpisodeMaps(item, item.episode.read("env_step").astype(np.int64), maps, whole, words)


def mean_rows(question: Question, item: SelectedEpisode) -> Array:
    """An episode's attention, mean over the selected layers, denoise steps and heads, (replan, key)."""
    selection = question.selection
    rows = layer_rows(item.store.attributes, item.episode, selection, question.site, per_head=False)
    parts = [part.rows[:, 0].astype(np.float64) for part in rows if part.layer in selection.once]
    mean: Array = sum(parts, np.zeros(())) / len(parts)
    return mean


def shared_out(mass: Array, uniform: Array, valid: NDArray[np.bool_]) -> Array:
    """As much mass (..., key) as the valid keys have, shared out as uniform attention does."""
    shares: Array = uniform * ((mass * valid).sum(axis=-1) / (uniform * valid).sum(axis=-1))[..., None]
    return shares


def scale_end(values: NDArray[np.floating]) -> float:
    """Where a scale of lifts ends: at the 99.5 % quantile of the finite ones, at 4 or above, with two digits.

    Nearly uniform attention does not look concentrated on it.
    """
    finite = np.asarray(values)[np.isfinite(values)]
    high = max(float(np.quantile(finite, _TOP_QUANTILE)) if finite.size else 0.0, _LEAST_TOP)
    step = 10.0 ** (np.floor(np.log10(high)) - 1)
    return float(np.round(np.ceil(np.round(high / step, 9)) * step, 12))


def line_levels(high: float) -> list[float]:
    """The lifts around which lines are drawn in pictures whose scale ends at `high`; at most two."""
    return [_FIRST_LEVEL, *[level for level in _SECOND_LEVELS if level <= 0.8 * high][:1]]


def patch_table(maps: EpisodeMaps, replans: Sequence[int]) -> pl.DataFrame:
    """One row per (camera, replan, cell of its map): mass, share of all image attention, lift.

    `row` and `column` count in the stored picture, as selectors such as patch:CAMERA[r0:r1,c0:c1] do where the cells
    are the patches of one grid; `shown_row` and `shown_column` in the picture as it is drawn.
    """
    chosen = list(replans)
    axis: Axis = {"replan": chosen, "env_step": maps.env_step[chosen]}
    frames = []
    for camera, one in maps.cameras.items():
        row, column = np.indices(one.mass.shape[1:]).reshape(2, -1)
        shown_row = row if one.view.upright else row.max() - row
        shown_column = column.max() - column if one.view.mirrored else column
        cells = {"row": row, "column": column, "shown_row": shown_row, "shown_column": shown_column}
        values = {"mass": one.mass, "share": one.share, "lift": one.lift}
        columns = {name: array[chosen].reshape(1, len(chosen), -1) for name, array in values.items()}
        frames.append(long_table(maps.item, [{"camera": (camera,)}, axis, cells], columns))
    return pl.concat(frames)


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
        notes.append(f"leaves out the tokens of {listing(others)}, which lie nowhere in the picture{share}")
    return f"The map of {camera} {' and '.join(notes)}." if notes else ""


def orientation_notes(episodes: Sequence[EpisodeMaps]) -> list[str]:
    """How the pictures of episodes of one run were turned for display, and what their maps add up and leave out."""
    cameras = episodes[0].cameras
    mirrored = [camera for camera, one in cameras.items() if one.view.mirrored]
    turned = [camera for camera, one in cameras.items() if not one.view.upright]
    notes = []
    for which, said in (
        (mirrored, "shown as the scene is; the model sees left and right exchanged"),
        (turned, "shown right way up; the model sees them upside down"),
    ):
        if which:
            notes.append(f"{'Pictures are' if len(which) == len(cameras) else f'{listing(which)}:'} {said}.")
    for camera in cameras:
        beside, placed = (
            float(sum(getattr(maps.cameras[camera], name).sum() for maps in episodes)) for name in ("outside", "mass")
        )
        of_camera = beside / max(beside + placed, np.finfo(float).tiny)
        notes.append(map_note(episodes[0].item.tokens.layout, camera, of_camera))
    missing = [camera for camera in cameras if not all(maps.has_frames(camera) for maps in episodes)]
    if missing:
        notes.append(f"No pictures were stored of {listing(missing)}: attention alone, on grey.")
    return [note for note in notes if note]


def choose_episodes(selected: Sequence[SelectedEpisode], count: int) -> list[SelectedEpisode]:
    """`count` episodes of tasks spread evenly over all tasks; solved and failed ones in turn, where a task has both."""
    tasks = [[selected[i] for i in positions] for positions in positions_by_task(selected).values()]
    picked: list[SelectedEpisode] = []
    spread = np.linspace(0, len(tasks) - 1, min(count, len(tasks))).round()
    for turn, place in enumerate(sorted({int(place) for place in spread})):
        fitting = [item for item in tasks[place] if item.episode.attributes.success is (turn % 2 == 0)]
        picked.append((fitting or tasks[place])[0])
    # With fewer tasks than wanted episodes: further episodes of the same tasks, in turn.
    rest = [item for depth in range(max(map(len, tasks))) for group in tasks for item in group[depth : depth + 1]]
    further = [item for item in rest if all(item is not other for other in picked)]
    return [*picked, *further[: max(0, count - len(picked))]]
