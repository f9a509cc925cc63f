"""Measuring episodes once: what the cache holds is taken from it, the rest is measured and put there.

The key of a file is the question (what is measured, with all its arguments, and the arithmetic), the digest of the
episode's seal, and the state of the episode's files (`file_state`). The cache changes no number and raises no error:
where it cannot be read or written, everything is measured.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import vla_attention
from vla_attention.analyze.cache.kept_files import (
    ENDING,
    entries,
    kept_bytes,
    make_room,
    read_arrays,
    write_file,
)
from vla_attention.analyze.cache.places import CachePlace, cache_place, check_cache_place
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import SEAL_GROUP

#: The sources that numbers depend on: how bytes become rows, selectors weights, and rows measures.
_SOURCES = (
    "schemas/*.py",
    "schemas/groupings/*.py",
    "schemas/groupings/word_lists/*",
    "schemas/stores/*.py",
    "analyze/stores/*.py",
    "analyze/measures/*.py",
    "analyze/core/*.py",
)
#: Files that changed less than this ago may change again without a difference that file systems' clocks show.
SETTLED_SECONDS = 2.0
#: The state of an episode that is not in a file system of this machine: its seal, which is read there at every opening,
#: has to suffice.
_ELSEWHERE = hashlib.sha256(b"elsewhere").digest()
#: Pictures are in no measure of attention, and are most of the files.
_NOT_MEASURED = "frames/"


@cache
def arithmetic_version() -> str:
    """A digest of the sources that make the numbers, of numpy's version and of the machine's order of bytes.

    A number that somebody must raise with every change would be forgotten once, and the cache would then give numbers
    of the arithmetic before.
    """
    digest = hashlib.sha256(f"numpy {version('numpy')} {sys.byteorder} {sys.version_info[:2]}".encode())
    package = Path(vla_attention.__file__).parent
    for pattern in _SOURCES:
        for file in sorted(package.glob(pattern)):
            if file.is_file():
                content = file.read_bytes()
                digest.update(f"\n{file.relative_to(package)} {len(content)}\n".encode())
                digest.update(content)
    return digest.hexdigest()


def file_state(episode: StoredEpisode) -> bytes | None:
    """A digest of the present state of an episode's files; None when one is missing or only just changed.

    What is taken from the cache is not read, so that damage would not be seen. Every file has to be the one that was
    there when it was measured: same inode, size, and times of change. Writing to a file, exchanging it and setting its
    date all change the time that the file system notes (ctime), which no program can set.

    Raises:
        CorruptEpisode: its seal cannot be read or is not its own.
    """
    place = episode.folder
    if not isinstance(place, Path):
        return _ELSEWHERE
    names = [name for name in episode.files.records if not name.startswith(_NOT_MEASURED)]
    paths = {name: f"{place}/{name}" for name in (*names, f"{SEAL_GROUP}/zarr.json")}
    newest, stats = 0, []
    for name, path in paths.items():
        try:
            status = os.stat(path)
        except OSError:
            return None
        newest = max(newest, status.st_mtime_ns, status.st_ctime_ns)
        stats.append(f"{name} {status.st_ino} {status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}")
    if newest > (time.time() - SETTLED_SECONDS) * 1e9:
        return None
    return hashlib.sha256("\n".join(stats).encode()).digest()


@dataclass(frozen=True)
class CachedQuestion:
    """What is measured of each episode.

    Attributes:
        what: the kind of numbers, for instance "masses".
        arguments: all that they depend on besides the episode; JSON values.
    """

    what: str
    arguments: Mapping[str, Any]

    @cached_property
    def digest(self) -> bytes:
        """The digest of what is measured and of the arithmetic that does it."""
        given = {"what": self.what, "arguments": self.arguments, "arithmetic": arithmetic_version()}
        return hashlib.sha256(json.dumps(given, sort_keys=True).encode()).digest()


class _Slot(NamedTuple):
    """Where the cache keeps the numbers of a question about an episode, and the digest of both."""

    path: Path
    key: bytes


def remembered(
    questions: Sequence[CachedQuestion | None],
    episodes: Sequence[StoredEpisode],
    measure: Callable[[Sequence[tuple[int, Sequence[int]]]], Iterable[list[Any]]],
    arguments: Sequence[Mapping[int, Any]],
    progress: Callable[[int], object],
) -> Iterator[dict[int, Any]]:
    """The numbers of every episode, in order, by question; from the cache they are bit for bit what was measured.

    Args:
        questions: what is measured; None where it is not cached.
        episodes: the episodes.
        measure: called with the positions of the episodes to measure, each with the questions, if there are any; gives
            in this order what each episode answers to its questions, as soon as it is known. It reports its own
            progress. It is called again for an episode whose numbers in the cache turn out to be damaged.
        arguments: by question: position of an episode of which it is asked -> what the numbers depend on that differs
            between episodes, a JSON value.
        progress: called with the number of episodes that need not be measured.
    """
    of_episode = [[j for j, asked in enumerate(arguments) if i in asked] for i in range(len(episodes))]
    place = cache_place()
    if place is None:
        wanted = [(i, of) for i, of in enumerate(of_episode) if of]
        measured = iter(measure(wanted) if wanted else ())
        for of in of_episode:
            yield dict(zip(of, next(measured), strict=True)) if of else {}
        return
    check_cache_place(place)
    room = place.most_bytes
    # Before anything is measured: a file that changes in the meantime makes what is kept of it invalid.
    slots: dict[tuple[int, int], _Slot] = {}
    missing = []
    kept = [{one.name for one in entries(_folder(place, asked))} if asked else set() for asked in questions]
    for i, episode in enumerate(episodes):
        state = file_state(episode) if any(questions[j] for j in of_episode[i]) else None
        for j in of_episode[i]:
            asked = questions[j]
            if asked is not None and state is not None:
                key = _key(asked, episode, state, arguments[j][i])
                slots[i, j] = _Slot(_folder(place, asked) / f"{key.hex()[:32]}{ENDING}", key)
        missing.append([j for j in of_episode[i] if (i, j) not in slots or slots[i, j].path.name not in kept[j]])
    wanted = [(i, of) for i, of in enumerate(missing) if of]
    if len(wanted) < len(episodes):
        progress(len(episodes) - len(wanted))
    measured = iter(measure(wanted) if wanted else ())
    try:
        for i in range(len(episodes)):
            found = dict(zip(missing[i], next(measured), strict=True)) if missing[i] else {}
            # Read when its turn comes: numbers of thousands of episodes would not fit into memory.
            known = {j: read_arrays(*slots[i, j]) for j in of_episode[i] if j not in found}
            if damaged := [j for j, arrays in known.items() if arrays is None]:
                found |= dict(zip(damaged, next(iter(measure([(i, damaged)]))), strict=True))
            for j, arrays in found.items():
                if (slot := slots.get((i, j))) is None:
                    continue
                content = kept_bytes(slot.key, arrays)
                # A question that alone is larger than the cache keeps its first episodes: dropping them for later
                # ones would leave nothing for the next time.
                room -= len(content)
                try:
                    if room >= 0:
                        write_file(slot.path, content)
                except OSError:
                    room = -1  # no room on the disk, or a folder that others own
            yield {j: found[j] if j in found else known[j] for j in of_episode[i]}
    finally:
        # Although nothing may have been written: the cache may hold what a larger VLA_CACHE_SIZE had room for.
        make_room(place.folder, place.most_bytes)


def _folder(place: CachePlace, question: CachedQuestion) -> Path:
    return place.folder / question.digest.hex()[:32]


def _key(question: CachedQuestion, episode: StoredEpisode, state: bytes, arguments: Any) -> bytes:
    """The digest of question and episode, as its files are at the moment."""
    about = f"{episode.seal.digest}\n{json.dumps(arguments, sort_keys=True)}\n".encode()
    return hashlib.sha256(question.digest + state + about).digest()
