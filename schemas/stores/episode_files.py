"""Which files an episode has: a `zarr.json` for each group and array, the chunks of the arrays, and the seal.

A seal is made by whoever made the store. What it lists beyond these files is no part of an episode: `verify` names it,
and nothing copies it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import PurePosixPath

from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.seal import SEAL_FILE
from vla_attention.schemas.stores.store_format import CorruptEpisode, EpisodeAttributes, RootAttributes
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
    """Files and folders of an episode that are links; none of one in a zip or at an address.

    What a link leads to is not in the store: copies follow none. The episode's own folder is `.`.
    """
    if episode.place is not None or isinstance(episode.folder, StoreUrl):
        return []
    files = [*episode.files.records, SEAL_FILE]
    folders = {str(parent) for file in files for parent in PurePosixPath(file).parents}
    return [path for path in sorted({*folders, *files}) if os.path.islink(episode.folder / path)]


def refuse_links(episode: StoredEpisode) -> None:
    """Raise `CorruptEpisode` for an episode with links, which is not copied."""
    for path in links_in_episode(episode):
        raise CorruptEpisode(f"Episode {episode.name} is damaged: its {path} is a link, and no copy follows links.")
