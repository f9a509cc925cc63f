"""Copies of stores without some of their arrays. A copy is a whole store: `verify` accepts it.

An episode's attributes list its arrays, and its seal lists its files. Deleting folders therefore gives a damaged store.
A copy has attributes that list the arrays it has, a root that names the omitted parts and the run it was copied from,
and a new seal that names the one under which the episode was captured. A copy without omissions is the same to the
byte, its seals too; the root of one from the hub names the commit that it was copied from. Every file is compared with
the seal when it is copied, so a damaged episode is refused.
"""

from __future__ import annotations

import errno
import json
import re
import shutil
import tarfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vla_attention.schemas.errors import BadArgument, UserError, listing, unknown_name
from vla_attention.schemas.stores.digest import run_digest, with_digest
from vla_attention.schemas.stores.durable_files import publish, publish_file
from vla_attention.schemas.stores.episode_files import foreign_in_episode
from vla_attention.schemas.stores.locks import WHOLE_STORE, store_locks
from vla_attention.schemas.stores.outcomes import read_outcomes, write_outcomes
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store
from vla_attention.schemas.stores.remote_source import RemoteFailure, source_of
from vla_attention.schemas.stores.root import (
    NAMES_FILE,
    TAR_SUFFIX,
    episode_folders,
    group_attributes,
    group_document,
    names_document,
    read_run,
)
from vla_attention.schemas.stores.seal import SEAL_FILE, seal_episode
from vla_attention.schemas.stores.store_format import (
    EPISODES_DOCUMENT,
    EPISODES_GROUP,
    CorruptEpisode,
    RunMismatch,
    is_episode_name,
    parse_episode_name,
)
from vla_attention.schemas.stores.store_place import check_place
from vla_attention.schemas.stores.store_url import HUB_PROTOCOL, MAIN, HubAddress, StorePlace, StoreUrl
from vla_attention.schemas.stores.tar_files import unpack, write_tar

EFFECTS, STEPS = "effects", "steps"
#: The parts that may be omitted: their purpose, and a pattern of their arrays' and files' names. Rows, atoms, roles and
#: the small arrays are always copied.
PARTS: dict[str, tuple[str, str]] = {
    "frames": ("the cameras' pictures; overlays and reruns need them", r"^(camera_)?frames/"),
    "objects": ("what each patch shows; object: groups need it", r"^objects/"),
    "contributions": ("value-weighted contributions; their norms need them", r"/contribution(/|$)"),
    EFFECTS: ("changes of the action without an item; effects needs them", r"^effects/|/cut(/|$)"),
    STEPS: ("positions, touches and goals; what was done and why it failed need them", r"^steps/"),
}
REST = "rest"
#: What a copy's provenance calls the address on the hub that it was copied from, with its commit.
FETCHED_FROM = "fetched_from"


@dataclass(frozen=True)
class Copied:
    """What a copy did: episodes added, episodes that were there already, bytes copied and bytes omitted."""

    added: int
    present: int
    copied_bytes: int
    left_bytes: int


def open_source(place: StorePlace) -> Store:
    """What is copied: a store, or a copy whose episodes are tar files; those are unpacked one by one."""
    tars = _tars(place) if isinstance(place, Path) else {}
    if not tars:
        return open_store(place)
    root, run = read_run(place)
    names, told = sorted(tars, key=parse_episode_name), read_outcomes(place)
    return Store(place, root, run, tuple(StoredEpisode(tars[name], name, run, told.get(name)) for name in names))


def _tars(store: Path) -> dict[str, Path]:
    """The tar files of a copy by the name of their episode."""
    tars = {path.name.removesuffix(TAR_SUFFIX): path for path in (store / EPISODES_GROUP).glob(f"*{TAR_SUFFIX}")}
    return {name: path for name, path in tars.items() if is_episode_name(name)}


def _unpacked(episode: StoredEpisode, building: Path, only: str = "") -> StoredEpisode:
    """An episode in a folder, with nothing read: unpacked where it is a tar file. only: the one file that is needed."""
    tar = episode.folder
    if not isinstance(tar, Path) or tar.suffix != TAR_SUFFIX:
        return replace(episode)
    into = building / "tar"
    shutil.rmtree(into, ignore_errors=True)
    try:
        unpack(tar, into, [f"{episode.name}/{only}"] if only else ())
    except (tarfile.TarError, KeyError, EOFError) as error:
        raise CorruptEpisode(f"Episode {episode.name} cannot be read: its tar file is damaged ({error}).") from None
    found = replace(episode, folder=into / episode.name)
    if not only and (foreign := foreign_in_episode(found)):
        more = f"its tar file holds more than its seal lists: {listing(foreign, 3)}"
        raise CorruptEpisode(f"Episode {episode.name} cannot be read: {more}.")
    return found


def part_sizes(store: Store) -> dict[str, int]:
    """Bytes of each part of a store, as the seals list them; `rest` is everything else."""
    sizes = dict.fromkeys((*PARTS, REST), 0)
    for episode in store.episodes:
        for file, record in episode.files.records.items():
            sizes[_part_of(file) or REST] += record.size
        sizes[REST] += len(episode.source.whole(SEAL_FILE))
    return sizes


def check_parts(names: Sequence[str]) -> tuple[str, ...]:
    """Raise `UnknownName` for a part that does not exist; returns each once, in a fixed order."""
    for name in names:
        if name not in PARTS:
            raise unknown_name("part", name, PARTS)
    return tuple(name for name in PARTS if name in names)


def copy_store(
    store: Store,
    target: Path,
    without: Sequence[str],
    progress: Callable[[int], object] | None = None,
    *,
    tar: bool = False,
) -> Copied:
    """Copy every episode of a store; `progress` is called with 1 after each. A copy that exists is brought up to date.

    tar: one tar file an episode; what reads stores reads the copy of such a copy.

    Raises:
        BadArgument: the target cannot be written, or is the store itself.
        RunMismatch: the target is a store of another run, or a copy without other parts.
        CorruptEpisode: an episode is damaged. Episodes that were copied before it stay.
    """
    without = check_parts(without)
    check_place(target, "copy to")
    if isinstance(store.path, Path) and target.resolve() == store.path.resolve():
        raise BadArgument(f"Cannot copy {store.path} to itself; give another name.")
    try:
        return _copy(store, target, without, progress, tar)
    except OSError as error:
        if isinstance(error, UserError) or error.errno is None:
            raise
        raise BadArgument(f"Cannot copy to {target}: {error.strerror or error}; give another place.") from None


def _copy(
    store: Store, target: Path, without: tuple[str, ...], progress: Callable[[int], object] | None, tar: bool
) -> Copied:
    root = _root_document(store, without)
    run = run_digest(group_attributes(root))
    target.parent.mkdir(parents=True, exist_ok=True)
    with store_locks(target).part(WHOLE_STORE) as building:
        _ensure_root(store, target, root, building)
        present = set(_tars(target)) if tar else {folder.name for folder in episode_folders(target)}
        if tar and not present and episode_folders(target):
            raise BadArgument(f"Cannot copy tar files to {target}: its episodes are folders; give another name.")
        _refuse_others(store, target, present, building)
        told = read_outcomes(target)
        others = [name for name, one in store.outcomes.items() if name in told and told[name].success != one.success]
        if others:
            raise RunMismatch(
                f"Cannot continue the copy {target}: it was told other outcomes of {listing(others, 4)} than "
                f"{store.path}. Take them back: vla-attention store outcomes {target} --remove."
            )
        added = copied = left = 0
        for episode in store.episodes:
            if episode.name not in present:
                folder = building / episode.name
                sizes = copy_episode(store, _unpacked(episode, building), folder, without, run)
                copied, left, added = copied + sizes[0], left + sizes[1], added + 1
                if tar:
                    file = building / f"{episode.name}{TAR_SUFFIX}"
                    write_tar(folder, file)
                    shutil.rmtree(folder)
                    publish_file(file, target / EPISODES_GROUP / file.name)
                else:
                    _rename_new(folder, target / EPISODES_GROUP / episode.name)
            if progress is not None:
                progress(1)
        if not tar:
            write_names(target, building)
        write_outcomes(target, building, told | store.outcomes)
    return Copied(added, len(store.episodes) - added, copied, left)


def write_names(store: Path, building: Path) -> None:
    """Write the list of a store's episodes, for web servers; `building` is a folder beside the store."""
    names = sorted((folder.name for folder in episode_folders(store)), key=parse_episode_name)
    (building / NAMES_FILE).write_bytes(names_document(names))
    publish_file(building / NAMES_FILE, store / NAMES_FILE)


def _ensure_root(store: Store, target: Path, root: bytes, building: Path) -> None:
    """Make the empty copy in one step, or check that the target is a copy of the same run without the same parts."""
    if not target.exists():
        empty = building / "root"
        (empty / EPISODES_GROUP).mkdir(parents=True)
        (empty / "zarr.json").write_bytes(root)
        (empty / EPISODES_DOCUMENT).write_bytes(_episodes_document(store))
        _rename_new(empty, target)
    if (target / "zarr.json").read_bytes() != root if (target / "zarr.json").is_file() else True:
        source = open_store(target).attributes.provenance.get(FETCHED_FROM)  # raises when it is no store
        here = group_attributes(root)["provenance"].get(FETCHED_FROM)
        if source and here and HubAddress.of(source).at(MAIN) == HubAddress.of(here).at(MAIN) and source != here:
            raise RunMismatch(
                f"Cannot continue the copy {target}: it is of {source}, and the repository is at another commit now "
                f"({here}). Give the first address to go on with it, or another name for a new copy."
            )
        raise RunMismatch(
            f"Cannot continue the copy {target}: it is of another run than {store.path}, or leaves other parts behind; "
            "give another name."
        )


def _refuse_others(store: Store, target: Path, present: Collection[str], building: Path) -> None:
    """Raise `RunMismatch` where the copy has an episode by its name that is another recording than the store's.

    One that was recorded again (`--overwrite`, after `repair`) has the name and the configuration of the first.
    """
    if not present:
        return
    copied = {episode.name: episode for episode in open_source(target).episodes}
    others = []
    for episode in store.episodes:
        if episode.name not in present:
            continue
        try:
            captured = _unpacked(copied[episode.name], building, SEAL_FILE).captured
        except CorruptEpisode as error:
            raise CorruptEpisode(f"Cannot continue the copy {target}: {error}") from None
        if captured != _unpacked(episode, building, SEAL_FILE).captured:
            others.append(episode.name)
    if others:
        raise RunMismatch(
            f"Cannot continue the copy {target}: {listing(others, 4)} in it {'is' if len(others) == 1 else 'are'} not "
            f"what {store.path} has under the same name, which was recorded again since; give another name."
        )


def copy_episode(
    store: Store,
    episode: StoredEpisode,
    folder: Path,
    without: tuple[str, ...],
    run: str,
    linked: Callable[[str, Path], bool] | None = None,
) -> tuple[int, int, int]:
    """Write the copy of one episode; returns the bytes that were copied, omitted and shared.

    linked: shares a file of the episode with a place, where it can.
    """
    for name in episode.attributes.arrays:
        if _part_of(name) not in without and f"{name}/zarr.json" not in episode.files.records:
            raise CorruptEpisode(f"Episode {episode.name} lacks the array {name}: its files are gone.")
    copied = left = shared = 0
    for file, record in episode.files.records.items():
        if _part_of(file) in without:
            left += record.size
            continue
        place = folder / file
        place.parent.mkdir(parents=True, exist_ok=True)
        if linked is not None and linked(file, place):
            shared += record.size
            continue
        copied += episode.copy_file(file, place)
        if file == "zarr.json" and without:
            place.write_bytes(_without_arrays(json.loads(place.read_bytes()), without))
    seal = folder / SEAL_FILE
    if without:
        seal_episode(folder, episode.name, run, copied_from=episode.captured)
    else:
        seal.parent.mkdir()
        seal.write_bytes(episode.source.whole(SEAL_FILE))
    return copied + seal.stat().st_size, left, shared


def _root_document(store: Store, without: tuple[str, ...]) -> bytes:
    """The copy's `zarr.json`: that of the run, in the version that it has, with the omitted parts."""
    content = source_of(store.path).whole("zarr.json")
    from_hub = isinstance(store.path, StoreUrl) and store.path.url.startswith(HUB_PROTOCOL)
    if not without and not from_hub:
        return content
    attributes = group_attributes(content)
    recording, provenance = attributes["recording"], attributes["provenance"]
    if from_hub:
        provenance[FETCHED_FROM] = str(store.path)
    if without:
        _leave_out(recording, provenance, without, store.run)
    return group_document(with_digest(attributes))


def _leave_out(recording: dict[str, Any], provenance: dict[str, str], without: Sequence[str], run: str) -> None:
    """State in a root that a copy has no such parts, and of which run it is."""
    recording.update({name: None if name == EFFECTS else False for name in without if name in recording})
    before = provenance.get("copied_without", "").split(", ")
    provenance["copied_without"] = ", ".join(name for name in PARTS if name in without or name in before)
    # A copy of a copy names the store that was captured, not the copy.
    provenance.setdefault("copied_from", run)


def _episodes_document(store: Store) -> bytes:
    """The `zarr.json` of the group of episodes: the store's own, or a new one where that is lost or damaged."""
    try:
        content = source_of(store.path).whole(EPISODES_DOCUMENT)
        stated = group_attributes(content)
    except RemoteFailure:
        raise
    except (OSError, ValueError):
        return group_document({})
    return group_document({}) if stated else content


def _without_arrays(changed: dict[str, Any], without: tuple[str, ...]) -> bytes:
    """An episode's `zarr.json` that does not list the arrays of these parts."""
    arrays = changed["attributes"]["arrays"]
    changed["attributes"]["arrays"] = {name: arrays[name] for name in arrays if _part_of(name) not in without}
    for part in (EFFECTS, STEPS):
        if part in without and part in changed["attributes"]:
            changed["attributes"][part] = None
    return json.dumps(changed, indent=2).encode()


def _part_of(path: str) -> str | None:
    """The part that an array, or a file of the episode, belongs to."""
    return next((name for name, (_, pattern) in PARTS.items() if re.search(pattern, path)), None)


def _rename_new(source: Path, target: Path) -> None:
    """Publish a folder, durably. When another copy was faster, its folder has the same content and stays."""
    try:
        publish(source, target, durable=True)
    except OSError as error:
        if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
            raise
