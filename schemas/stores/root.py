"""The root of a store: the run's attributes and the folders of its episodes. Read as plain JSON; zarr is not needed.

A copy has one more file, `NAMES_FILE`: web servers list nothing. Where a folder can be listed, it is not read.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from vla_attention.schemas.errors import BadArgument, did_you_mean, listing
from vla_attention.schemas.foreign_files import read_regular
from vla_attention.schemas.jsonable import MalformedDocument, decode_json, from_json
from vla_attention.schemas.stores.digest import run_digest
from vla_attention.schemas.stores.remote_source import RemoteFailure, RemoteFolder, is_web, source_of
from vla_attention.schemas.stores.store_format import (
    EPISODES_GROUP,
    FORMAT_NAME,
    STORE_VERSION,
    FormatTooNew,
    RootAttributes,
    StoreError,
    StoreNotFound,
    is_episode_name,
)
from vla_attention.schemas.stores.store_url import StorePlace, StoreUrl

#: The names of a copy's episodes, a list in JSON.
NAMES_FILE = "episodes.json"
#: Ending of an episode in a copy that is to be carried in few files (`store copy --tar`).
TAR_SUFFIX = ".tar"
#: What to do without a store.
_MAKE_ONE = "Make one: vla-attention capture pi --output NAME.zarr; vla-attention example copies small ones."


def read_root(path: StorePlace) -> RootAttributes:
    """The attributes of the store at `path`; raises as `read_run` does."""
    return read_run(path)[0]


def read_run(path: StorePlace) -> tuple[RootAttributes, str]:
    """The attributes of the store at `path`, and the digest of its run's configuration; episodes are bound to it.

    Raises:
        StoreNotFound: nothing is there; the error lists the stores nearby.
        StoreError: something else is there, or its attributes cannot be read.
        FormatTooNew: a later version wrote it.
    """
    if isinstance(path, Path) and not path.exists():
        nearby = [str(store) for store in _stores_in(path.parent)]
        there = f"Stores in {path.parent}: {listing(nearby, 5)}. " if nearby else ""
        raise StoreNotFound(f"There is no store at {path}.{did_you_mean(str(path), nearby)} {there}{_MAKE_ONE}")
    try:
        attributes = group_attributes(source_of(path).whole("zarr.json"))
    except (RemoteFailure, BadArgument):
        raise
    except (FileNotFoundError, NotADirectoryError):
        if isinstance(path, StoreUrl):
            raise StoreNotFound(
                f"There is no store at {path}: no zarr.json was found there. Give the address of the NAME.zarr itself; "
                "private places need the credentials of their service in the environment."
            ) from None
        inside = [store.name for store in _stores_in(path)]
        held = f"The folder holds the stores {listing(inside, 10)}: name one, or several." if inside else _MAKE_ONE
        raise StoreError(f"{path} is not a store: it has no zarr.json. {held}") from None
    except (OSError, ValueError) as error:
        reason = f"its zarr.json: {error.strerror or error}" if isinstance(error, OSError) else error
        raise StoreError(f"The store {path} cannot be read: {reason}.") from None
    if isinstance(path, Path):
        _refuse_inside(path, attributes)
    try:
        return decode_root(attributes, path), run_digest(attributes)
    except StoreError:
        raise
    except (MalformedDocument, ValueError) as error:
        raise StoreError(f"The store {path} cannot be read: {error}") from None


def _stores_in(folder: Path) -> list[Path]:
    """What a sentence offers: what is called a store in a folder and has what a store begins with."""
    return sorted(store for store in folder.glob("*.zarr") if (store / "zarr.json").is_file())


def _refuse_inside(path: Path, attributes: dict[str, Any]) -> None:
    """Raise `StoreError` for a group inside of a store, and name the store's folder."""
    if attributes.get("format") == FORMAT_NAME:
        return
    for above in path.absolute().parents:
        try:
            stated = group_attributes(read_regular(above / "zarr.json"))
        except (OSError, ValueError):
            return  # the store's groups are all above one another
        if stated.get("format") == FORMAT_NAME:
            raise StoreError(f"{path} is a group inside of a store; give the folder above, {above}.")


def episode_folders(path: StorePlace) -> list[StorePlace]:
    """Folders of the complete episodes of the store at `path`, in no particular order."""
    return list_episodes(path)[0]


def list_episodes(path: StorePlace) -> tuple[list[StorePlace], list[str]]:
    """Folders of the complete episodes of a store, as `episode_folders`, and names of what lies among them and is none.

    Readers ignore the latter: files, and folders with other names.
    """
    if isinstance(path, StoreUrl):
        try:
            names = listed_names(path) if is_web(path) else RemoteFolder(path.url).names(EPISODES_GROUP)
        except (OSError, NotImplementedError) as error:
            raise StoreError(
                f"The episodes of {path} cannot be listed ({str(error).rstrip('.')}), and it has no {NAMES_FILE}; "
                "vla-attention store copy writes one: upload a copy."
            ) from None
        is_episode_of = {name: is_episode_name(name) for name in names}
    else:
        try:
            entries = (path / EPISODES_GROUP).iterdir()
            is_episode_of = {entry.name: is_episode_name(entry.name) and entry.is_dir() for entry in entries}
        except OSError as error:
            raise StoreError(
                f"The store {path} cannot be read: its group '{EPISODES_GROUP}': {error.strerror or error}."
            ) from None
    if any(name.endswith(TAR_SUFFIX) and is_episode_name(name.removesuffix(TAR_SUFFIX)) for name in is_episode_of):
        raise StoreError(
            f"The episodes of {path} are tar files; vla-attention store copy {path} NAME.zarr makes a store of them."
        )
    strays = sorted(name for name, is_episode in is_episode_of.items() if not is_episode and name != "zarr.json")
    return [path / EPISODES_GROUP / name for name, is_episode in is_episode_of.items() if is_episode], strays


def unlisted_episodes(path: StorePlace, listed: Collection[str]) -> list[str]:
    """Episodes that a web server shows and a copy's `NAMES_FILE` does not list; none where it shows no folders."""
    if not isinstance(path, StoreUrl) or not is_web(path):
        return []
    with suppress(OSError):
        shown = re.findall(r"\w+", RemoteFolder(path.url).shown(EPISODES_GROUP))
        return sorted({name for name in shown if is_episode_name(name)} - set(listed))
    return []


def names_document(names: Sequence[str]) -> bytes:
    """The content of a copy's `NAMES_FILE`."""
    return json.dumps(names, indent=0).encode()


def listed_names(path: StoreUrl) -> list[str]:
    """The names that a copy's `NAMES_FILE` lists, for web servers, which list nothing.

    Raises:
        StoreError: the file says something else.
        OSError: there is none.
    """
    try:
        names = decode_json(source_of(path).whole(NAMES_FILE))
    except ValueError as error:
        raise StoreError(f"The store {path} cannot be read: its {NAMES_FILE}: {error}.") from None
    if not isinstance(names, list) or not all(isinstance(name, str) and is_episode_name(name) for name in names):
        raise StoreError(f"The store {path} cannot be read: its {NAMES_FILE} is no list of names of episodes.")
    return names


def group_attributes(document: bytes) -> dict[str, Any]:
    """The attributes in the `zarr.json` of a Zarr v3 group; raises `ValueError` when the bytes are anything else."""
    try:
        return attributes_in(decode_json(document))
    except MalformedDocument:
        raise
    except ValueError as error:
        raise ValueError(f"zarr.json cannot be decoded: {error}") from None


def attributes_in(content: Any) -> dict[str, Any]:
    """The attributes in the decoded `zarr.json` of a group; raises `MalformedDocument` for anything else."""
    if not isinstance(content, dict) or (content.get("zarr_format"), content.get("node_type")) != (3, "group"):
        raise MalformedDocument("zarr.json does not describe a group of Zarr format 3")
    attributes = content.get("attributes", {})
    if not isinstance(attributes, dict):
        raise MalformedDocument("zarr.json has no attributes")
    return attributes


def group_document(attributes: dict[str, Any]) -> bytes:
    """The `zarr.json` of a group, as zarr-python writes it."""
    return json.dumps({"attributes": attributes, "zarr_format": 3, "node_type": "group"}, indent=2).encode()


def decode_root(attributes: dict[str, Any], path: object) -> RootAttributes:
    """The root attributes of a store.

    Raises:
        FormatTooNew: a later version wrote the store.
        StoreError: it is no store of this tool, or its version is none.
        MalformedDocument, ValueError: its attributes have other fields or values than the format.
    """
    if attributes.get("format") != FORMAT_NAME:
        raise StoreError(
            f"{path} is a Zarr group, but not a store of this tool: its attribute 'format' is not '{FORMAT_NAME}'."
        )
    version = attributes.get("store_version")
    if not isinstance(version, int) or isinstance(version, bool) or version < STORE_VERSION:
        given = f"has the store_version {_short(version)}" if "store_version" in attributes else "has no store_version"
        raise StoreError(f"{path} {given}; expected {STORE_VERSION}.")
    if version > STORE_VERSION:
        raise FormatTooNew(
            f"{path} is a store of version {version}, and this program reads version {STORE_VERSION}; install "
            "a newer version of it."
        )
    return from_json(RootAttributes, attributes)


def _short(value: object) -> str:
    """A value of a document as text of at most about 40 characters."""
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."
