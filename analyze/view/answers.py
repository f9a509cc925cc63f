"""The answers that the page asks for, by their addresses; the server sends them, a site has them as files.

runs.json                                   every run with its episodes
runs/0/EPISODE/about.json                   what happened, and what every key is
runs/0/EPISODE/effects.json                 how the action changes without a word, an object, a picture
runs/0/EPISODE/actions/NUMBER.npy           the actions of the calls of one effect
runs/0/EPISODE/pictures/CAMERA/REPLAN.png
runs/0/EPISODE/SITE/objects.json            which cells of the pictures objects cover
runs/0/EPISODE/SITE/rows/LAYER.npy          rows of a layer, or of the mean of all; heads/LAYER.npy: of every head
runs/0/EPISODE/SITE/uniform/LAYER.npy       what uniform attention gives in their place
runs/0/EPISODE/SITE/groups.json             ratio and masses; ?grouping= &group= &ratio= &layers= &heads= &denoise=
runs/0/EPISODE/SITE/heads.json?selector=    mass and lift in every head
runs/0/EPISODE/SITE/keys.json?selector=     the keys of a selector
"""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

from vla_attention.analyze.core.action_changes import ActionSpread, units_of_recorded
from vla_attention.analyze.measures.question_settings import settings_from_keywords
from vla_attention.analyze.view.episode_answers import ShownEpisode, npy
from vla_attention.analyze.view.run_answers import runs_answer
from vla_attention.analyze.view.served_stores import ServedStore
from vla_attention.schemas.errors import BadArgument, unknown_name
from vla_attention.schemas.groupings.builtin_groupings import BUILTIN_GROUPINGS
from vla_attention.schemas.stores.reader import Store

JSON, PNG, NPY = "application/json", "image/png", "application/octet-stream"
#: Content and its type.
Content: TypeAlias = tuple[bytes, str]
#: What a query may say of `groups.json`, with what each is in Python.
_SETTINGS = ("grouping", "group", "ratio", "layers", "heads", "denoise")
#: Episodes that stay open: what was read of one is used again for its other answers.
_OPEN = 8


class NoAnswer(LookupError):
    """An address that names no answer."""


class Answers:
    """The answers about some stores; asked by several threads at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: OrderedDict[tuple[str, str, str], ShownEpisode] = OrderedDict()
        self._units: dict[tuple[str, int], ActionSpread] = {}

    def answer(
        self, stores: Sequence[ServedStore], names: Sequence[str], query: Mapping[str, Sequence[str]]
    ) -> Content:
        """The answer at an address; names: its parts.

        Raises:
            NoAnswer: nothing has this address.
            UserError: what it names does not exist, or cannot be read.
        """
        if list(names) == ["runs.json"]:
            return _json(runs_answer([one.store for one in stores], with_paths=True))
        try:
            _, number, episode, *rest = names
            served = stores[int(number)]
            if episode == "numbers.json" and not rest:
                return _json(served.summary.document())
            shown = self._shown(served.store, episode)
        except (ValueError, IndexError):
            raise NoAnswer from None
        match rest:
            case ["about.json"]:
                return _json(shown.about())
            case ["effects.json"]:
                return _json(shown.effects(self._units_of(shown.store)))
            case ["actions", file]:
                return npy(shown.changed_actions(_number(file, ".npy"))), NPY
            case ["pictures", camera, file]:
                return shown.picture(camera, _number(file, ".png")), PNG
            case [site, *of_site] if site in [known.name for known in shown.store.attributes.sites]:
                return _of_site(shown, site, of_site, query)
        raise NoAnswer

    def _shown(self, store: Store, name: str) -> ShownEpisode:
        """An episode that stays open for its other answers, unless the store was captured anew."""
        key = str(store.path), store.run, name
        with self._lock:
            if key not in self._open:
                episode = next((episode for episode in store.episodes if episode.name == name), None)
                if episode is None:
                    raise NoAnswer
                self._open[key] = ShownEpisode(store, episode)
                while len(self._open) > _OPEN:
                    self._open.popitem(last=False)
            self._open.move_to_end(key)
            return self._open[key]

    def _units_of(self, store: Store) -> ActionSpread:
        """The units of effects, of the whole store as it is now."""
        key = str(store.path), len(store.episodes)
        if key not in self._units:
            self._units[key] = units_of_recorded(store, skip_corrupt=True)
        return self._units[key]


def _of_site(shown: ShownEpisode, site: str, names: Sequence[str], query: Mapping[str, Sequence[str]]) -> Content:
    match names:
        case ["objects.json"]:
            return _json(shown.covered(site))
        case ["rows" | "heads" as kind, file] if file.endswith(".npy"):
            return npy(shown.rows(site, file.removesuffix(".npy"), heads=kind == "heads")), NPY
        case ["uniform", file] if file.endswith(".npy"):
            return npy(shown.uniform(site, file.removesuffix(".npy"))), NPY
        case ["groups.json"]:
            return _json(shown.groups(site, _settings(query)))
        case ["heads.json"]:
            return _json(shown.heads(site, _selector(query)))
        case ["keys.json"]:
            return _json(shown.keys(site, _selector(query)))
    raise NoAnswer


def _json(document: Any) -> Content:
    return json.dumps(document, allow_nan=False).encode(), JSON


def _number(file: str, ending: str) -> int:
    stem = file.removesuffix(ending)
    if stem == file or not stem.isdecimal() or len(stem) > 9:
        raise NoAnswer
    return int(stem)


def _selector(query: Mapping[str, Sequence[str]]) -> str:
    if list(query) != ["selector"] or len(query["selector"]) != 1:
        raise BadArgument(f"Cannot use {', '.join(query) or 'no question'} here; expected ?selector=SELECTOR.")
    return query["selector"][0]


def _settings(query: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """The query as keywords of the Python API, checked by it: `group` may be repeated, others are joined by commas."""
    unknown = [name for name in query if name not in _SETTINGS]
    if unknown:
        raise BadArgument(f"Cannot use {', '.join(unknown)} here; expected {', '.join(_SETTINGS)}.")
    given: dict[str, Any] = {}
    for name, values in query.items():
        several = name in ("layers", "heads", "denoise")
        given["groups" if name == "group" else name] = (
            list(values) if name == "group" else values[-1].split(",") if several else values[-1]
        )
    if given.get("grouping", "default") not in BUILTIN_GROUPINGS:  # a file of this machine is no business of a page
        raise unknown_name("built-in grouping", given["grouping"], BUILTIN_GROUPINGS)
    asked = settings_from_keywords(**given)
    return {name: getattr(asked, name) for name in given}
