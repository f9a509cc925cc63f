"""Attention on the pictures of one episode: mass and lift of every patch, replan by replan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.patch_pictures import upright
from vla_attention.analyze.measures.frames import Axis, long_table
from vla_attention.analyze.measures.patch_maps import PictureMap, map_note, mean_rows, mean_uniform, seen_cameras
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode, positions_by_task
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.store_format import PolicyCameraView

Array = NDArray[np.float64]
#: A scale ends at this quantile of all values that are shown with it: a single patch must not make the others pale.
_TOP_QUANTILE = 0.995
#: It ends at this many times the value of uniform attention, or above.
_LEAST_TOP = 4.0


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
        return f"frames/{camera}" in self.item.episode.attributes.arrays


def stored_picture(item: SelectedEpisode, camera: str, replan: int) -> NDArray[np.uint8] | None:
    """The picture that the policy got, as a person sees the scene, (row, column, 3); None where none was stored."""
    if f"frames/{camera}" not in item.episode.attributes.arrays:
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
            f"The keys of site '{question.site}' are no patches of pictures that the policy sees; sites with cameras: "
            f"{listing(sites)}. Choose with --site."
        )
    for camera in wanted or ():
        if camera not in cameras:
            raise unknown_name("camera", camera, cameras)
    return cameras if wanted is None else tuple(wanted)


def episode_maps(question: Question, item: SelectedEpisode, cameras: Sequence[str]) -> EpisodeMaps:
    """Read one episode's attention, mean over the selected layers, denoise steps and heads."""
    tokens = item.tokens
    mean = mean_rows(item, question.selection, question.site)
    image = mean * (tokens.static_roles == int(Role.IMAGE))
    # As much mass as the valid keys have, shared out as uniform attention does.
    uniform = mean_uniform(item, question.selection)
    uniform = uniform * ((mean * item.valid).sum(axis=1) / (uniform * item.valid).sum(axis=1))[:, None]
    whole = image.sum(axis=1)
    maps = {}
    with np.errstate(divide="ignore", invalid="ignore"):
        for camera in cameras:
            picture = PictureMap.of(tokens.layout, camera)
            mass, even = (picture.spread(keys[:, picture.keys]) for keys in (mean, uniform))
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


def scale_end(values: NDArray[np.floating]) -> float:
    """Where a scale of lifts ends: at the 99.5 % quantile of the finite ones, at 4 or above, with two digits.

    Nearly uniform attention does not look concentrated on it.
    """
    finite = np.asarray(values)[np.isfinite(values)]
    high = max(float(np.quantile(finite, _TOP_QUANTILE)) if finite.size else 0.0, _LEAST_TOP)
    step = 10.0 ** (np.floor(np.log10(high)) - 1)
    return float(np.round(np.ceil(np.round(high / step, 9)) * step, 12))


def patch_table(maps: EpisodeMaps, replans: Sequence[int]) -> pl.DataFrame:
    """One row per (camera, replan, cell of its map): mass, share of all image attention, lift.

    `row` and `column` count in the stored picture, as selectors such as patch:CAMERA[r0:r1,c0:c1] do where the cells
    are the patches of one grid; `shown_row` and `shown_column` in the picture as it is drawn.
    """
    chosen = list(replans)
    axis: Axis = {"replan": chosen, "env_step": maps.env_step[chosen]}
    frames = []
    for camera, one in maps.cameras.items():
        place = np.moveaxis(np.indices(one.mass.shape[1:]), 0, -1)  # (row, column, 2)
        shown, turned = np.empty_like(place), upright(place, one.view)
        shown[turned[..., 0], turned[..., 1]] = place
        names = {
            "row": place[..., 0],
            "column": place[..., 1],
            "shown_row": shown[..., 0],
            "shown_column": shown[..., 1],
        }
        cells: Axis = {name: numbers.ravel() for name, numbers in names.items()}
        values = {"mass": one.mass, "share": one.share, "lift": one.lift}
        columns = {name: array[chosen].reshape(1, len(chosen), -1) for name, array in values.items()}
        frames.append(long_table(maps.item, [{"camera": (camera,)}, axis, cells], columns))
    return pl.concat(frames)


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
    for item in rest:
        if len(picked) >= count:
            break
        if all(item is not other for other in picked):
            picked.append(item)
    return picked
