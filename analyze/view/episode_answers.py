"""What the page is told of one episode, by the functions that the commands use: the page itself computes sums alone.

Arrays are sent as `.npy` files, which state their shape: little-endian float32, axes in the order of stores.
"""

from __future__ import annotations

import io
import math
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.ask import answer_to
from vla_attention.analyze.core.action_changes import EFFECT, GRIPPER, ActionUnits
from vla_attention.analyze.core.camera_maps import (
    PictureMap,
    line_levels,
    map_note,
    scale_end,
    seen_cameras,
    shared_out,
    stored_picture,
    upright,
    view_of,
)
from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.core.map_pictures import HOW, episode_moves, has_map, shown_lift
from vla_attention.analyze.core.measure import Measured, look_at, means
from vla_attention.analyze.core.naming import told_things
from vla_attention.analyze.core.recorded_effects import NAMES, recorded_effects, selected_items
from vla_attention.analyze.measures.masses import mean_of_layers, uniform_keys
from vla_attention.analyze.measures.question import Question, ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.scan import Look, scan
from vla_attention.analyze.measures.selected import SelectedEpisode, check_replan, resolve_episode
from vla_attention.analyze.measures.tables import LAYERS_AVG
from vla_attention.analyze.render.style import group_styles
from vla_attention.analyze.stores.rows import LayerRows, layer_rows
from vla_attention.analyze.stores.selection import Selection, select
from vla_attention.analyze.view.run_answers import episode_line
from vla_attention.schemas.cached_property import cached_property
from vla_attention.schemas.effects import CHANGE
from vla_attention.schemas.episode_steps import EXECUTED, HAND, POSES
from vla_attention.schemas.episode_steps import GRIPPER as FINGERS
from vla_attention.schemas.errors import BadArgument, unknown_name
from vla_attention.schemas.groupings.resolve import check_names
from vla_attention.schemas.groupings.selectors import quoted
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import CorruptEpisode

Array = NDArray[Any]
#: An object is where it covers at least this part of a patch.
_COVERED = 0.1
#: A gripper that closes for fewer steps did not mean to.
_FEWEST_CLOSED = 3
#: The layer that stands for the mean of all.
MEAN = "mean"


#: What fills a word with colour: centimetres by which the hand ends elsewhere, degrees by which it is turned, the part
#: of the steps in which the gripper's command flips.
_FULL = {EFFECT: 5.0, "turn": 45.0, "gripper": 0.5}
#: What names of groups cannot have.
_IN_NAMES = re.compile(r"[^A-Za-z0-9_]+")


@dataclass(frozen=True)
class ShownEpisode:
    """An episode of a store, opened for the page."""

    store: Store
    episode: StoredEpisode
    #: The questions about the episode that were asked last.
    _questions: dict[AnalysisSettings, Question] = field(default_factory=dict)
    #: By site the rows of the mean of all layers, for which every layer is read.
    _mean_rows: dict[str, Array] = field(default_factory=dict)
    #: By site the rows of every layer, where all of them were read ahead; and by selector what heads look at.
    _read: dict[str, dict[tuple[int, int], Array]] = field(default_factory=dict)
    _grids: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)
    #: By site what `covered` gave: heads and pictures ask for it, too.
    _covered: dict[str, dict[str, Any]] = field(default_factory=dict)

    def question(self, site: str, **settings: Any) -> Question:
        """A question about this episode alone, as the commands ask it."""
        asked = AnalysisSettings(site=site, **settings)
        if asked not in self._questions:
            if len(self._questions) > 50:
                self._questions.clear()
            self._questions[asked] = ask([replace(self.store, episodes=(self.episode,))], asked)
        return self._questions[asked]

    def item(self, site: str) -> SelectedEpisode:
        """The episode with the tokens of a site."""
        return self.question(site).selected[0]

    @cached_property
    def named(self) -> set[str]:
        """The objects that the policy was told about, see `told_things`; none where nobody knows which."""
        return told_things(self.item(self._site_names[0])) or set()

    def about(self) -> dict[str, Any]:
        """`about.json`: what happened, and what every key is."""
        item = self.item(self.store.attributes.sites[0].name)
        attributes = self.episode.attributes
        env_step = self.episode.read("env_step").astype(np.int64)
        starts, end = item.timing(env_step)
        line = episode_line(self.store, self.episode)
        return line | {
            "env_step": env_step.tolist(),
            "starts": starts.tolist(),
            "end": end,
            "prompt_index": self.episode.read("prompt_index").tolist(),
            "objects": [
                {"name": thing.name, "shown": visible(thing.name.replace("_", " ")), "named": thing.name in self.named}
                for thing in attributes.objects
                if thing.kind == "object"
            ],
            "events": self._events(starts, end, line["outcome"]),
            "courses": self._courses(),
            "actions": _numbers(self.episode.read("actions")) if self.episode.has("actions") else None,
            "effects": attributes.effects is not None,
            "sites": {site.name: self._site(site.name) for site in self.store.attributes.sites},
        }

    def _events(self, starts: NDArray[np.int64], end: int, outcome: bool | None) -> list[dict[str, Any]]:
        """Touches, reached goals and closings of the gripper, in the order of their steps; then the end."""
        attributes = self.episode.attributes
        found: list[tuple[int, str, str, str]] = []
        if (steps := attributes.steps) is not None:
            for body, at in zip(steps.bodies, steps.first_touch, strict=True):
                if at is not None:
                    found.append((at, "touch", f"touches {body.replace('_', ' ')}", body))
            found += [
                (goal.first_held, "goal", f"fulfils '{goal.instruction}'", "")
                for goal in steps.goals
                if goal.first_held
            ]
            executed = self.episode.read(EXECUTED)
            found += [(at, "gripper", "gripper closes", "") for at in _closings(executed[:, GRIPPER])]
        ends = {True: "solved", False: "not solved", None: "end"}[outcome]
        found = [*sorted(found), (end, "end", ends, "")]
        replans = np.searchsorted(starts, [max(at - 1, 0) for at, *_ in found], side="right") - 1
        return [
            {"step": at, "replan": int(replan), "kind": kind, "text": visible(text), "thing": thing}
            for (at, kind, text, thing), replan in zip(found, replans, strict=True)
        ]

    def _courses(self) -> dict[str, Any] | None:
        """By step: where the hand and the objects are in metres, the way between the fingers, the executed actions."""
        steps = self.episode.attributes.steps
        if steps is None:
            return None
        poses = self.episode.read(POSES)[..., :3]
        fingers = self.episode.read(FINGERS)
        return {
            "places": {visible(name): _numbers(poses[:, i]) for i, name in enumerate(steps.bodies)},
            "hand": HAND,
            "gap": _numbers(np.abs(fingers).sum(axis=1)),
            "executed": _numbers(self.episode.read(EXECUTED)),
        }

    def _site(self, site: str) -> dict[str, Any]:
        item = self.item(site)
        tokens = item.tokens
        return {
            "cameras": {camera: _camera(item, camera) for camera in seen_cameras(item)},
            "targets": self.targets(site),
            "moves": has_map(item),
            "prompts": [
                {
                    "text": visible(prompt.text),
                    "words": [{"text": visible(word.text), "keys": list(word.keys)} for word in words],
                }
                for prompt, words in zip(tokens.prompts, tokens.words, strict=True)
            ],
        }

    def picture(self, camera: str, replan: int) -> bytes:
        """A stored picture as a person sees the scene, as PNG."""
        from PIL import Image

        item = next((item for item in map(self.item, self._site_names) if camera in item.tokens.layout.cameras), None)
        if item is None:
            raise unknown_name("camera", camera, [view.name for view in self.store.attributes.policy.cameras])
        picture = stored_picture(item, camera, check_replan(item, replan))
        if picture is None:
            raise BadArgument(f"No pictures of {camera} were stored.")
        file = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(picture)).save(file, "PNG", compress_level=1)
        return file.getvalue()

    def film(self, site: str | None, layer: str, head: str, denoise: str) -> bytes:
        """The pictures with the attention on them as a GIF, as `vla-attention overlay --video gif` makes it.

        site: None is the first one. layer, head, denoise: a number, or `MEAN`. Lines go around the objects that the
        policy was told about.
        """
        only, number = replace(self.store, episodes=(self.episode,)), self.episode.attributes.episode_index
        layers, heads = ((int(one),) if one != MEAN else None for one in (layer, head))
        steps = None if denoise == MEAN else (denoise,)
        settings = AnalysisSettings(layers=layers, heads=heads, denoise=steps, site=site)
        seen = [thing.name for thing in self.item(self._site_names[0]).tokens.objects if thing.name in self.named]
        outlines = [f"{_IN_NAMES.sub('_', name)}=object:{quoted(name)}" for name in seen]
        options = {"episode": number, "video": "gif", "outline": outlines}
        result = answer_to("overlay", [only], settings, options)
        ((name, write),) = result.files.items()
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder) / name)
            return (Path(folder) / name).read_bytes()

    @property
    def _site_names(self) -> list[str]:
        return [site.name for site in self.store.attributes.sites]

    def covered(self, site: str) -> dict[str, Any]:
        """`objects.json`: camera -> object -> at each replan the cells of the map that it covers."""
        if site in self._covered:
            return self._covered[site]
        item = self.item(site)
        found = {}
        for camera, coverage in (item.tokens.coverage or {}).items():
            picture, view = PictureMap.of(item.tokens.layout, camera), view_of(item, camera)
            cells = picture.highest(np.moveaxis(coverage, -1, 1))  # (replan, object, row, column)
            shown = {
                thing.name: [np.flatnonzero(upright(cell, view) >= _COVERED).tolist() for cell in cells[:, i]]
                for i, thing in enumerate(item.tokens.objects)
                if thing.kind == "object"
            }
            found[camera] = {name: of_replans for name, of_replans in shown.items() if any(of_replans)}
        self._covered[site] = found
        return found

    def moves(self, site: str, units: ActionUnits) -> dict[str, Any] | None:
        """`moves.json`: which patches move the action, at the calls that have a map; None without any.

        lift: by camera (map row, cell), times the mean patch of the call. exact: by camera and map row the patches that
        were taken away exactly: where their centres are, in parts of the picture, in which cell, and what that does in
        words, in `units` of the whole store. how: what the map is. marked: whether these patches are marked.
        """
        found = episode_moves(self.item(site), seen_cameras(self.item(site)), units)
        if found is None:
            return None
        cameras = {}
        for camera, one in found.cameras.items():
            (rows, columns), places = one.lift.shape[1:], range(len(found.replan))
            cameras[camera] = {
                "lift": _numbers(np.array([shown_lift(one, at).ravel() for at in places])),
                "exact": [
                    [
                        {"x": x, "y": y, "cell": int(y * rows) * columns + int(x * columns), "said": units.size(size)}
                        for x, y, size in one.marks(at)
                    ]
                    for at in places
                ],
            }
        return {
            "replans": list(found.replan),
            "levels": line_levels(scale_end(found.lifts)),
            "how": HOW[found.way],
            "marked": found.marked,
            "cameras": cameras,
        }

    def rows(self, site: str, layer: str, heads: bool = False) -> Array:
        """Rows of a layer, or of the mean of all: (replan, denoise, key), mean over heads and queries.

        heads: each head's, (replan, denoise, head, key).
        """
        if layer == MEAN and not heads and site in self._mean_rows:
            return self._mean_rows[site]
        selection = replace(self._selection(site, layer), per_head=heads)
        parts: list[Array] = [np.zeros(())] * len(selection.denoise)
        for part in self._layer_rows(site, selection):
            if part.layer in selection.once:
                parts[part.denoise] = parts[part.denoise] + part.of_heads(heads).astype(np.float64)
        rows = np.stack(parts, axis=1) / len(selection.once)
        if heads:
            return rows
        if layer == MEAN:
            self._mean_rows[site] = rows[:, :, 0]
        return rows[:, :, 0]

    def _layer_rows(self, site: str, selection: Selection) -> Iterator[LayerRows]:
        if site not in self._read:
            yield from layer_rows(self.store.attributes, self.episode, selection, site)
            return
        for i, j in product(range(len(selection.layers)), range(len(selection.denoise))):
            rows = self._read[site][selection.layers[i], selection.denoise[j]]
            yield LayerRows(i, j, range(rows.shape[-1]), rows)

    def call(self, site: str, layer: str, replan: int) -> dict[str, Any]:
        """`call/LAYER/REPLAN.json`: what every head of a layer looks at in one call, and where the named objects are.

        lift: times even attention of the cells of a camera's map, (head, cell), mean over denoise steps; named: cells.
        """
        item, at = self.item(site), check_replan(self.item(site), replan)
        rows = self.rows(site, layer, heads=True)[at].mean(axis=0)  # (head, key)
        selection = replace(self._selection(site, layer), per_head=True)
        uniform = uniform_keys(item, selection)[:, 0].mean(axis=1)
        # Where they are the same at all replans, or in all heads, they are there once.
        valid, even = item.valid[min(at, len(item.valid) - 1)], uniform[min(at, len(uniform) - 1)]
        even = shared_out(rows, even, valid)
        cameras = {}
        for camera in seen_cameras(item):
            picture, view = PictureMap.of(item.tokens.layout, camera), view_of(item, camera)
            with np.errstate(divide="ignore", invalid="ignore"):
                lift = picture.spread(rows[:, picture.keys]) / picture.spread(even[:, picture.keys])
            shown = [upright(one, view).ravel() for one in lift]
            covered = self.covered(site).get(camera, {})
            cameras[camera] = {
                "rows": picture.rows,
                "columns": picture.columns,
                "stored": self.episode.has(f"frames/{camera}"),
                "lift": _numbers(np.array(shown)),
                "named": sorted({cell for name in self.named & covered.keys() for cell in covered[name][at]}),
            }
        return cameras

    def read_ahead(self, site: str, heads: bool) -> None:
        """Read all layers and what all heads look at, for who asks for all of it: each chunk is decoded once."""
        question = self.question(site)
        rows = Look("rows", _KeptRows, heads, lambda _position, kept: kept)
        (kept, grids) = scan(question, [rows, self._look_at_targets(site)])
        self._read[site] = kept[0]
        self._grids[site] = self._grid_of(site, grids[0])

    def let_go(self) -> None:
        """Forget the rows that were read ahead."""
        self._read.clear()

    def uniform(self, site: str, layer: str) -> Array:
        """What uniform attention gives in the place of `rows`, (replan or 1, denoise or 1, key)."""
        selection = self._selection(site, layer)
        return mean_of_layers(uniform_keys(self.item(site), selection)[:, :, :, 0], selection)

    def _selection(self, site: str, layer: str) -> Selection:
        root = self.store.attributes
        if layer == MEAN:
            return select(root, site=site)
        if not layer.isdecimal():
            raise BadArgument(f"There is no layer '{layer}'; expected its number, or {MEAN}.")
        return select(root, [int(layer)], site=site)

    def groups(self, site: str, denoise: str, head: str) -> dict[str, Any]:
        """`groups/DENOISE/HEAD.json`: the numbers of `vla-attention analyze`, by replan and layer.

        The last layer is the mean of all; so is that of denoise steps and heads.
        """
        if head != MEAN and not head.isdecimal():
            raise BadArgument(f"There is no head '{head}'; expected its number, or {MEAN}.")
        steps, heads = (None if one == MEAN else (one,) for one in (denoise, head))
        question = self.question(site, denoise=steps, heads=heads and (int(head),))
        levels = levels_of(question)
        replans = levels.replans().collect()
        groups = levels.groups("replan", "layer").collect()
        layers = [*map(str, question.selection.layer_labels), MEAN]
        columns = ("ratio", "uniform_ratio", "ratio_lift")
        ratio, styles = question.grouping.ratio, group_styles(question.grouping.names)
        return {
            "layers": layers,
            "sides": None if ratio is None else [list(ratio.numerator), list(ratio.denominator)],
            **{name: _by_layer(replans, name, layers) for name in columns if ratio is not None},
            "groups": {
                name: {"color": styles[name]["color"]}
                | {
                    column: _by_layer(groups.filter(group=name), column, layers)
                    for column in ("keys", "mass", "fraction", "lift")
                }
                for name in question.grouping.names
            },
        }

    def targets(self, site: str) -> list[dict[str, str]]:
        """What heads may look at: name and selector; named objects first, then pictures and words."""
        item = self.item(site)
        seen = {name for things in self.covered(site).values() for name in things}
        things = sorted(
            (one for one in item.tokens.objects if one.name in seen), key=lambda one: one.name not in self.named
        )
        found = [
            (visible(one.name.replace("_", " ")) + " (named)" * (one.name in self.named), f"object:{quoted(one.name)}")
            for one in things
        ]
        if seen_cameras(item):
            found.append(("all pictures", "role:image"))
        words = {word.text.casefold(): word.text for line in item.tokens.words for word in line}
        if words:
            found.append(("the instruction", "role:instruction"))
        found += [(f"'{visible(text)}'", f"word:{quoted(text)}") for text in words.values()]
        return [{"name": name, "selector": selector} for name, selector in found]

    def grid(self, site: str, selector: str) -> dict[str, Any]:
        """`grid.json`: mass and lift of a selector's keys in every head, (replan, layer, head)."""
        if selector in [target["selector"] for target in self.targets(site)]:
            with suppress(CorruptEpisode):  # it may be answered alone: from the masses of whole segments
                if site not in self._grids:
                    ((measured,),) = scan(self.question(site), [self._look_at_targets(site)])
                    self._grids[site] = self._grid_of(site, measured)
                return self._grids[site][selector]
        question = self.question(site, groups=(f"own={selector}",))
        (measured,) = levels_of(question, heads=True).measured
        return _grid(question, means(measured, ("replan", "layer", "head")).filter(group="own"))

    def _look_at_targets(self, site: str) -> Look[Measured]:
        selectors = tuple(target["selector"] for target in self.targets(site))
        return look_at(self.question(site), partial(selected_items, selectors=selectors, absent="zero"), ("head",))

    def _grid_of(self, site: str, measured: Measured) -> dict[str, dict[str, Any]]:
        frame, question = means(measured, ("replan", "layer", "head")), self.question(site)
        targets = [target["selector"] for target in self.targets(site)]
        # Items follow each other in every cell.
        of_items = (frame.gather_every(len(targets), i) for i in range(len(targets)))
        return {selector: _grid(question, rows) for selector, rows in zip(targets, of_items, strict=True)}

    def keys(self, site: str, selector: str) -> dict[str, Any]:
        """`keys.json`: the keys that a selector takes with their weights, once where they never change, by replan."""
        question = self.question(site, groups=(f"own={selector}",))
        check_names(question.grouping, question.vocabulary)
        weights = resolve_episode(question.grouping, question.selected[0]).weights[..., 0]
        if not weights.any():
            raise BadArgument(f"'{selector}' takes no key of this episode.")
        if (weights == weights[:1]).all():
            weights = weights[:1]
        return {"keys": [[[int(key), float(line[key])] for key in np.flatnonzero(line)] for line in weights]}

    def effects(self, units: ActionUnits) -> dict[str, Any] | None:
        """`effects.json`: the numbers of `vla-attention effects` for one episode, item by item; None without any.

        units: of the whole store. effect: (part, replan) in their parts, null where it was not measured; mean: (part)
        over these. full: what fills a word with colour; null: the largest one of the episode.
        """
        found = recorded_effects(self.question(self._site_names[0]), units=units)
        if found is None:
            return None
        rows, num_replans = found.rows().collect(), self.episode.attributes.num_replans
        stored = self.episode.attributes.effects
        assert stored is not None
        numbers = {visible(condition.name): i for i, condition in enumerate(stored.conditions)}
        items = []
        for mean in found.episodes().iter_rows(named=True):
            values = np.full((len(units.parts), num_replans), np.nan)
            of_item = rows.filter(condition=mean["condition"])
            values[:, of_item["replan"].to_numpy()] = of_item.select(units.names).to_numpy().T
            items.append(
                {name: mean[name] for name in (*NAMES, "noise", "lift")}
                | {"number": numbers[mean["condition"]], "mean": [mean[name] for name in units.names]}
                | {"effect": _numbers(values, exact=True)}
            )
        parts = [
            {"name": part.name, "title": part.title, "said": part.said, "share": part.how == "opposite"}
            | {"full": None if part.how == "mean" else _FULL[part.name]}
            for part in units.parts
        ]
        return {"parts": parts, "items": items, "notes": list(found.notes)}

    @property
    def drawn_effects(self) -> list[int]:
        """The conditions whose actions the page draws: the calls without an item, or with another."""
        effects = self.episode.attributes.effects
        items = effects.items if effects is not None and self.episode.has(CHANGE) else ()
        return [i for i, one in enumerate(items) if one.change in ("without", "prompt", "image")]

    def changed_actions(self, number: int) -> Array:
        """The actions of a condition's calls, (replan, step, dimension); NaN where it was not tried."""
        effects, actions = self.episode.attributes.effects, self.episode.read("actions").astype(np.float64)
        changed = np.full_like(actions, np.nan)
        if effects is None or not 0 <= number < len(effects.conditions) or not self.episode.has(CHANGE):
            raise BadArgument(f"There is no effect {number} in episode {self.episode.name}.")
        entries = np.array(effects.condition) == number
        replans = np.array(effects.replan)[entries]
        change = self.episode.read(CHANGE)[entries].astype(np.float64) * np.array(effects.units)
        changed[replans] = actions[replans] + change
        return changed


class _KeptRows:
    """The rows of an episode by layer and denoise step (positions), (replan, head or 1, key) each."""

    def __init__(self, item: SelectedEpisode, selection: Selection, _site: str, _given: None) -> None:
        self.keys: range | None = range(item.tokens.layout.num_keys)
        self.places = selection.layers, selection.denoise
        self.rows: dict[tuple[int, int], Array] = {}

    def add(self, part: LayerRows) -> None:
        """Keep the rows of a layer."""
        layers, steps = self.places
        self.rows[layers[part.layer], steps[part.denoise]] = part.rows.copy()

    def content(self) -> dict[tuple[int, int], Array]:
        """What was kept."""
        return self.rows


def _grid(question: Question, rows: pl.DataFrame) -> dict[str, Any]:
    """Of the rows of one item by replan, layer and head."""
    rows, selection = rows.filter(pl.col("layer") != LAYERS_AVG), question.selection
    shape = (-1, len(selection.layers), len(selection.heads))
    return {
        "layers": list(selection.layer_labels),
        "heads": list(selection.head_numbers),
        **{name: _numbers(rows[name].to_numpy().reshape(shape), exact=True) for name in ("mass", "lift")},
    }


def _camera(item: SelectedEpisode, camera: str) -> dict[str, Any]:
    """How a camera's keys lie on its picture, as a person sees it.

    keys, cells, shares: a part of the mass of a key, and the cell of the map that it is added to; cells are counted row
    by row from the top left corner.
    """
    picture, view = PictureMap.of(item.tokens.layout, camera), view_of(item, camera)
    maps = upright(np.moveaxis(picture.spread(np.eye(len(picture.keys))), 0, -1), view)  # (row, column, patch)
    maps = maps.reshape(-1, len(picture.keys))
    cells, patches = np.nonzero(maps)
    return {
        "rows": picture.rows,
        "columns": picture.columns,
        "height": picture.grids[0].image_height,
        "width": picture.grids[0].image_width,
        "keys": picture.keys[patches].tolist(),
        "cells": cells.tolist(),
        "shares": None if picture.cells_are_patches else maps[cells, patches].tolist(),
        "upright": view.upright,
        "mirrored": view.mirrored,
        "stored": item.episode.has(f"frames/{camera}"),
        "note": map_note(item.tokens.layout, camera, None),
    }


def _closings(commands: Array) -> list[int]:
    """The steps at whose end an open gripper was told to close, and stayed so."""
    closed = commands > 0
    return [
        at + 1
        for at in range(1, len(closed))
        if closed[at] and not closed[at - 1] and closed[at : at + _FEWEST_CLOSED].all()
    ]


def _by_layer(frame: pl.DataFrame, column: str, layers: Sequence[str]) -> Any:
    """A column of a table of replans and layers as (replan, layer), null where there is no number."""
    values = frame.select(pl.col(column).cast(pl.Float64)).to_series().to_numpy().reshape(-1, len(layers))
    return _numbers(values, exact=True)


def _numbers(values: Array, exact: bool = False) -> Any:
    """Numbers as nested lists; to five digits, which no picture shows, unless `exact`; null for what is not finite."""
    if values.ndim > 1:
        return [_numbers(part, exact) for part in values]
    return [(float(one) if exact else float(f"{one:.5g}")) if math.isfinite(one) else None for one in values.tolist()]


def npy(array: Array) -> bytes:
    """An array as a `.npy` file."""
    file = io.BytesIO()
    np.save(file, np.ascontiguousarray(array, dtype="<f4"), allow_pickle=False)
    return file.getvalue()
