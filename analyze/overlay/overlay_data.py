"""The data of an episode's overlays: patch maps, pictures, the ratio at each replan, outlines of groups."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.aggregate import overall_layer, replans_of
from vla_attention.analyze.measures.frames import Axis, long_table, rows_of_episode
from vla_attention.analyze.measures.patch_maps import PictureMap, map_note, mean_rows, mean_uniform, seen_cameras
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode, check_replan
from vla_attention.analyze.overlay.colours import (
    Measure,
    Scale,
    outline,
    outline_color,
    overlay_image,
    patch_values,
    scale_for,
)
from vla_attention.analyze.show.patch_pictures import upright
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.groupings.grouping import Grouping, parse_group_argument, with_groups
from vla_attention.schemas.groupings.resolve import check_names, resolve
from vla_attention.schemas.layout import Role, picture_size
from vla_attention.schemas.stores.store_format import PolicyCameraView

#: A group's patches are those of which it takes at least this share.
OUTLINE_WEIGHT = 0.5


@dataclass(frozen=True)
class EpisodeOverlay:
    """One episode's attention on its cameras.

    Attributes:
        item: the episode.
        env_step: environment step of each replan, (replan,).
        views: how each shown camera's picture was turned.
        pictures: by camera, how its patches lie on its map.
        maps: by camera, mass of every cell of its map (replan, row, column) in the stored orientation.
        outside: by camera, mass of its keys that lie nowhere in the picture, (replan,).
        image_mass: mass of all image keys of all cameras, (replan,).
        uniform_mass: by camera, what uniform attention gives every cell, (replan, row, column).
        num_image_keys: image keys of all cameras.
        ratio: ratio of the question's grouping at each replan (replan,), NaN where undefined; None when it has no
            ratio.
        uniform_ratio: what uniform attention would give, (replan,); None as above.
        outlines: by group and camera, at which cells the group takes a patch, (replan or 1, row, column).
    """

    item: SelectedEpisode
    env_step: NDArray[np.int64]
    views: dict[str, PolicyCameraView]
    pictures: dict[str, PictureMap]
    maps: dict[str, NDArray[np.float64]]
    outside: dict[str, NDArray[np.float64]]
    image_mass: NDArray[np.float64]
    uniform_mass: dict[str, NDArray[np.float64]]
    num_image_keys: int
    ratio: NDArray[np.float64] | None
    uniform_ratio: NDArray[np.float64] | None
    outlines: dict[str, dict[str, NDArray[np.bool_]]]

    @property
    def num_replans(self) -> int:
        """Number of replans."""
        return len(self.env_step)

    def has_frames(self, camera: str) -> bool:
        """Whether the camera's pictures were stored."""
        return f"frames/{camera}" in self.item.episode.attributes.arrays

    def share(self, camera: str, replan: int) -> float | None:
        """Part of all image attention on the keys of a camera, those outside of its map too; None without any."""
        of_image = self.image_mass[replan]
        return float((self.maps[camera][replan].sum() + self.outside[camera][replan]) / of_image) if of_image else None

    def values(self, measure: Measure) -> dict[str, NDArray[np.float64]]:
        """By camera, what overlays show (replan, row, column); see `overlays.patch_values`."""
        return {
            camera: patch_values(mass, self.image_mass, self.uniform_mass[camera], measure)
            for camera, mass in self.maps.items()
        }

    def scale(self, measure: Measure, replans: Sequence[int]) -> Scale:
        """One scale for all cameras at these replans."""
        shown = [values[list(replans)].ravel() for values in self.values(measure).values()]
        return scale_for(np.concatenate(shown), measure, self.num_image_keys)


def camera_names(question: Question, wanted: Sequence[str] | None) -> tuple[str, ...]:
    """The cameras to show: those that the policy sees at the question's site, or the wanted ones among them.

    Raises:
        BadArgument: the site has no camera pictures among its keys.
        UnknownName: a wanted camera is not one of them.
    """
    cameras = seen_cameras(question.selected[0])
    if not cameras:
        sites = [site.name for site in question.stores[0].attributes.sites if site.pictured]
        raise BadArgument(
            f"The keys of site '{question.site}' are no patches of pictures, so an overlay has nothing to show; "
            f"sites with cameras: {listing(sites)}. Choose with --site."
        )
    for camera in wanted or ():
        if camera not in cameras:
            raise unknown_name("camera", camera, cameras)
    return cameras if wanted is None else tuple(wanted)


def outline_grouping(texts: Sequence[str]) -> Grouping | None:
    """The groups of `--group NAME=SELECTOR`, which may share keys; None without any."""
    if not texts:
        return None
    grouping = with_groups(None, [parse_group_argument(text) for text in texts])
    named = {name: value for name, value in grouping.groups.items() if name != "rest" or value != ("*",)}
    return replace(grouping, groups=named, overlap=True, ratio=None, allow_empty=tuple(named))


def ratios_of(question: Question, item: SelectedEpisode) -> pl.DataFrame:
    """The cells of `measures.aggregate.replan_tables` of one episode."""
    return replans_of(replace(question, selected=(item,))).cells


def episode_overlay(
    question: Question,
    item: SelectedEpisode,
    cameras: Sequence[str],
    replans: pl.DataFrame,
    groups: Grouping | None = None,
) -> EpisodeOverlay:
    """Read one episode's attention, mean over the selected layers, denoise steps and heads.

    Args:
        question: what is asked.
        item: one of its episodes.
        cameras: which cameras (`camera_names`).
        replans: table of replans that has at least this episode (`ratios_of`, or a whole analysis's).
        groups: groups whose patches are outlined.
    """
    tokens = item.tokens
    mean = mean_rows(item, question.selection, question.site)
    image = tokens.static_roles == int(Role.IMAGE)
    # As much mass as the valid keys have, shared out as uniform attention does.
    valid, uniform_keys = item.valid, mean_uniform(item, question.selection)
    uniform_keys = uniform_keys * ((mean * valid).sum(axis=1) / (uniform_keys * valid).sum(axis=1))[:, None]
    attributes = item.store.attributes.policy
    by_name = {view.name: view for view in attributes.cameras}
    pictures = {camera: PictureMap.of(tokens.layout, camera) for camera in cameras}
    maps, of_uniform, outside, views = {}, {}, {}, {}
    for camera, picture in pictures.items():
        maps[camera], of_uniform[camera] = (picture.spread(keys[:, picture.keys]) for keys in (mean, uniform_keys))
        placeless = [span for span in tokens.layout.camera_spans(camera) if span.grid is None]
        outside[camera] = sum((mean[:, span.start : span.stop].sum(axis=1) for span in placeless), np.zeros(len(mean)))
        views[camera] = by_name.get(camera, PolicyCameraView(camera, camera, True, False))
    ratio = uniform = None
    if question.grouping.ratio is not None:
        of_episode = rows_of_episode(replans, item)
        rows = of_episode.filter(pl.col("layer") == overall_layer(of_episode)).sort("replan")
        ratio = rows["ratio"].fill_null(float("nan")).to_numpy()
        uniform = rows["uniform_ratio"].fill_null(float("nan")).to_numpy()
    return EpisodeOverlay(
        item=item,
        env_step=item.episode.read("env_step").astype(np.int64),
        views=views,
        pictures=pictures,
        maps=maps,
        outside=outside,
        image_mass=(mean * image).sum(axis=1),
        uniform_mass=of_uniform,
        num_image_keys=int(image.sum(axis=1).max()),
        ratio=ratio,
        uniform_ratio=uniform,
        outlines=_outlines(item, pictures, groups),
    )


def _outlines(
    item: SelectedEpisode, pictures: Mapping[str, PictureMap], groups: Grouping | None
) -> dict[str, dict[str, NDArray[np.bool_]]]:
    if groups is None:
        return {}
    weights = resolve(groups, item.tokens).weights
    taken = {camera: weights[:, picture.keys] >= OUTLINE_WEIGHT for camera, picture in pictures.items()}
    return {
        name: {camera: picture.highest(taken[camera][..., i]) for camera, picture in pictures.items()}
        for i, name in enumerate(groups.names)
    }


def check_outlines(question: Question, groups: Grouping | None) -> None:
    """Raise `SelectorError` for a group with a name that exists nowhere in the selection."""
    if groups is not None:
        check_names(groups, question.vocabulary, question.selected[0].tokens.layout)


def draw(
    overlay: EpisodeOverlay,
    camera: str,
    replan: int,
    scale: Scale,
    values: Mapping[str, NDArray[np.float64]],
    smooth: bool = False,
) -> NDArray[np.uint8]:
    """One overlay (row, column, 3), turned as a person sees the scene, with outlines."""
    frame = overlay.item.episode.read(f"frames/{camera}", replan) if overlay.has_frames(camera) else None
    size = picture_size([overlay.item.tokens.layout], camera)
    image = overlay_image(frame, values[camera][replan], scale, smooth, size)
    for i, by_camera in enumerate(overlay.outlines.values()):
        member = by_camera[camera]
        color = outline_color(i)
        image = outline(image, member[replan if len(member) > 1 else 0], color, max(1, image.shape[0] // 112))
    return upright(image, overlay.views[camera])


def overlay_table(overlay: EpisodeOverlay, replans: Sequence[int]) -> pl.DataFrame:
    """The numbers that overlays show, one row per (camera, replan, cell of its map); see `PictureMap`.

    `row` and `column` count in the stored picture, as selectors such as patch:CAMERA[r0:r1,c0:c1] do where the cells
    are the patches of one grid; `shown_row` and `shown_column` in the picture as it is drawn.
    """
    lift, share = overlay.values("lift"), overlay.values("share")
    chosen = list(replans)
    axis: Axis = {"replan": chosen, "env_step": overlay.env_step[chosen]}
    frames = []
    for camera, mass in overlay.maps.items():
        place = np.moveaxis(np.indices(mass.shape[1:]), 0, -1)  # (row, column, 2)
        shown = np.empty_like(place)
        turned = upright(place, overlay.views[camera])
        shown[turned[..., 0], turned[..., 1]] = place
        patches = {
            "row": place[..., 0].ravel(),
            "column": place[..., 1].ravel(),
            "shown_row": shown[..., 0].ravel(),
            "shown_column": shown[..., 1].ravel(),
        }
        values = {"mass": mass, "share_percent": share[camera], "lift": lift[camera]}
        columns = {name: array[chosen].reshape(1, len(chosen), -1) for name, array in values.items()}
        if overlay.ratio is not None:
            columns["ratio"] = overlay.ratio[chosen][:, None]
        frames.append(long_table(overlay.item, [{"camera": (camera,)}, axis, patches], columns, keys=()))
    return pl.concat(frames)


def chosen_replans(overlay: EpisodeOverlay, wanted: Sequence[int] | None, most: int) -> tuple[int, ...]:
    """The wanted replans, or `most` of them spread evenly from the first to the last."""
    count = overlay.num_replans
    if wanted is None:
        return tuple(int(i) for i in np.unique(np.linspace(0, count - 1, min(most, count)).round()))
    return tuple(check_replan(overlay.item, replan) for replan in wanted)


def orientation_note(overlay: EpisodeOverlay) -> str:
    """How the pictures were turned for display, and what their maps add up and leave out; empty when nothing is so."""
    mirrored = [camera for camera, view in overlay.views.items() if view.mirrored]
    turned = [camera for camera, view in overlay.views.items() if not view.upright]
    notes = []
    if mirrored:
        which = "Pictures are" if len(mirrored) == len(overlay.views) else f"{listing(mirrored)}:"
        notes.append(f"{which} shown as the scene is; the model sees left and right exchanged.")
    if turned:
        which = "Pictures are" if len(turned) == len(overlay.views) else f"{listing(turned)}:"
        notes.append(f"{which} shown right way up; the model sees them upside down.")
    layout = overlay.item.tokens.layout
    for camera, beside in overlay.outside.items():
        placed = overlay.maps[camera].sum()
        notes.append(map_note(layout, camera, float(beside.sum() / max(beside.sum() + placed, np.finfo(float).tiny))))
    missing = [camera for camera in overlay.views if not overlay.has_frames(camera)]
    if missing:
        notes.append(f"No pictures were stored of {listing(missing)}: attention alone, on grey.")
    return " ".join(note for note in notes if note)
