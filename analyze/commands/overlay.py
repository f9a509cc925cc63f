"""Attention on the stored pictures: which patch gets most, what is there, and a strip of pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.commands.overlay_maps import (
    caption_of_moves,
    how_drawn,
    of_both,
    place_in,
    units_of_maps,
    with_rows_of_moves,
)
from vla_attention.analyze.core.about import about, notes
from vla_attention.analyze.core.camera_maps import (
    EpisodeMaps,
    camera_names,
    choose_episodes,
    episode_maps,
    line_levels,
    orientation_notes,
    patch_table,
    scale_end,
    stored_picture,
    upright,
)
from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.core.map_pictures import episode_moves, with_moves
from vla_attention.analyze.core.result import Column, Figure, Finding, Result, Table
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import check_replan, find_episode
from vla_attention.analyze.measures.tables import EPISODE_ID, LAYERS_AVG
from vla_attention.analyze.render.video import check_video, write_film
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.grouping import Grouping, parse_group_argument, with_groups
from vla_attention.schemas.groupings.resolve import check_names, resolve
from vla_attention.schemas.safe_text import file_part, visible

_TINY = float(np.finfo(float).tiny)
#: A group's patches are those of which it takes at least this share.
_OUTLINE_WEIGHT = 0.5
_COLUMNS = (
    Column("task_id", "count", "task"),
    Column("episode_index", "count", "episode"),
    Column("step", "count", meaning="actions executed before the call, after the waiting steps"),
    Column("camera", "text"),
    Column("share", "percent", "of image attention"),
    Column("lift", "factor", "highest", "times the attention that the patch would get if it were spread evenly"),
    Column("place", "text", "where", "place in the picture as it is shown"),
    Column("object", "text", meaning="what covers most of that patch"),
    Column("ratio", "number", "ratio", "of the grouping, geometric mean of the layers"),
)


def overlay(question: Question, episode: int | None = None, replans: Sequence[int] | None = None,
            cameras: Sequence[str] | None = None, outline: Sequence[str] = (), smooth: bool = False,
            video: Literal["gif", "mp4"] | None = None, fps: float = 4.0, num_episodes: int = 2,
            num_replans: int = 8) -> Result:  # fmt: skip
    """Pictures of some episodes with the attention on them, on one scale; below, what moves the action, where known.

    Args:
        question: stores, selection and grouping, whose ratio stands above the pictures.
        episode: the number of the one that is shown; unless it or `replans` are given, `num_episodes` are chosen, of
            tasks spread evenly over all, solved and failed ones in turn.
        replans: the policy calls that are shown; `num_replans` from the first to the last unless they are given.
        cameras: those that are shown; all that the policy sees unless they are given.
        outline: NAME=SELECTOR, groups around whose patches lines are drawn.
        smooth: attention changes smoothly between patches.
        video: also a film of each episode, with `fps` policy calls a second.

    Raises:
        UserError: a subclass that says which name or number does not exist.
    """
    if video:
        check_video(video)
    if not 0.1 <= fps <= 50:
        raise BadArgument(f"Cannot write {fps} pictures a second; expected --fps from 0.1 to 50.")
    names, groups = camera_names(question, cameras), _outlines(question, outline)
    single = episode is not None or replans is not None
    chosen = (
        [find_episode(question.selected, None, episode)] if single else choose_episodes(question.selected, num_episodes)
    )
    of_chosen = replace(question, selected=tuple(chosen))
    every = [episode_maps(question, item, names) for item in chosen]
    units = units_of_maps(question, chosen)
    moved = [None if units is None else episode_moves(item, names, units) for item in chosen]
    ratios = _ratios(of_chosen)
    shown = [_chosen_replans(maps, replans, num_replans) for maps in every]
    # Of all their policy calls, so that lines mean the same in a strip, in a film and on the page.
    high = scale_end(np.concatenate([one.lift.ravel() for maps in every for one in maps.cameras.values()]))
    levels = line_levels(high)
    of_words = np.array([lift for maps in every for line in maps.words for _, lift in line])
    options = {"high": high, "levels": levels, "smooth": smooth, "outlines": list(groups.names) if groups else [],
               "words_high": scale_end(of_words)}  # fmt: skip
    if units is not None:
        options["second"] = how_drawn([moves for moves in moved if moves is not None])
    figures, files, parts = [], {}, []
    for maps, moves, which in zip(every, moved, shown, strict=True):
        frame = _frame(maps, range(len(maps.env_step)), ratios, groups)
        parts.append(frame)
        own = options if moves is not None else {**options, "second": None}
        if moves is not None and units is not None:
            frame = with_rows_of_moves(frame, moves, units)
        figure = _figure(question, maps, frame.filter(pl.col("replan").is_in(list(which))), own, levels)
        figures.append(figure)
        if video:
            film = _figure(question, maps, frame, own, levels)
            files[f"{figure.name}.{video}"] = partial(write_film, figure=film, fps=fps, kind=video)
    of_shown = [part.filter(pl.col("replan").is_in(list(which))) for part, which in zip(parts, shown, strict=True)]
    table = pl.concat(of_shown).select(*_KEPT)
    held = [column for column in _COLUMNS if table[column.name].null_count() < table.height]
    of_patches = [patch_table(maps, which) for maps, which in zip(every, shown, strict=True)]
    findings = [_finding(question, every[0], table)]
    if units is not None:
        of_patches = [with_moves(rows, moves) for rows, moves in zip(of_patches, moved, strict=True)]
        findings += of_both(question, every, moved, shown)
    patches = pl.concat(of_patches)
    return Result(
        "Where it looks", about(question), findings,
        [Table("overlay", table, held, "Pictures"), Table("overlay_patches", patches)],
        figures, [*notes(question), *orientation_notes(every)], files,
    )  # fmt: skip


def _outlines(question: Question, texts: Sequence[str]) -> Grouping | None:
    """The groups, which may share keys; None without any."""
    if not texts:
        return None
    grouping = with_groups(None, [parse_group_argument(text) for text in texts])
    named = {name: value for name, value in grouping.groups.items() if name != "rest" or value != ("*",)}
    groups = replace(grouping, groups=named, overlap=True, ratio=None, allow_empty=tuple(named))
    check_names(groups, question.vocabulary)
    return groups


def _ratios(question: Question) -> pl.DataFrame | None:
    """The ratio of every replan; None for a grouping without one."""
    if question.grouping.ratio is None:
        return None
    return (
        levels_of(question)
        .replans()
        .filter(pl.col("layer") == LAYERS_AVG)
        .select(*EPISODE_ID, "replan", "ratio")
        .collect()
    )


def _chosen_replans(maps: EpisodeMaps, wanted: Sequence[int] | None, most: int) -> tuple[int, ...]:
    """The wanted replans, or `most` of them spread evenly from the first to the last."""
    if wanted is not None:
        return tuple(check_replan(maps.item, replan) for replan in wanted)
    count = len(maps.env_step)
    return tuple(int(i) for i in np.unique(np.linspace(0, count - 1, min(most, count)).round()))


_KEPT = (*EPISODE_ID, "replan", "env_step", "step", "camera", "share", "lift", "place", "object", "ratio")


def _frame(
    maps: EpisodeMaps, replans: Sequence[int], ratios: pl.DataFrame | None, groups: Grouping | None
) -> pl.DataFrame:
    """A row for each picture: where it stands in the figure, what is written about it, and its map."""
    item, identity = maps.item, dict(zip(EPISODE_ID, maps.item.key, strict=True))
    known = {} if ratios is None else dict(ratios.filter(**identity).select("replan", "ratio").iter_rows())
    taken = None if groups is None else resolve(groups, item.tokens).weights >= _OUTLINE_WEIGHT
    starts, _ = item.timing(maps.env_step)
    rows = []
    for camera, one in maps.cameras.items():
        covering = (item.tokens.coverage or {}).get(camera)
        members = None if taken is None else np.moveaxis(taken[:, one.picture.keys], -1, 1)
        for replan in replans:
            lift = upright(one.lift[replan], one.view)
            row, column = np.unravel_index(int(np.nan_to_num(lift).argmax()), lift.shape)
            share = float((one.mass[replan].sum() + one.outside[replan]) / max(maps.image_mass[replan], _TINY))
            ratio = known.get(replan)
            step = int(starts[replan])
            place = place_in(int(row), int(column), lift.shape)
            cells = None if members is None else one.picture.highest(members[min(replan, len(members) - 1)])
            rows.append({
                **identity, "replan": replan, "env_step": int(maps.env_step[replan]), "step": step, "camera": camera,
                "row": camera, "column": replan,
                "above": f"step {step}" + ("" if ratio is None else f", ratio {ratio:.3g}"),
                "below": f"{share:.0%} of image attention\nhighest {float(f'{lift[row, column]:.2g}'):g}, {place}",
                "map": lift.tolist(), "share": share, "lift": float(lift[row, column]), "place": place,
                "object": None if covering is None else _object(maps, camera, covering[replan], replan),
                "ratio": ratio,
                "members": None if cells is None else [upright(cell, one.view).tolist() for cell in cells],
                "words": [visible(word) for word, _ in maps.words[replan]] if maps.words else None,
                "lifts": [value for _, value in maps.words[replan]] if maps.words else None,
            })  # fmt: skip
    return pl.DataFrame(rows, schema_overrides=_TYPES, infer_schema_length=None)


_TYPES: dict[str, Any] = {
    "object": pl.String, "ratio": pl.Float64, "members": pl.List(pl.List(pl.List(pl.Boolean))),
    "map": pl.List(pl.List(pl.Float64)), "words": pl.List(pl.String), "lifts": pl.List(pl.Float64),
}  # fmt: skip


def _object(maps: EpisodeMaps, camera: str, covering: NDArray[np.float32], replan: int) -> str:
    """What covers most of the patch with the highest lift; `covering` is (patch, object)."""
    one = maps.cameras[camera]
    cells = one.picture.finest(covering.T)  # (object, cell)
    thing = int(cells[:, int(np.nan_to_num(one.lift[replan]).argmax())].argmax())
    return visible(maps.item.tokens.objects[thing].name)


def _picture(
    row: Mapping[str, Any], read: Mapping[tuple[str, int], NDArray[np.uint8] | None]
) -> NDArray[np.uint8] | None:
    return read[row["camera"], row["replan"]]


def _named(maps: EpisodeMaps) -> str:
    attributes = maps.item.episode.attributes
    outcome = {True: ", solved", False: ", not solved", None: ""}[attributes.success]
    return (
        f"'{visible(attributes.instruction)}', task {attributes.task_id}, episode {attributes.episode_index}{outcome}"
    )


def _figure(
    question: Question, maps: EpisodeMaps, frame: pl.DataFrame, options: Mapping[str, Any], levels: Sequence[float]
) -> Figure:
    several = len(question.stores) > 1
    name = f"overlay_{file_part(maps.item.store.suite) + '_' if several else ''}{maps.item.episode.name}"
    # Read now: a damaged picture ends the command before anything is written.
    places, item = frame.select("camera", "replan").rows(), maps.item
    read = {place: stored_picture(item, *place) for place in places}
    lines = " and ".join(f"{level:g}" for level in levels)
    caption = (
        "Attention of the action queries on the pictures that the policy saw, mean over the selected layers, denoise "
        "steps and heads. Pale: no more than evenly spread attention would give; the more a patch gets, the more of "
        f"its colour is kept (all of it from {options['high']:g} times on); lines: at {lines} times. Words: the darker,"
        " the more attention per token."
    )
    caption += caption_of_moves(options.get("second"))
    return Figure(name, "pictures", frame, _named(maps), caption, {**options, "picture": partial(_picture, read=read)})


def _finding(question: Question, maps: EpisodeMaps, table: pl.DataFrame) -> Finding:
    """The patch with the highest lift of the first episode, and what is there."""
    own = table.filter(**dict(zip(EPISODE_ID, maps.item.key, strict=True)))
    row = own.sort("lift").row(-1, named=True)
    on = "" if row["object"] is None else f", on the {row['object'].replace('_', ' ')}"
    said = (
        f"In {_named(maps)}, most attention for its size goes to a patch at the {row['place']} of {row['camera']}{on}: "
        f"{row['lift']:.2g} times what evenly spread attention would give it (step {row['step']})."
    )
    numbers = {name: row[name] for name in ("lift", "share", "camera", "replan", "env_step", "step", "place", "object")}
    limit, store = "This is one patch of one policy call; over all episodes:", question.stores[0].path
    over_all = f"analyze {store} --by camera" if row["object"] is None else f"objects {store}"
    return Finding(said, "Where does it look?", numbers, limit, f"vla-attention {over_all}")
