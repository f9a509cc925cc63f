"""Which files an episode has, whether they are all there, and what lies in a store and is no part of it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Set
from contextlib import suppress
from pathlib import Path, PurePosixPath

from vla_attention.schemas.jsonable import decode_json
from vla_attention.schemas.stores.locks import WRITING_FOLDER
from vla_attention.schemas.stores.outcomes import OUTCOMES_FILE
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.root import NAMES_FILE
from vla_attention.schemas.stores.seal import SEAL_FILE
from vla_attention.schemas.stores.store_format import EPISODES_DOCUMENT, EPISODES_GROUP, CorruptEpisode, Problem
from vla_attention.schemas.stores.store_url import StoreUrl


def foreign_in_episode(episode: StoredEpisode) -> tuple[str, ...]:
    """Paths in an episode's folder that its seal does not list; a folder without any sealed file ends with /.

    Of an episode at an address nothing is known. `CorruptEpisode` when it has no readable seal.
    """
    known = {SEAL_FILE, *episode.files.records}
    return () if isinstance(episode.folder, StoreUrl) else _beyond(episode.folder, known)


def foreign_in_store(store: Store) -> tuple[str, ...]:
    """Paths beside the episodes of a store that are no part of it; nothing is known of a store at an address."""
    if isinstance(store.path, StoreUrl):
        return ()
    episodes = {f"{EPISODES_GROUP}/{episode.name}" for episode in store.episodes}
    return _beyond(store.path, {"zarr.json", EPISODES_DOCUMENT, NAMES_FILE, OUTCOMES_FILE, WRITING_FOLDER, *episodes})


def _beyond(place: Path, known: Set[str]) -> tuple[str, ...]:
    """Paths below a place that are neither known nor lead to what is."""
    folders = {str(parent) for path in known for parent in PurePosixPath(path).parents}

    def unknown(folder: str) -> Iterator[str]:
        with suppress(OSError):  # one that is lost is a fault, found elsewhere
            for entry in os.scandir(place / folder):
                path = str(PurePosixPath(folder) / entry.name)
                is_folder = entry.is_dir(follow_symlinks=False)
                if is_folder and path in folders:
                    yield from unknown(path)
                elif path not in known:
                    yield f"{path}/" if is_folder else path

    return tuple(sorted(unknown(".")))


def check_presence(episode: StoredEpisode) -> list[Problem]:
    """What is wrong with an episode, looked at cheaply; an empty list means that it is present.

    `--resume`, `status`, `repair` and `verify --quick` ask this of every episode; `verify.py` reads everything.
    Looked at are the seal, the episode's name and run, every `zarr.json`, and the presence and size of every file; the
    content of arrays is not read.
    """
    try:
        _ = episode.attributes
    except CorruptEpisode as error:
        return [Problem(str(error), error.file)]
    missing = episode.files.problems()
    problems = [Problem(f"Episode {episode.name} is damaged: {said}.", file) for file, said in missing.items()]
    for file in episode.files.records:
        if file.endswith("zarr.json") and file not in missing:
            problems += metadata_problems(episode, file)
    return problems


def metadata_problems(episode: StoredEpisode, file: str) -> list[Problem]:
    """Whether a `zarr.json` of an episode is the one that was sealed, and says what the seal repeats of it."""
    try:
        same = decode_json(episode.files.whole(file)) == episode.document(file)
    except CorruptEpisode as error:
        return [Problem(f"Episode {episode.name} is damaged: {error}.", error.file)]
    what = f"Episode {episode.name} is damaged: its {file} does not say what its seal repeats of it."
    return [] if same else [Problem(what, file)]
