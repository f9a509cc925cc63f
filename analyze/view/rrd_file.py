"""An episode as a Rerun recording (`.rrd`): pictures, words, numbers, poses and events on two time lines.

`step` counts the environment's: a replan stands at the number of steps before it, a pose at the step that led to it.
`call` counts the policy's: what stands at a step stands at the call that was executed then. Numbers are means over
layers, denoise steps and heads, the same as on the page. Entities:

    /                          the classes: a number, name and colour for every object
    about                      what happened, and what the numbers are
    pictures/CAMERA            what the policy got, as a person sees the scene; below it the lines around the patches
                               that get so many times even attention, pictures/CAMERA/2 times even, and the outlines of
                               objects that the sentence names or that were touched, pictures/CAMERA/objects/NAME; where
                               there are maps of what moves the action, lines around the patches that are first in them,
                               pictures/CAMERA/moves the action/2 times the mean, and the patches that were taken away
                               exactly, each with what that does, pictures/CAMERA/moves the action/exact
    words                      the instruction with attention and effect of every word, as a table
    ratio, masses, attention   by replan: the ratio and what even attention gives; mass of groups; times even of words
    heads/most                 by replan: which head looks most at the named object, or at what is first on the page
    effects                    by replan: how the action changes without an item, in its units
    scene                      by step: hand and objects in 3D, in metres
    actions                    by step: what was executed, a number a dimension; else the actions that were returned
    events                     touches, reached goals, closings of the gripper, the end

Where a run has several sites, SITE stands before pictures, words, ratio, masses, attention and heads.
"""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

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
from vla_attention.analyze.core.map_pictures import HOW, EpisodeMoves, episode_moves, shown_lift
from vla_attention.analyze.core.patch_maps import map_of
from vla_attention.analyze.render.files import replacing, writing
from vla_attention.analyze.render.pictures import borders
from vla_attention.analyze.render.style import group_styles
from vla_attention.analyze.view.episode_answers import MEAN, ShownEpisode
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.episode_steps import EXECUTED, HAND, POSES
from vla_attention.schemas.errors import BadArgument, MissingDependency, plural
from vla_attention.schemas.install_line import install_line
from vla_attention.schemas.progress_bar import progress_bar
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import STORE_SUFFIX

if TYPE_CHECKING:
    import rerun

SUFFIX = ".rrd"
STEP, CALL = "step", "call"
_MARKDOWN = "text/markdown"
#: The oldest release that has every call below; LeRobot 0.4 takes it, too.
OLDEST = (0, 24)
#: Colours of the lines, the first around the larger part; half their width in pixels of the screen, which Rerun has as
#: negative numbers.
_LINES = ((0x00, 0xB5, 0xCC), (0xE0, 0x40, 0xA0))
_WIDE = 1.2
#: Of lines and marks of what moves the action; the second lines are wider.
_MOVES = (0x00, 0x72, 0xB2)
#: By object what Rerun knows of it: its number, label and colour.
Classes: TypeAlias = dict[str, tuple[int, str, tuple[int, int, int]]]
#: Colours of objects, on the page too: named in the sentence, touched, others.
_NAMED, _TOUCHED, _OTHER = (0x00, 0xC0, 0x8B), (0xFF, 0x6A, 0x1F), (0x99, 0x99, 0x99)
#: Curves that others are held against, and their colour, which light and dark viewers show.
_BASELINES, _BASELINE_COLOR = ("spread evenly", "another noise seed"), "#8F8F8F"
_ABOUT_MOVES = (
    " *Blue lines*: what moves the action ({}), so many times the mean patch of the call. *Blue points*: patches that "
    "were taken away exactly, where not all were; point at one."
)
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
    install = install_line("rerun")
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
        call: at which it stands; None: at those that were executed from its steps on.
    """

    place: tuple[str, ...]
    kind: str
    values: Mapping[str, Any]
    steps: int | Sequence[int] | None = None
    call: int | None = None

    def times(self, starts: Sequence[int]) -> dict[str, Any]:
        """Where it stands on each time line, as its steps are given; starts: the step of every call."""
        if self.steps is None:
            return {}
        executed = np.searchsorted(starts, self.steps, "right") - 1
        return {STEP: self.steps, CALL: executed.tolist() if self.call is None else self.call}


def logged(
    shown: ShownEpisode, about: Mapping[str, Any], effects: Sequence[Mapping[str, Any]], units: ActionUnits | None
) -> Iterator[Logged]:
    """Everything that a recording of an episode holds but for its arrangement.

    about: of `ShownEpisode`; effects: of `shown_effects`, in `units`, none where none was measured.
    """
    starts, classes = about["starts"], _classes(shown)
    if classes:
        yield Logged((), "AnnotationContext", {"context": list(classes.values())})
    yield Logged(("about",), "TextDocument", {"text": _about(shown, about, units), "media_type": _MARKDOWN})
    sites = [site.name for site in shown.store.attributes.sites]
    for site in sites:
        before = (site,) if len(sites) > 1 else ()
        cameras = seen_cameras(shown.item(site))
        maps = episode_maps(shown.question(site), shown.item(site), cameras)
        yield from _pictures(before, shown, maps, classes, starts)
        moves = None if units is None else episode_moves(shown.item(site), cameras, units)
        if moves is not None and units is not None:
            yield from _moves(before, moves, units, starts)
        yield from _words(before, maps, effects, starts)
        yield from _groups(before, shown.groups(site, MEAN, MEAN), starts)
        for target in about["sites"][site]["targets"][:1]:
            yield from _heads(before, target["name"], shown.grid(site, target["selector"]), starts)
    for kind in _kinds(effects):
        curves = {item["label"]: item["effect"] for item in effects if _kind(item) == kind}
        yield from _series(("effects", kind), starts, curves)
    yield from _scene(shown, classes, starts)
    yield from _actions(shown, about)
    for event in about["events"]:
        yield Logged(("events",), "TextLog", {"text": event["text"]}, event["step"], event["replan"])


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
        _log(rr, stream, one, about["starts"])
    path.write_bytes(memory.drain_as_bytes())
    stream.disconnect()


def _log(rr: Any, stream: rerun.RecordingStream, one: Logged, starts: Sequence[int]) -> None:
    place, kind = _path(rr, one.place), getattr(rr, one.kind)
    times = one.times(starts)
    if isinstance(one.steps, Sequence):
        columns = [rr.TimeColumn(name, sequence=list(numbers)) for name, numbers in times.items()]
        stream.send_columns(place, columns, kind.columns(**one.values))
        return
    for name, number in times.items():
        stream.set_time(name, sequence=number)
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
        + (" *Outlines*: green, what the sentence names; orange, what was touched." if about["objects"] else "")
        + (
            ""
            if (one := map_of(shown.item(shown.store.attributes.sites[0].name))) is None
            else _ABOUT_MOVES.format(HOW[one.way])
        )
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


def _classes(shown: ShownEpisode) -> Classes:
    """Every object's class."""
    attributes = shown.episode.attributes
    touched = () if attributes.steps is None else attributes.steps.touched
    found = {}
    for number, name in enumerate(thing.name for thing in attributes.objects):
        named = " (named)", _NAMED
        what, color = named if name in shown.named else (" (touched)", _TOUCHED) if name in touched else ("", _OTHER)
        found[name] = number, _spelled(name) + what, color
    return found


def _spelled(name: str) -> str:
    return visible(name.replace("_", " "))


def _pictures(
    before: tuple[str, ...], shown: ShownEpisode, maps: EpisodeMaps, classes: Classes, starts: Sequence[int]
) -> Iterator[Logged]:
    """What the policy got, with lines around the patches that get much more than even attention, and around objects."""
    lifts = [one.lift.ravel() for one in maps.cameras.values()]
    levels = line_levels(scale_end(np.concatenate(lifts))) if lifts else []
    for camera, one in maps.cameras.items():
        place, grid = (*before, "pictures", camera), one.picture.grids[0]
        sides = float(grid.image_width), float(grid.image_height)
        covered = shown.covered(maps.item.tokens.layout.name).get(camera, {})
        outlined = [name for name in covered if classes[name][2] != _OTHER]
        for replan, step in enumerate(starts):
            if maps.has_frames(camera):
                png = {"contents": shown.picture(camera, replan), "media_type": "image/png"}
                yield Logged(place, "EncodedImage", png, step)
            lift = upright(one.lift[replan], one.view)
            for number, (level, color) in enumerate(zip(levels, _LINES, strict=False)):
                around = borders(lift >= level, 0.1 * number, (0.0, 0.0), sides)
                lines = {"strips": [(one[:2], one[2:]) for one in around], "colors": [color], "radii": -_WIDE}
                yield Logged((*place, f"{level:g} times even"), "LineStrips2D", lines, step)
            for name in outlined:
                inside = np.isin(np.arange(lift.size), covered[name][replan]).reshape(lift.shape)
                strips = [(one[:2], one[2:]) for one in borders(inside, 0.2, (0.0, 0.0), sides)]
                # Rerun would write the name at each strip.
                lines = {"strips": strips, "class_ids": [classes[name][0]], "radii": -_WIDE, "show_labels": False}
                yield Logged((*place, "objects", _spelled(name)), "LineStrips2D", lines, step)


def _moves(before: tuple[str, ...], moves: EpisodeMoves, units: ActionUnits, starts: Sequence[int]) -> Iterator[Logged]:
    """Lines around the patches that are first in the maps of what moves the action, and exact patches; else nothing."""
    levels = line_levels(scale_end(moves.lifts))
    for camera, one in moves.cameras.items():
        place, grid = (*before, "pictures", camera, "moves the action"), one.picture.grids[0]
        sides = float(grid.image_width), float(grid.image_height)
        for replan, step in enumerate(starts):
            at = moves.row(replan)
            for number, level in enumerate(levels, 1):
                around = [] if at is None else borders(shown_lift(one, at) >= level, 0.1, (0.0, 0.0), sides)
                strips = [(one[:2], one[2:]) for one in around]
                lines = {"strips": strips, "colors": [_MOVES], "radii": -_WIDE * number}
                yield Logged((*place, f"{level:g} times the mean"), "LineStrips2D", lines, step)
            marks = one.marks(at) if at is not None and moves.marked else []
            yield Logged(
                (*place, "exact"),
                "Points2D",
                {
                    "positions": [(x * sides[0], y * sides[1]) for x, y, _ in marks],
                    "labels": [f"without it {units.size(size)}" for *_, size in marks],
                    "colors": [_MOVES],
                    "radii": -2 * _WIDE,
                    "show_labels": False,
                },
                step,
            )


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


def _heads(before: tuple[str, ...], target: str, grid: Mapping[str, Any], starts: Sequence[int]) -> Iterator[Logged]:
    """The head that looks most at a target, as the page marks it in its grid; none where the target is out of sight."""
    most: list[float | None] = []
    for lifts, step in zip(grid["lift"], starts, strict=True):
        heads = zip(product(grid["layers"], grid["heads"]), chain.from_iterable(lifts), strict=True)
        known = [(lift, *head) for head, lift in heads if lift is not None]
        lift, layer, head = max(known, key=lambda one: one[0], default=(None, None, None))
        said = f"layer {layer}, head {head}: {lift:.3g} times even on" if known else "out of sight:"
        yield Logged((*before, "heads", "most"), "TextLog", {"text": f"{said} {target}"}, step)
        most.append(lift)
    yield from _series((*before, "heads"), starts, {"most": most})


def _scene(shown: ShownEpisode, classes: Classes, starts: Sequence[int]) -> Iterator[Logged]:
    """Hand and objects where they were at every step; the hand with the axes of its own frame and its way."""
    steps = shown.episode.attributes.steps
    if steps is None:
        return
    poses = shown.episode.read(POSES).astype(np.float64)  # (moment, body, position and w, x, y, z)
    # Of all rows of a call Rerun shows the one that was logged last: here the pose that the call saw.
    between = [moment for moment in range(len(poses)) if moment not in starts]
    for i, body in enumerate(steps.bodies):
        name = _spelled(body)
        turned = np.roll(poses[:, i, 3:], -1, axis=1)  # Rerun has w last
        moved = {"translation": poses[:, i, :3], "quaternion": turned}
        for moments in filter(None, (between, starts)):
            values = {what: numbers[moments] for what, numbers in moved.items()}
            yield Logged(("scene", name), "Transform3D", values, moments)
        if body == HAND:
            axes = {"vectors": np.eye(3) * _AXES, "colors": _AXIS_COLORS, "radii": _AXES / 16}
            yield Logged(("scene", name, "axes"), "Arrows3D", axes)
            way = {"strips": [poses[:, i, :3]], "colors": [(0x88, 0x88, 0x88)], "radii": _AXES / 40}
            yield Logged(("scene", "way of the hand"), "LineStrips3D", way)
        else:
            number, label, _ = classes[body]
            mark = {"half_sizes": [_MARK] * 3, "class_ids": [number], "labels": [label]}
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
    heads = [
        *[rrb.TextLogView(**place(site, "heads", name="which head looks most")) for site in sites],
        *[rrb.TimeSeriesView(**place(site, "heads", name="its times even")) for site in sites],
    ]
    logs = rrb.Horizontal(rrb.TextLogView(origin="/events", name="events"), rrb.Tabs(*heads))
    left += [rrb.Horizontal(rrb.Vertical(*texts), *scene), logs]
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
    return "/" + "/".join(rr.escape_entity_path_part(part) for part in parts)
