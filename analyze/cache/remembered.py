"""Measuring episodes once: what the cache holds is taken from it, the rest is measured and put there.

The key of a record is the question (what is measured, with all its arguments, and the arithmetic), the digest of the
episode's seal, and the state of the episode's files (`fingerprints`). The cache changes no number and raises no error:
where it cannot be read or written, everything is measured.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from vla_attention.analyze.cache.arithmetic import arithmetic_version
from vla_attention.analyze.cache.array_bytes import arrays_from_bytes, arrays_to_bytes
from vla_attention.analyze.cache.fingerprints import file_state
from vla_attention.analyze.cache.housekeeping import make_room
from vla_attention.analyze.cache.places import CachePlace, cache_place, check_cache_place
from vla_attention.analyze.cache.segments import (
    Record,
    SegmentWriter,
    find_records,
    question_digest,
    read_record,
    touch,
)
from vla_attention.schemas.stores.reader import StoredEpisode

Arrays = dict[str, NDArray[Any]]
#: A long run fills several segments, so that room is made by parts of it.
_SEGMENT_BYTES = 256_000_000


@dataclass(frozen=True)
class CachedQuestion:
    """What is measured of each episode.

    Attributes:
        what: the kind of numbers, for instance "masses".
        arguments: all that they depend on besides the episode; JSON values.
        about: the same in words, for people.
    """

    what: str
    arguments: Mapping[str, Any]
    about: str

    @property
    def digest(self) -> bytes:
        """The digest of what is measured and of the arithmetic that does it."""
        given = {"what": self.what, "arguments": self.arguments, "arithmetic": arithmetic_version()}
        return question_digest(json.dumps(given, sort_keys=True))


def remembered(
    question: CachedQuestion,
    episodes: Sequence[StoredEpisode],
    measure: Callable[[Sequence[int]], Iterable[Arrays]],
    arguments: Sequence[Any] | None = None,
    progress: Callable[[int], object] | None = None,
) -> Iterator[Arrays]:
    """The numbers of every episode, in order; those from the cache are bit for bit those that were measured.

    Args:
        question: what is measured.
        episodes: the episodes.
        measure: called with the positions of the episodes to measure, if there are any; gives their arrays in this
            order, each as soon as it is known. It reports its own progress. It is called again for an episode whose
            numbers in the cache turn out to be damaged.
        arguments: what the numbers depend on that differs between episodes, a JSON value for each of them.
        progress: called with the number of episodes that need not be measured.
    """
    place = cache_place()
    if place is None:
        yield from measure(range(len(episodes)))
        return
    check_cache_place(place)
    cache = _Lookup(question, place)
    extra = arguments or [None] * len(episodes)
    keys = [_episode_key(episode, one) for episode, one in zip(episodes, extra, strict=True)]
    # Before anything is measured: a file that changes in the meantime makes what is kept of it invalid.
    states = [file_state(episode) for episode in episodes]
    records = [() if state is None else cache.records(key, state) for key, state in zip(keys, states, strict=True)]
    missing = [i for i, found in enumerate(records) if not found]
    if progress is not None and len(missing) < len(episodes):
        progress(len(episodes) - len(missing))
    with _Keeper(cache.digest, question.about, place) as keeper:
        measured = iter(measure(missing) if missing else ())
        for i, (key, state, found) in enumerate(zip(keys, states, records, strict=True)):
            # Read when its turn comes: numbers of thousands of episodes would not fit into memory.
            arrays = cache.read(found, key)
            if arrays is None:
                arrays = next(iter(measure([i]))) if found else next(measured)
                if state is not None:
                    keeper.add(key, state, arrays)
            yield arrays


def _episode_key(episode: StoredEpisode, arguments: Any) -> bytes:
    return hashlib.sha256(f"{episode.seal.digest}\n{json.dumps(arguments, sort_keys=True)}".encode()).digest()


class _Lookup:
    """The records of one question in the cache."""

    def __init__(self, question: CachedQuestion, place: CachePlace) -> None:
        self.digest = question.digest
        self._records = find_records(question_folder(place, self.digest), self.digest)
        self._touched: set[str] = set()

    def records(self, key: bytes, state: bytes) -> Sequence[Record]:
        """Those of an episode that is as it was."""
        return [record for record in self._records.get(key, ()) if record.state == state]

    def read(self, records: Sequence[Record], key: bytes) -> Arrays | None:
        """The arrays of the first record that is whole."""
        found = (self._read(record, key) for record in records)
        return next((arrays for arrays in found if arrays is not None), None)

    def _read(self, record: Record, key: bytes) -> Arrays | None:
        content = read_record(record, key, self.digest)
        if content is None:
            return None
        if str(record.segment) not in self._touched:
            touch(record.segment)
            self._touched.add(str(record.segment))
        try:
            return arrays_from_bytes(content)
        except (TypeError, ValueError):
            return None  # its digest is right: somebody else wrote it


def question_folder(place: CachePlace, digest: bytes) -> Path:
    """The folder of the segments of one question."""
    return place.folder / digest.hex()[:32]


class _Keeper:
    """Writes what was measured into the cache, as long as that can be done."""

    def __init__(self, digest: bytes, about: str, place: CachePlace) -> None:
        self._digest, self._about, self._place = digest, about, place
        self._writer: SegmentWriter | None = self._new()
        self._finished = 0

    def _new(self) -> SegmentWriter:
        return SegmentWriter(question_folder(self._place, self._digest), self._digest, self._about)

    def add(self, key: bytes, state: bytes, arrays: Arrays) -> None:
        if self._writer is None:
            return
        content = arrays_to_bytes(arrays)
        # A question that alone is larger than the cache keeps its first episodes: dropping them for later ones would
        # leave nothing for the next time.
        if self._finished + self._writer.size_with(content) > self._place.most_bytes:
            self._stop()
            return
        try:
            if self._writer.size > _SEGMENT_BYTES:
                self._writer.close()
                self._finished += self._writer.size
                self._writer = self._new()
            self._writer.add(key, state, content)
        except OSError:
            self._stop()  # no room on the disk, or a folder that others own: numbers do not depend on it

    def _stop(self) -> None:
        if self._writer is not None:
            with suppress(OSError):  # what cannot be flushed is a record that is not whole
                self._writer.close()
            self._finished += self._writer.size
            self._writer = None

    def __enter__(self) -> _Keeper:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()
        # Although nothing may have been written: the cache may hold what a larger VLA_CACHE_SIZE had room for.
        make_room(self._place)
