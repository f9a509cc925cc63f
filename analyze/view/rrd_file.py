"""An episode as a Rerun recording (`.rrd`): pictures, words, numbers, poses and events on one time line.

Times are steps of the environment: a replan stands at the number of steps before it, a pose at the step that led to it.
Numbers are means over layers, denoise steps and heads, the same as on the page. Entities:

    about                      what happened, and what the numbers are
    pictures/CAMERA            what the policy got, as a person sees the scene; below it the lines around the patches
                               that get so many times even attention, pictures/CAMERA/2 times even
    words                      the instruction with attention and effect of every word, as a table
    ratio, masses, attention   by replan: the ratio and what even attention gives; mass of groups; times even of words
    effects                    by replan: how the action changes without an item, in its units
    scene                      by step: hand and objects in 3D, in metres
    actions                    by step: what was executed, a number a dimension; else the actions that were returned
    events                     touches, reached goals, closings of the gripper, the end

Where a run has several sites, SITE stands before pictures, words, ratio, masses and attention.
"""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vla_attention.analyze.core.action_changes import ActionUnits, units_of
from vla_attention.analyze.core.camera_maps import (
    EpisodeMaps,
    episode_maps,
    line_levels,
    scale_end,
    seen_cameras,
    upright,
)
from vla_attention.analyze.render.files import replacing, writing
from vla_attention.analyze.render.pictures import borders
from vla_attention.analyze.render.style import group_styles
from vla_attention.analyze.view.episode_answers import MEAN, ShownEpisode
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.episode_steps import EXECUTED, HAND, POSES
from vla_attention.schemas.errors import BadArgument, MissingDependency, plural
from vla_attention.schemas.progress_bar import progress_bar
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import STORE_SUFFIX

if TYPE_CHECKING:
    import rerun

SUFFIX = ".rrd"
TIMELINE = "step"
_MARKDOWN = "text/markdown"
#: The oldest release that has every call below; LeRobot 0.4 takes it, too.
OLDEST = (0, 24)
#: Colours of the lines, the first around the larger part; half their width in pixels of the screen, which Rerun has as
#: negative numbers.
_LINES = ((0x00, 0xB5, 0xCC), (0xE0, 0x40, 0xA0))
_WIDE = 1.2
#: Curves that others are held against, and their colour, which light and dark viewers show.
_BASELINES, _BASELINE_COLOR = ("spread evenly", "another noise seed"), "#8F8F8F"
#: An action in a simulator of ours.
_ACTIONS = ("x", "y", "z", "turn x", "turn y", "turn z", "gripper")
#: Lengths of the hand's axes in metres, and of half an object's mark.
_AXES, _MARK = 0.05, 0.012
_AXIS_COLORS = ((0xD5, 0x5E, 0x00), (0x00, 0x9E, 0x73), (0x00, 0x72, 0xB2))


def rerun_library() -> Any:
    """Rerun's Python library.

    Raises:
        MissingDependency: it is not installed, or older than `OLDEST`.
    """
    install = "pip install 'vla-attention[rerun]'"
    try:
        import rerun
    except ImportError:
        raise MissingDependency(f"A Rerun recording needs rerun-sdk, which is not installed: {install}.") from None
    if tuple(int(part) for part in rerun.__version__.split(".")[:2]) < OLDEST:
        oldest = ".".join(map(str, OLDEST))
        raise MissingDependency(
            f"A Rerun recording needs rerun-sdk {oldest} or later, and {rerun.__version__} is installed: {install}."
        )
    return rerun


def write_recordings(path: Path, store: Store, episodes: Sequence[StoredEpisode]) -> str:
    """Write episodes of a store; returns what was written, in words.

    path: a file NAME.rrd for one episode, or a folder that gets a file an episode.
    """
    if path.suffix == STORE_SUFFIX:
        raise BadArgument(f"Cannot write recordings to {path}: it is named like a store; give NAME.rrd or a folder.")
    rr = rerun_library()
    units = units_of([store], skip_corrupt=True) if any(one.attributes.effects for one in store.episodes) else None
    size = 0
    with writing("recordings", path, "another --rrd"), progress_bar(len(episodes), "episodes") as advance:
        for episode in episodes:
            file = path if path.suffix == SUFFIX else path / f"{episode.name}{SUFFIX}"
            with replacing(file) as temporary:
                _write(rr, temporary, ShownEpisode(store, episode), units)
            if not size and len(episodes) > 1:
                about = format_bytes(file.stat().st_size * len(episodes))
                print(f"About {about} for {len(episodes)} episodes.", flush=True)
            size += file.stat().st_size
            advance(1)
    opened = shlex.quote(str(path)) + f"/*{SUFFIX}" * (path.suffix != SUFFIX)
    return f"{path}: {plural(len(episodes), 'episode')}, {format_bytes(size)}. Open with: rerun {opened}"


@dataclass(frozen=True)
class Logged:
    """What stands at an entity.

    Attributes:
        place: the parts of its path.
        kind: a type of Rerun's.
        values: its fields, by their names there; with several steps a row for each of them.
        steps: at which it stands; None: throughout.
    """

    place: tuple[str, ...]
    kind: str
    values: Mapping[str, Any]
    steps: int | Sequence[int] | None = None


def logged(
    shown: ShownEpisode, about: Mapping[str, Any], effects: Sequence[Mapping[str, Any]], units: ActionUnits | None
) -> Iterator[Logged]:
    """Everything that a recording of an episode holds but for its arrangement.

    about: of `ShownEpisode`; effects: of `shown_effects`, in `units`, none where none was measured.
    """
    starts = about["starts"]
    yield Logged(("about",), "TextDocument", {"text": _about(shown, about, units), "media_type": _MARKDOWN})
    sites = [site.name for site in shown.store.attributes.sites]
    for site in sites:
        before = (site,) if len(sites) > 1 else ()
        maps = episode_maps(shown.question(site), shown.item(site), seen_cameras(shown.item(site)))
        yield from _pictures(before, shown, maps, starts)
        yield from _words(before, maps, effects, starts)
        yield from _groups(before, shown.groups(site, MEAN, MEAN), starts)
    for kind in _kinds(effects):
        curves = {item["label"]: item["effect"] for item in effects if _kind(item) == kind}
        yield from _series(("effects", kind), starts, curves)
    yield from _scene(shown)
    yield from _actions(shown, about)
    for event in about["events"]:
        yield Logged(("events",), "TextLog", {"text": event["text"]}, event["step"])


def _write(rr: Any, path: Path, shown: ShownEpisode, units: ActionUnits | None) -> None:
    """Write one episode."""
    about = shown.about()
    stream = rr.RecordingStream("vla-attention", recording_id=f"{shown.store.run} {shown.episode.name}")
    if not rr.is_enabled(stream):
        raise BadArgument("Rerun is switched off by the environment variable RERUN; unset it.")
    effects = [] if units is None else shown_effects(shown, units)
    # To a full disk Rerun itself writes half a file, and says so in its log alone. Only an active blueprint is shown.
    memory = stream.memory_recording()
    stream.send_blueprint(_blueprint(rr, about, _kinds(effects)))
    stream.send_recording_name(f"{shown.store.suite}: {about['told'] or about['instruction']} ({shown.episode.name})")
    if about["courses"]:
        stream.log("scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for one in logged(shown, about, effects, units):
        _log(rr, stream, one)
    path.write_bytes(memory.drain_as_bytes())
    stream.disconnect()


def _log(rr: Any, stream: rerun.RecordingStream, one: Logged) -> None:
    place, kind = _path(rr, one.place), getattr(rr, one.kind)
    if isinstance(one.steps, Sequence):
        times = rr.TimeColumn(TIMELINE, sequence=list(one.steps))
        stream.send_columns(place, [times], kind.columns(**one.values))
        return
    if one.steps is not None:
        stream.set_time(TIMELINE, sequence=one.steps)
    stream.log(place, kind(**one.values), static=one.steps is None)


def _series(
    place: tuple[str, ...], steps: Sequence[int], curves: Mapping[str, Sequence[float | None]]
) -> Iterator[Logged]:
    """Curves by their names below a place, a number a step; null and what is not finite are left out."""
    colors = group_styles(list(curves))
    for name, values in curves.items():
        pairs = zip(steps, values, strict=True)
        known = [(step, value) for step, value in pairs if value is not None and math.isfinite(value)]
        if known:
            numbers = {"scalars": [value for _, value in known]}
            yield Logged((*place, name), "Scalars", numbers, [step for step, _ in known])
            color = _BASELINE_COLOR if name in _BASELINES else colors[name]["color"]
            look = {"colors": [tuple(bytes.fromhex(color[1:]))], "names": [name]}
            yield Logged((*place, name), "SeriesLines", look)


def _about(shown: ShownEpisode, about: Mapping[str, Any], units: ActionUnits | None) -> str:
    root = shown.store.attributes
    return (
        f"**{about['verdict']}**\n\nSuite {visible(shown.store.suite)}, task {about['task']}, episode "
        f"{about['episode']}; policy {visible(root.policy.name)}; run {shown.store.run[:8]}.\n\nAttention of the "
        "action queries, mean over layers, denoise steps and heads. *Times even*: what a word or patch gets, divided "
        "by what it would get if attention were spread evenly."
        + ("" if units is None else f" *Effect*: without the item, {units.said('so much')} ({units.title}).")
    )


def shown_effects(shown: ShownEpisode, units: ActionUnits) -> list[dict[str, Any]]:
    """The effects of taking an item away, or of other words, and the noise; from all queries where both were tried."""
    found = shown.effects(units)
    items = [] if found is None else found["items"]
    readers = {item["reader"] for item in items}
    reader = "total" if "total" in readers else "direct"
    return [
        item | {"effect": item["effect"][0]}
        for item in items
        if item["kind"] in ("without", "prompt", "image", "noise") and item["reader"] in (None, reader)
    ]


def _kinds(effects: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(map(_kind, effects)))


def _kind(item: Mapping[str, Any]) -> str:
    """Under which an effect is drawn: what is taken away, or how the call is changed otherwise."""
    return str(item["item_kind"] if item["kind"] == "without" else item["kind"])


def _pictures(
    before: tuple[str, ...], shown: ShownEpisode, maps: EpisodeMaps, starts: Sequence[int]
) -> Iterator[Logged]:
    """What the policy got, with lines around the patches that get much more than even attention."""
    lifts = [one.lift.ravel() for one in maps.cameras.values()]
    levels = line_levels(scale_end(np.concatenate(lifts))) if lifts else []
    for camera, one in maps.cameras.items():
        place, grid = (*before, "pictures", camera), one.picture.grids[0]
        sides = float(grid.image_width), float(grid.image_height)
        for replan, step in enumerate(starts):
            if maps.has_frames(camera):
                png = {"contents": shown.picture(camera, replan), "media_type": "image/png"}
                yield Logged(place, "EncodedImage", png, step)
            lift = upright(one.lift[replan], one.view)
            for number, (level, color) in enumerate(zip(levels, _LINES, strict=False)):
                around = borders(lift >= level, 0.1 * number, (0.0, 0.0), sides)
                lines = {"strips": [(one[:2], one[2:]) for one in around], "colors": [color], "radii": -_WIDE}
                yield Logged((*place, f"{level:g} times even"), "LineStrips2D", lines, step)


def _words(
    before: tuple[str, ...], maps: EpisodeMaps, effects: Sequence[Mapping[str, Any]], starts: Sequence[int]
) -> Iterator[Logged]:
    """Every word's attention, as a series and in a table beside its effect; a word that comes twice has a number."""
    effect_of = {item["item"]: item["effect"] for item in effects if _kind(item) == "word"}
    curves: dict[str, list[float | None]] = {}
    for replan, words in enumerate(maps.words):
        lines, seen = ["| word | times even | effect |", "|---|---:|---:|"], Counter[str]()
        for word, lift in words:
            text = visible(word)
            seen[text] += 1
            name = text if seen[text] == 1 else f"{text} ({seen[text]})"
            curves.setdefault(name, [None] * len(starts))[replan] = lift
            tried = effect_of.get(text.casefold())  # effects name words in lower case
            effect = None if tried is None else tried[replan]
            lines.append(f"| {text} | {lift:.2f} | {'' if effect is None else f'{effect:.2f}'} |")
        table = {"text": "\n".join(lines), "media_type": _MARKDOWN}
        yield Logged((*before, "words"), "TextDocument", table, starts[replan])
    yield from _series((*before, "attention"), starts, curves)


def _groups(before: tuple[str, ...], groups: Mapping[str, Any], starts: Sequence[int]) -> Iterator[Logged]:
    """The ratio, and the mass of every group that has any: mean of the layers, which is the last one."""
    masses = {name: [line[-1] for line in group["mass"]] for name, group in groups["groups"].items()}
    yield from _series((*before, "masses"), starts, {name: values for name, values in masses.items() if any(values)})
    if groups["sides"]:
        ratios = {"ratio": groups["ratio"], "spread evenly": groups["uniform_ratio"]}
        yield from _series((*before, "ratio"), starts, {name: [line[-1] for line in of] for name, of in ratios.items()})


def _scene(shown: ShownEpisode) -> Iterator[Logged]:
    """Hand and objects where they were at every step; the hand with the axes of its own frame and its way."""
    steps = shown.episode.attributes.steps
    if steps is None:
        return
    poses = shown.episode.read(POSES).astype(np.float64)  # (moment, body, position and w, x, y, z)
    for i, body in enumerate(steps.bodies):
        name = visible(body.replace("_", " "))
        turned = np.roll(poses[:, i, 3:], -1, axis=1)  # Rerun has w last
        moved = {"translation": poses[:, i, :3], "quaternion": turned}
        yield Logged(("scene", name), "Transform3D", moved, range(len(poses)))
        if body == HAND:
            axes = {"vectors": np.eye(3) * _AXES, "colors": _AXIS_COLORS, "radii": _AXES / 16}
            yield Logged(("scene", name, "axes"), "Arrows3D", axes)
            way = {"strips": [poses[:, i, :3]], "colors": [(0x88, 0x88, 0x88)], "radii": _AXES / 40}
            yield Logged(("scene", "way of the hand"), "LineStrips3D", way)
        else:
            named = body in shown.named
            color = (0xE6, 0x9F, 0x00) if named else (0x99, 0x99, 0x99)
            mark = {"half_sizes": [_MARK] * 3, "colors": [color], "labels": [name + " (named)" * named]}
            yield Logged(("scene", name, "mark"), "Boxes3D", mark)


def _actions(shown: ShownEpisode, about: Mapping[str, Any]) -> Iterator[Logged]:
    """Every executed action; of a loop that is not ours the chunks' actions up to the next replan."""
    steps: Sequence[int]
    names: Sequence[str]
    if shown.episode.attributes.steps is not None:
        actions = shown.episode.read(EXECUTED)
        steps, names = range(len(actions)), _ACTIONS
    elif shown.episode.has("actions"):
        starts, chunks = about["starts"], shown.episode.read("actions")  # (replan, step, dimension)
        ends = [*starts[1:], about["end"]]
        taken = [chunk[: end - start] for start, end, chunk in zip(starts, ends, chunks, strict=True)]
        actions = np.concatenate(taken)
        steps = [start + i for start, chunk in zip(starts, taken, strict=True) for i in range(len(chunk))]
        names = [str(i) for i in range(actions.shape[1])]
    else:
        return
    curves = {name: values.astype(float).tolist() for name, values in zip(names, actions.T, strict=True)}
    yield from _series(("actions",), steps, curves)


def _blueprint(rr: Any, about: Mapping[str, Any], kinds: Collection[str]) -> Any:
    """Pictures, words and scene on the left, numbers over time on the right; kinds: of items with an effect."""
    import rerun.blueprint as rrb

    sites = {site: [site] if len(about["sites"]) > 1 else [] for site in about["sites"]}
    spelled = [site for site in sites if any(prompt["words"] for prompt in about["sites"][site]["prompts"])]

    def place(site: str, *parts: str, name: str) -> dict[str, str]:
        return {"origin": _path(rr, [*sites[site], *parts]), "name": f"{name} ({site})" if sites[site] else name}

    pictures = [
        rrb.Spatial2DView(**place(site, "pictures", camera, name=camera))
        for site in sites
        for camera in about["sites"][site]["cameras"]
    ]
    texts = [
        rrb.TextDocumentView(origin="/about", name="episode"),
        *[rrb.TextDocumentView(**place(site, "words", name="words")) for site in spelled],
    ]
    scene = [rrb.Spatial3DView(origin="/scene", name="scene (m)")] if about["courses"] else []
    left = [rrb.Horizontal(*pictures)] * bool(pictures)
    left += [rrb.Horizontal(rrb.Vertical(*texts), *scene), rrb.TextLogView(origin="/events", name="events")]
    plots = [
        *[rrb.TimeSeriesView(**place(site, "ratio", name="ratio, and if spread evenly")) for site in sites],
        *[rrb.TimeSeriesView(**place(site, "masses", name="attention on groups")) for site in sites],
        *[rrb.TimeSeriesView(**place(site, "attention", name="words: times even attention")) for site in spelled],
    ]
    if kinds:
        of_words = ["/effects/word/**", "/effects/noise/**"] if "word" in kinds else "$origin/**"
        name = "how far the action moves without a word" if "word" in kinds else "how far the action moves"
        plots.append(rrb.TimeSeriesView(origin="/effects", contents=of_words, name=name))
    if about["courses"] or about["actions"]:
        plots.append(rrb.TimeSeriesView(origin="/actions", name="actions"))
    whole = rrb.Horizontal(
        rrb.Vertical(*left, row_shares=[3, 4, 2][-len(left) :]), rrb.Vertical(*plots), column_shares=[3, 2]
    )
    return rrb.Blueprint(
        whole, *[panel(state="collapsed") for panel in (rrb.BlueprintPanel, rrb.SelectionPanel, rrb.TimePanel)]
    )


def _path(rr: Any, parts: Sequence[str]) -> str:
    return "/".join(rr.escape_entity_path_part(part) for part in parts)
