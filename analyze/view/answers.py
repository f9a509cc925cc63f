"""The answers that the page asks for, by their addresses; the server sends them, a site has them as files.

runs.json                                   every run with its episodes
runs/0/numbers.json                         of a run: what is computed meanwhile (`summaries`)
runs/0/heads.json?site=&layer=&selector=&first=     how much every head of a layer looks at something, of some episodes
runs/0/EPISODE/about.json                   what happened, and what every key is
runs/0/EPISODE/effects.json                 how the action changes without a word, an object, a picture
runs/0/EPISODE/actions/NUMBER.npy           the actions of the calls of one effect
runs/0/EPISODE/pictures/CAMERA/REPLAN.png   film.gif: all of them, with the attention on them;
                                            ?site=&layer=&head=&denoise= as they are shown
runs/0/EPISODE/SITE/objects.json            which cells of the pictures objects cover
runs/0/EPISODE/SITE/rows/LAYER.npy          rows of a layer, or of the mean of all; heads/LAYER.npy: of every head
runs/0/EPISODE/SITE/call/LAYER/REPLAN.json  what every head of a layer looks at in one call
runs/0/EPISODE/SITE/uniform/LAYER.npy       what uniform attention gives in their place
runs/0/EPISODE/SITE/groups/DENOISE/HEAD.json    ratio and masses of the grouping `default`; `mean`: of all
runs/0/EPISODE/SITE/grid/NUMBER.json        mass and lift in every head of one of the site's `targets`
runs/0/EPISODE/SITE/grid.json?selector=     the same of a selector; keys.json?selector= has its keys
"""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

from vla_attention.analyze.core.action_changes import ActionUnits, units_of
from vla_attention.analyze.core.camera_maps import seen_cameras
from vla_attention.analyze.core.map_pictures import has_map
from vla_attention.analyze.view.episode_answers import MEAN, ShownEpisode, npy
from vla_attention.analyze.view.head_answers import heads_of_run
from vla_attention.analyze.view.paths import RUNS, NothingThere
from vla_attention.analyze.view.run_answers import KnownLines, runs_answer
from vla_attention.analyze.view.served_stores import ServedStore
from vla_attention.schemas.errors import BadArgument, UserError, unknown_name
from vla_attention.schemas.stores.reader import Store, StoredEpisode

JSON, PNG, NPY = "application/json", "image/png", "application/octet-stream"
#: Content and its type.
Content: TypeAlias = tuple[bytes, str]
#: Episodes that stay open: what was read of one is used again for its other answers.
_OPEN = 8


class StoreGone(UserError):
    """A store that the page shows is not there any more."""


class Answers:
    """The answers about some stores; asked by several threads at once."""

    def __init__(self) -> None:
        self._lock, self._drawing = threading.Lock(), threading.Lock()
        self._open: OrderedDict[tuple[str, str], tuple[StoredEpisode, ShownEpisode]] = OrderedDict()
        self._units: dict[str, tuple[Store, ActionUnits]] = {}
        self._lines: KnownLines = {}

    def answer(
        self, stores: Sequence[ServedStore], names: Sequence[str], query: Mapping[str, Sequence[str]]
    ) -> Content:
        """The answer at an address; names: its parts.

        Raises:
            NothingThere: nothing has this address.
            StoreGone: the store was moved or deleted.
            UserError: what it names does not exist, or cannot be read.
        """
        if list(names) == [RUNS]:
            return _json(runs_answer([one.store for one in stores], self._lines, with_paths=True))
        try:
            _, number, episode, *rest = names
            served = stores[int(number)]
        except (ValueError, IndexError):
            raise NothingThere from None
        _check_there(served.store)
        if [episode, *rest] == ["numbers.json"]:
            return _json(served.summary.document())
        if [episode, *rest] == ["heads.json"]:
            return _json(_heads_of_run(served.store, query))
        shown = self._shown(served.store, episode)
        match rest:
            case ["about.json"]:
                return _json(shown.about())
            case ["effects.json"]:
                return _json(shown.effects(self._units_of(served.store)))
            case ["actions", file]:
                return npy(shown.changed_actions(_number(file, ".npy"))), NPY
            case ["film.gif"]:
                layer, head, denoise = (query.get(name, [MEAN])[0] for name in ("layer", "head", "denoise"))
                if not all(one == MEAN or (one.isdecimal() and len(one) < 9) for one in (layer, head, denoise)):
                    raise NothingThere
                with self._drawing:
                    return shown.film(query.get("site", [None])[0], layer, head, denoise), "image/gif"
            case ["pictures", camera, file]:
                return shown.picture(camera, _number(file, ".png")), PNG
            case [site, "moves.json"] if site in [known.name for known in shown.store.attributes.sites]:
                return _json(shown.moves(site, self._units_of(served.store)))
            case [site, *of_site] if site in [known.name for known in shown.store.attributes.sites]:
                return _of_site(shown, site, of_site, query)
        raise NothingThere

    def copied(self, served: ServedStore, name: str, heads: bool) -> Iterator[tuple[str, bytes]]:
        """All that a copy of the page has of an episode: addresses below it, and what `answer` says there.

        An error is its sentence, as the server sends it. heads: with the rows of every head, which is most of it.
        """
        shown = self._shown(served.store, name)
        for site in shown.store.attributes.sites:
            with suppress(UserError):  # each answer says what is wrong with it
                shown.read_ahead(site.name, heads)
        try:
            for address in _addresses(shown, heads):
                try:
                    content, _ = self.answer([served], ("runs", "0", name, *address.split("/")), {})
                except UserError as error:
                    content, _ = error_answer(error)
                yield address, content
        finally:
            shown.let_go()

    def _shown(self, store: Store, name: str) -> ShownEpisode:
        """An episode that stays open for its other answers, unless it was recorded again."""
        key, episode = (str(store.path), name), next((one for one in store.episodes if one.name == name), None)
        if episode is None:
            raise NothingThere
        with self._lock:
            if key not in self._open or self._open[key][0] is not episode:
                self._open[key] = episode, ShownEpisode(store, episode)
                while len(self._open) > _OPEN:
                    self._open.popitem(last=False)
            self._open.move_to_end(key)
            return self._open[key][1]

    def _units_of(self, store: Store) -> ActionUnits:
        """The units of effects, of the whole store as it is now."""
        key = str(store.path)
        if key not in self._units or self._units[key][0] is not store:
            self._units[key] = store, units_of([store], skip_corrupt=True)
        return self._units[key][1]


def _addresses(shown: ShownEpisode, heads: bool) -> Iterator[str]:
    root, episode = shown.store.attributes, shown.episode
    yield "about.json"
    try:
        cameras = dict.fromkeys(camera for site in root.sites for camera in seen_cameras(shown.item(site.name)))
    except UserError:  # about.json says it
        return
    for camera in cameras:
        for replan in range(episode.attributes.num_replans) if episode.has(f"frames/{camera}") else ():
            yield f"pictures/{camera}/{replan}.png"
    if episode.attributes.effects is not None:
        yield "effects.json"
        yield from (f"actions/{number}.npy" for number in shown.drawn_effects)
    for site in root.sites:
        axes = root.recording_of(site.name)
        for layer in (*axes.layer_labels, MEAN):
            yield from (
                f"{site.name}/{kind}/{layer}.npy" for kind in ("rows", "uniform", *(["heads"] if heads else []))
            )
        yield f"{site.name}/objects.json"
        if has_map(shown.item(site.name)):
            yield f"{site.name}/moves.json"
        yield from (f"{site.name}/grid/{number}.json" for number in range(len(shown.targets(site.name))))
        for step, head in product((MEAN, *axes.denoise_steps), (MEAN, *(axes.heads if heads else ()))):
            yield f"{site.name}/groups/{step}/{head}.json"


def _of_site(shown: ShownEpisode, site: str, names: Sequence[str], query: Mapping[str, Sequence[str]]) -> Content:
    match names:
        case ["objects.json"]:
            return _json(shown.covered(site))
        case ["rows" | "heads" as kind, file] if file.endswith(".npy"):
            return npy(shown.rows(site, file.removesuffix(".npy"), heads=kind == "heads")), NPY
        case ["call", layer, file]:
            return _json(shown.call(site, layer, _number(file, ".json")))
        case ["uniform", file] if file.endswith(".npy"):
            return npy(shown.uniform(site, file.removesuffix(".npy"))), NPY
        case ["groups", denoise, file] if file.endswith(".json"):
            return _json(shown.groups(site, denoise, file.removesuffix(".json")))
        case ["grid", file]:
            targets, number = shown.targets(site), _number(file, ".json")
            if number < len(targets):
                return _json(shown.grid(site, targets[number]["selector"]))
        case ["grid.json"]:
            return _json(shown.grid(site, _selector(query)))
        case ["keys.json"]:
            return _json(shown.keys(site, _selector(query)))
    raise NothingThere


def _heads_of_run(store: Store, query: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    if sorted(query) != ["first", "layer", "selector", "site"] or any(len(values) != 1 for values in query.values()):
        raise BadArgument("Expected ?site=SITE&layer=NUMBER&selector=SELECTOR&first=EPISODE here.")
    given = {name: values[0] for name, values in query.items()}
    if given["site"] not in [site.name for site in store.attributes.sites]:
        raise unknown_name("site", given["site"], [site.name for site in store.attributes.sites])
    layer, first = (_whole(given[name]) for name in ("layer", "first"))
    return heads_of_run(store, given["site"], layer, given["selector"], first)


def error_answer(sentence: object) -> Content:
    """What is said where there is no answer."""
    return _json({"error": str(sentence)})


def _json(document: Any) -> Content:
    return json.dumps(document, allow_nan=False).encode(), JSON


def _number(file: str, ending: str) -> int:
    if not file.endswith(ending):
        raise NothingThere
    return _whole(file.removesuffix(ending))


def _whole(text: str) -> int:
    if not text.isdecimal() or len(text) > 9:
        raise NothingThere
    return int(text)


def _check_there(store: Store) -> None:
    if isinstance(store.path, Path) and not store.path.exists():
        raise StoreGone(
            f"{store.path} is not there any more: it was moved or deleted. Put it back, or open another store."
        )


def _selector(query: Mapping[str, Sequence[str]]) -> str:
    if list(query) != ["selector"] or len(query["selector"]) != 1:
        raise BadArgument(f"Cannot use {', '.join(query) or 'no question'} here; expected ?selector=SELECTOR.")
    return query["selector"][0]
