"""Checking whole stores: every file of every episode, and what lies beside them. Both command lines use it.

How far is looked is a `Depth`. Foreign files are named and are no faults, because nothing reads them.
"""

from __future__ import annotations

from collections.abc import Collection, Container, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.jsonable import decode_json
from vla_attention.schemas.stores.digest import root_digest
from vla_attention.schemas.stores.episode_checks import content_problems, form_problems
from vla_attention.schemas.stores.episode_files import check_presence, foreign_in_episode
from vla_attention.schemas.stores.outcomes import OUTCOMES_FILE, read_outcomes
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store
from vla_attention.schemas.stores.remote_source import RemoteFailure, source_of
from vla_attention.schemas.stores.root import NAMES_FILE, group_attributes, names_document
from vla_attention.schemas.stores.seal import SEAL_FILE
from vla_attention.schemas.stores.store_format import EPISODES_DOCUMENT, CorruptEpisode, Problem, StoreError

#: What to do about the outcomes that were told after a recording.
_TELL_ANEW = "take them back with vla-attention store outcomes STORE --remove, and tell them anew"
_ROOT_FILES = ("zarr.json", EPISODES_DOCUMENT)
#: quick: seals, metadata, and the presence and size of every file. files: every byte is compared with the seal, too.
#: values: all arrays are read, and the rules that the writer applies are applied again (`episode_checks.py`).
Depth = Literal["quick", "files", "values"]


@dataclass(frozen=True)
class Fault:
    """Something wrong with an episode, or with a file of the store beside its episodes: its name is in `where`."""

    where: str
    problem: str


@dataclass(frozen=True)
class EpisodeReport:
    """What was found of one episode.

    files, bytes: of the sealed files, with the seal; 0 when the seal cannot be read.
    problems: sentences; none means that the episode is whole, as far as was looked.
    foreign: paths in the episode that its seal does not list.
    """

    episode: str
    files: int
    bytes: int
    problems: tuple[str, ...]
    foreign: tuple[str, ...]

    @property
    def faults(self) -> list[Fault]:
        """The problems with the episode's name."""
        return [Fault(self.episode, problem) for problem in self.problems]


def verify_store(store: Store, depth: Depth = "values") -> list[Fault]:
    """Check a store and every episode. An empty list means: it is whole."""
    return store_faults(store) + [
        fault for episode in store.episodes for fault in episode_report(store, episode, depth).faults
    ]


def episode_report(store: Store, episode: StoredEpisode, depth: Depth) -> EpisodeReport:
    """Look at one episode of a store."""
    # Several checks may find the same fault.
    problems = list(dict.fromkeys(problem.text for problem in _problems(store, episode, depth)))
    try:
        foreign = foreign_in_episode(episode)
        records = episode.files.records
        size = sum(record.size for record in records.values()) + episode.source.size(SEAL_FILE)
    except RemoteFailure:
        raise
    except (CorruptEpisode, OSError):
        return EpisodeReport(episode.name, 0, 0, tuple(problems), ())
    return EpisodeReport(episode.name, len(records) + 1, size, tuple(problems), foreign)


def store_faults(store: Store) -> list[Fault]:
    """What is wrong with a store beside its episodes: with the `zarr.json` of its two groups, and its list of names."""
    faults = []
    for file in _ROOT_FILES:
        try:
            faults += [Fault(file, problem) for problem in _group_problems(store, file)]
        except RemoteFailure:
            raise
        except OSError as error:
            faults.append(Fault(file, f"it is lost ({error.strerror or error})"))
        except ValueError as error:
            faults.append(Fault(file, f"it is damaged: {error}"))
    if isinstance(store.path, Path) and (store.path / NAMES_FILE).is_file():
        names = [episode.name for episode in store.episodes]
        if (store.path / NAMES_FILE).read_bytes() != names_document(names):
            faults.append(Fault(NAMES_FILE, "it lists other episodes than are there; web servers give those it lists"))
    try:
        strangers = sorted(read_outcomes(store.path).keys() - {episode.name for episode in store.episodes})
    except StoreError:
        faults.append(Fault(OUTCOMES_FILE, f"it is damaged: {_TELL_ANEW}"))
        strangers = []
    if strangers:
        faults.append(
            Fault(OUTCOMES_FILE, f"it has outcomes of {listing(strangers, 4)}, which are not there: {_TELL_ANEW}")
        )
    return faults


def _group_problems(store: Store, file: str) -> Iterator[str]:
    content = source_of(store.path).whole(file)
    attributes = group_attributes(content)
    if file == EPISODES_DOCUMENT:
        if attributes or decode_json(content).keys() - {"attributes", "zarr_format", "node_type"}:
            yield "it says more than that it is a group: the group of episodes has no attributes"
    elif not store.attributes.digest:
        yield "it has lost its own digest"
    elif store.attributes.digest != root_digest(attributes):
        yield "it was changed: its own digest does not fit"


def _problems(store: Store, episode: StoredEpisode, depth: Depth) -> list[Problem]:
    try:
        _ = episode.attributes
    except CorruptEpisode as error:
        return [Problem(str(error), error.file)]
    look = {"quick": None, "files": form_problems, "values": content_problems}[depth]
    problems = [] if look is None else list(look(store.attributes, episode))
    said = {problem.file for problem in problems} - {None}
    problems += [one for one in check_presence(episode) if one.file not in said]
    if depth != "quick":
        problems += _problems_of_bytes(episode, {problem.file for problem in problems})
    return problems


def _problems_of_bytes(episode: StoredEpisode, known: Container[str | None]) -> Iterator[Problem]:
    """Whether every file is the one that was sealed: a chunk of another episode has a checksum that fits, too."""
    for file in episode.files.records:
        if not (file.endswith("zarr.json") or file in known):
            try:
                episode.files.check(file)
            except CorruptEpisode as error:
                yield Problem(f"Episode {episode.name} is damaged: {error}.", file)


class DamagedEpisodesLeft(StoreError):
    """A capture is over, and episodes that it was asked for are in the store, but damaged."""


@dataclass(frozen=True)
class DamagedEpisode:
    """An episode that is in the store and cannot be used; `problems` are sentences, at least one."""

    name: str
    problems: tuple[str, ...]

    def describe(self) -> str:
        """Return the first problem and the number of others as one sentence, which names the episode."""
        first = self.problems[0].rstrip(".")
        first = first if self.name in first else f"Episode {self.name} is damaged: {first}"
        others = len(self.problems) - 1
        more = f" (and {plural(others, 'more fault')})" if others else ""
        return f"{first}{more}."


def look_at(store: Store, episode: StoredEpisode, verify: bool = False) -> DamagedEpisode | None:
    """Return what is wrong with an episode, or None.

    verify: compare every byte with the seal, as `vla-attention store verify` does.
    """
    problems = [problem.text for problem in check_presence(replace(episode))]
    if verify and not problems:
        problems = [*episode_report(store, episode, "files").problems]
    return DamagedEpisode(episode.name, tuple(problems)) if problems else None


def find_damaged(path: Path, names: Collection[str], verify: bool = False) -> list[DamagedEpisode]:
    """Return the damaged episodes among those named. An episode that the store lacks is not damaged."""
    store = open_store(path, as_recorded=True)
    looks = (look_at(store, episode, verify) for episode in store.episodes if episode.name in names)
    return [damaged for damaged in looks if damaged is not None]


def what_to_do(path: Path, damaged: Collection[DamagedEpisode]) -> str:
    """Return the sentences for a user whose capture cannot record these episodes again."""
    count = len(damaged)
    described = " ".join(episode.describe() for episode in list(damaged)[:3])
    others = listing((episode.name for episode in list(damaged)[3:]), 20)
    return (
        f"{count} of the episodes asked for {'is' if count == 1 else 'are'} damaged: {described}"
        f"{f' Damaged too: {others}.' if count > 3 else ''} A capture moves no data; run vla-attention capture verify "
        f"{path} "
        "--repair, which moves damaged episodes aside, and then this capture again with --resume."
    )
