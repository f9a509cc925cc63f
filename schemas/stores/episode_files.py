"""Which files an episode has, whether they are all there, and what lies in a store and is no part of it.

An episode has a `zarr.json` for each group and array, the chunks of the arrays, and the seal. A seal is made by whoever
made the store. What it lists beyond these files is no part of an episode: `verify` names it, and nothing copies it.

Nothing reads what is foreign, other people's files, links, and files that no seal lists: neither this program, which
opens what the seals list, nor a reader of Zarr, to which they are no chunks of an array. A link in an episode is a
fault beyond that: a program that follows links, as rsync -L and web servers do, publishes or fills what it leads to.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path, PurePosixPath

from vla_attention.schemas.documents import decode_json
from vla_attention.schemas.stores.locks import WRITING_FOLDER
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.root import NAMES_FILE
from vla_attention.schemas.stores.seal import SEAL_FILE
from vla_attention.schemas.stores.store_format import (
    EPISODES_DOCUMENT,
    EPISODES_GROUP,
    CorruptEpisode,
    EpisodeAttributes,
    Problem,
    RootAttributes,
    is_episode_name,
)
from vla_attention.schemas.stores.store_url import StoreUrl

#: Names of chunks below their array, in the encodings that Zarr v3 has: `c.0.1`, `c/0/1`, `0.1`, `0/1`, `c`.
_CHUNK = re.compile(r"c|(?:c[./])?[0-9]{1,20}(?:[./][0-9]{1,20}){0,30}")
_DOCUMENT = "zarr.json"


def files_of_no_array(root: RootAttributes, attributes: EpisodeAttributes, files: Iterable[str]) -> list[str]:
    """Those of an episode's sealed files that belong to none of its arrays, groups and sites."""
    arrays = attributes.arrays.keys()
    groups = {str(parent) for name in arrays for parent in PurePosixPath(name).parents}
    groups |= {".", *(site.name for site in root.sites)}
    return [file for file in files if not _belongs(file, arrays, groups)]


def _belongs(file: str, arrays: Iterable[str], groups: set[str]) -> bool:
    path = PurePosixPath(file)
    if path.name == _DOCUMENT:
        return str(path.parent) in groups or str(path.parent) in arrays
    above = next((parent for parent in path.parents if str(parent) in arrays), None)
    return above is not None and _CHUNK.fullmatch(str(path.relative_to(above))) is not None


def links_in_episode(episode: StoredEpisode) -> list[str]:
    """Files and folders of an episode that are links; none of one at an address.

    What a link leads to is not in the store: copies follow none. The episode's own folder is `.`.
    """
    if isinstance(episode.folder, StoreUrl):
        return []
    files = [*episode.files.records, SEAL_FILE]
    folders = {str(parent) for file in files for parent in PurePosixPath(file).parents}
    return [path for path in sorted({*folders, *files}) if os.path.islink(episode.folder / path)]


def refuse_links(episode: StoredEpisode) -> None:
    """Raise `CorruptEpisode` for an episode with links, which is not copied."""
    for path in links_in_episode(episode):
        raise CorruptEpisode(f"Episode {episode.name} is damaged: its {path} is a link, and no copy follows links.")


#: Foreign files that are named of one episode, or of one store beside its episodes. More of them are not counted: a
#: folder may hold millions.
MOST_NAMED = 100


def foreign_in_episode(episode: StoredEpisode) -> tuple[str, ...]:
    """Paths in an episode's folder that its seal does not list; a folder without any sealed file ends with /.

    Links are not among them (`links_beyond_seal`). Of an episode at an address nothing is known.
    `CorruptEpisode` when it has no readable seal.
    """
    return _named(file for file in _beyond_seal(episode) if not file.is_link)


def links_beyond_seal(episode: StoredEpisode) -> tuple[str, ...]:
    """Links in an episode's folder that its seal does not list; raises as `foreign_in_episode` does.

    Those in place of what it lists are `links_in_episode`.
    """
    return _named(file for file in _beyond_seal(episode) if file.is_link)


def _beyond_seal(episode: StoredEpisode) -> Iterator[_Found]:
    known = {SEAL_FILE, *episode.files.records}
    if isinstance(episode.folder, Path):
        folders = {"."}
        for file in known:
            while file := file.rpartition("/")[0]:
                folders.add(file)
        yield from (entry for entry in _beyond(episode.folder, known, folders) if entry.path not in folders)


def foreign_in_store(store: Store) -> tuple[str, ...]:
    """Paths beside the episodes of a store that are no part of it; nothing is known of a store at an address."""
    if isinstance(store.path, StoreUrl):
        return ()
    known = {"zarr.json", EPISODES_DOCUMENT, NAMES_FILE, WRITING_FOLDER}
    known |= {f"{EPISODES_GROUP}/{name}" for name in _episode_names(store.path / EPISODES_GROUP)}
    beyond = _beyond(store.path, known, {".", EPISODES_GROUP})
    return _named(replace(one, path=f"{one.path} (a link)") if one.is_link else one for one in beyond)


def beyond_the_format(store: Store) -> tuple[str, ...]:
    """Everything that a copy of a store's folder which follows links would take along beside the store: paths in it.

    Named are links, also those in place of the store's own files, and what is no part of it. Nothing is known of a
    store at an address.

    Raises:
        CorruptEpisode: nothing is found, and what belongs to an episode is not known.
    """
    if isinstance(store.path, StoreUrl):
        return ()
    known = {"zarr.json", EPISODES_GROUP, EPISODES_DOCUMENT, NAMES_FILE, WRITING_FOLDER}
    beyond = list(foreign_in_store(store))
    beyond += [f"{path} (a link)" for path in known if os.path.islink(store.path / path)]
    unknown: CorruptEpisode | None = None
    for episode in map(replace, store.episodes):  # anew: what is read of one goes with it
        try:
            links = [*links_in_episode(episode), *links_beyond_seal(episode)]
            inside = [*(f"{path} (a link)" for path in links), *foreign_in_episode(episode)]
        except CorruptEpisode as error:
            unknown = unknown or error
            continue
        beyond += [f"{EPISODES_GROUP}/{episode.name}/{path}" for path in inside]
    if unknown is not None and not beyond:
        raise unknown
    return tuple(sorted(set(beyond)))


def _episode_names(folder: Path) -> Iterator[str]:
    """Names of the folders of episodes; a link is none."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if is_episode_name(entry.name) and entry.is_dir(follow_symlinks=False):
                yield entry.name


@dataclass(frozen=True)
class _Found:
    """A path that is not known."""

    path: str
    is_link: bool = False


def _named(found: Iterable[_Found]) -> tuple[str, ...]:
    return tuple(sorted(one.path for one in islice(found, MOST_NAMED)))


def _beyond(place: Path, known: set[str], folders: set[str]) -> Iterator[_Found]:
    """Paths in the known folders below a place that are neither known nor lead to a known file.

    Links are followed nowhere, and no other folder is looked into.
    """
    linked: set[str] = set()
    for folder in sorted(folders):  # each after the one that it is in
        path = f"{place}/{folder}"
        if folder.rpartition("/")[0] in linked or (folder != "." and os.path.islink(path)):
            linked.add(folder)
            continue
        with suppress(OSError), os.scandir(path) as entries:  # one that is lost is a fault, found elsewhere
            yield from _unknown(entries, "" if folder == "." else f"{folder}/", known, folders)


def _unknown(entries: Iterable[os.DirEntry[str]], inside: str, known: set[str], folders: set[str]) -> Iterator[_Found]:
    for entry in entries:
        path = f"{inside}{entry.name}"
        if path in known:
            continue
        if entry.is_symlink():
            yield _Found(path, is_link=True)
        elif not entry.is_dir(follow_symlinks=False):
            yield _Found(path)
        elif path not in folders:
            yield _Found(f"{path}/")


def check_presence(episode: StoredEpisode) -> list[Problem]:
    """What is wrong with an episode, looked at cheaply; an empty list means that it is present.

    `--resume`, `status`, `repair` and `verify --quick` ask this of every episode; `verify.py` reads everything.

    Looked at are the seal, the episode's name and run, every `zarr.json`, the presence and size of every file, and that
    nothing in the episode is a link; the content of arrays is not read.
    """
    try:
        _ = episode.attributes
    except CorruptEpisode as error:
        return [Problem(str(error), error.file)]
    said = {path: f"its {path} is a link" for path in links_in_episode(episode)}
    said |= {
        path: f"its {path} is a link, which its seal does not list; remove it" for path in links_beyond_seal(episode)
    }
    said |= {file: problem for file, problem in episode.files.problems().items() if file not in said}
    problems = [Problem(f"Episode {episode.name} is damaged: {problem}.", file) for file, problem in said.items()]
    for file in episode.files.records:
        if file.endswith("zarr.json") and file not in said:
            problems += metadata_problems(episode, file)
    return problems


def metadata_problems(episode: StoredEpisode, file: str) -> list[Problem]:
    """Whether a `zarr.json` of an episode is the one that was sealed, and says what the seal repeats of it."""
    try:
        same = decode_json(episode.files.whole(file)) == episode.document(file)
    except CorruptEpisode as error:
        return [Problem(f"Episode {episode.name} is damaged: {error}.", error.file)]
    except ValueError:
        same = False
    what = f"Episode {episode.name} is damaged: its {file} does not say what its seal repeats of it."
    return [] if same else [Problem(what, file)]
