"""One store of the episodes of several stores of one run.

The seal of an episode binds it to the configuration of its run and not to a store, so that episodes of one
configuration may lie in one store. The merged store is made beside its place, read back, and renamed into it when it is
whole. The given stores are only read.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from vla_attention.analyze.store.copying import copy_episode, write_names
from vla_attention.analyze.stores.parallel import episode_reports
from vla_attention.schemas.errors import BadArgument, UserError, listing, plural, shortened
from vla_attention.schemas.stores.digest import run_differences, with_digest
from vla_attention.schemas.stores.durable_files import publish
from vla_attention.schemas.stores.locks import WHOLE_STORE, store_locks
from vla_attention.schemas.stores.outcomes import write_outcomes
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store
from vla_attention.schemas.stores.remote_source import source_of
from vla_attention.schemas.stores.root import group_attributes, group_document
from vla_attention.schemas.stores.store_format import (
    EPISODES_DOCUMENT,
    EPISODES_GROUP,
    CorruptEpisode,
    RunMismatch,
    StoreExists,
)
from vla_attention.schemas.stores.store_place import check_place
from vla_attention.schemas.stores.store_url import HUB_PROTOCOL, StorePlace, StoreUrl

#: Differing fields that are named of two stores.
_MOST_NAMED = 5


@dataclass(frozen=True)
class Merged:
    """What a merge did: episodes of the new store, and bytes of its files, by whether they are shared."""

    episodes: int
    linked_bytes: int
    copied_bytes: int


def merge_stores(
    stores: Sequence[Store],
    target: Path,
    progress: Callable[[int], object] | None = None,
    *,
    link: bool = True,
) -> Merged:
    """Make a store of the episodes of others; `progress` is called with 1 after each.

    link: files of stores of folders that are here are linked, where the file system can; otherwise they are copied.

    Raises:
        BadArgument: fewer than two stores, two that hold the same episode, or a place that cannot be written.
        StoreExists: something is at the target.
        RunMismatch: the stores are of different configurations; the fields are named.
        CorruptEpisode: an episode is damaged. Nothing is left of the new store then.
    """
    _check(stores, target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with store_locks(target).part(WHOLE_STORE) as building:
            place = building / target.name
            merged = _merge(stores, place, progress, link)
            write_names(place, building)
            write_outcomes(place, building, {name: one for store in stores for name, one in store.outcomes.items()})
            publish(place, target, durable=True)
            return merged
    except OSError as error:
        if isinstance(error, UserError) or error.errno is None:
            raise
        raise BadArgument(f"Cannot merge into {target}: {error.strerror or error}; give another place.") from None


def _check(stores: Sequence[Store], target: Path) -> None:
    if len(stores) < 2:
        raise BadArgument("One store cannot be merged; give two or more, and the new one with -o.")
    check_place(target, "merge into")
    if os.path.lexists(target):
        raise StoreExists(f"Cannot merge into {target}: it exists already; give another name.")
    for other in stores[1:]:
        _check_same_run(stores[0], other)
    holders: dict[str, Store] = {}
    for store in stores:
        twice = [episode.name for episode in store.episodes if episode.name in holders]
        if twice:
            other = holders[twice[0]]
            both = [name for name in twice if holders[name] is other]
            raise BadArgument(
                f"Cannot merge: {other.path} and {store.path} hold the same episodes: {listing(both, 5)}. "
                "Remove one of each pair, or leave a store out."
            )
        holders |= dict.fromkeys((episode.name for episode in store.episodes), store)


def _check_same_run(one: Store, other: Store) -> None:
    if one.run == other.run and _left_out(one) == _left_out(other):
        return
    differences = [
        f"{where} is {shortened(repr(here))} in the one and {shortened(repr(second))} in the other"
        for where, here, second in run_differences(one.attributes, other.attributes)
    ]
    if one.run == other.run:
        differences = [f"the parts that copies left out are '{_left_out(one)}' and '{_left_out(other)}'"]
    named = "; ".join(differences[:_MOST_NAMED]) or "their zarr.json states the same in other numbers"
    more = f"; and {len(differences) - _MOST_NAMED} more fields differ" if len(differences) > _MOST_NAMED else ""
    raise RunMismatch(f"Cannot merge {one.path} and {other.path}, which are not of one run: {named}{more}.")


def _left_out(store: Store) -> str:
    return store.attributes.provenance.get("copied_without", "")


def _merge(stores: Sequence[Store], place: Path, progress: Callable[[int], object] | None, link: bool) -> Merged:
    """Make the store at `place`, and read it back."""
    (place / EPISODES_GROUP).mkdir(parents=True)
    (place / "zarr.json").write_bytes(_root_document(stores))
    (place / EPISODES_DOCUMENT).write_bytes(group_document({}))
    linked = copied = 0
    origin: dict[str, Store] = {}
    for store in stores:
        for episode in store.episodes:
            fresh = replace(episode)  # what is read of it is not kept
            linked_here = partial(_linked, fresh) if link else None
            try:
                sizes = copy_episode(store, fresh, place / EPISODES_GROUP / episode.name, (), store.run, linked_here)
            except CorruptEpisode as error:
                raise CorruptEpisode(f"Cannot merge: {error} Repair the store first.") from None
            copied, linked = copied + sizes[0], linked + sizes[2]
            origin[episode.name] = store
            if progress is not None:
                progress(1)
    built = open_store(place)
    for report in episode_reports(((built, episode) for episode in built.episodes), "files"):
        if report.problems:
            raise CorruptEpisode(
                f"Cannot merge: {report.episode} of {origin[report.episode].path} is damaged: "
                f"{report.problems[0].rstrip('.')}. Repair that store first."
            )
    return Merged(len(built.episodes), linked, copied)


def _root_document(stores: Sequence[Store]) -> bytes:
    """The root of the first store, with the names of all of them in its provenance."""
    attributes = group_attributes(source_of(stores[0].path).whole("zarr.json"))
    attributes["provenance"]["merged_from"] = ", ".join(
        f"{_named(store.path)} ({plural(len(store.episodes), 'episode')})" for store in stores
    )
    return group_document(with_digest(attributes))


def _named(place: StorePlace) -> str:
    """What a store is called in the provenance: its name, or its address on the hub with the commit."""
    return str(place) if str(place).startswith(HUB_PROTOCOL) else place.name


def _linked(episode: StoredEpisode, file: str, place: Path) -> bool:
    """Link one file; False where the file system cannot. What the file holds is looked at when all is read back."""
    if isinstance(episode.folder, StoreUrl):
        return False
    path = episode.folder / file
    try:
        os.link(path, place, follow_symlinks=False)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise CorruptEpisode(f"Episode {episode.name} has lost its {file} ({error.strerror}).") from None
    except OSError:  # file systems without links say it in many ways; what else is wrong, copying says
        return False
    return True
