"""One scan of stored rows: everything that is looked for in them, while each of their chunks is decoded once.

What a look finds in an episode comes from the cache where it is there, and is kept on disk: of thousands of episodes it
would not fit into memory.
"""

from __future__ import annotations

import os
import pickle
import tempfile
import warnings
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

from vla_attention.analyze.cache.remembered import CachedQuestion, remembered
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.rows import LayerRows, layer_rows, whole_spans
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import BadArgument, Note
from vla_attention.schemas.progress_bar import progress_bar

Member = TypeVar("Member")


class Reducer(Protocol):
    """What is made of the rows of one episode, layer by layer.

    Attributes:
        keys: the keys that it needs, those from the first to the last of them; None: no rows.
    """

    keys: range | None

    def add(self, part: LayerRows) -> None:
        """Take the rows of a layer and denoise step; they have the `keys`, maybe others too."""

    def content(self) -> Any:
        """What was found: arrays by name where it is cached, else anything that can be pickled."""


@dataclass(frozen=True)
class Look(Generic[Member]):
    """What is looked for in every episode of a question.

    Attributes:
        what: the kind of numbers.
        begin: called with an episode, the selection, the site and what is `given` of the episode; returns its reducer.
            A function of a module, or a `functools.partial` of one.
        per_head: whether the reducer needs the rows of each head.
        arguments: what the numbers depend on besides the episode, the selection, the site and the keys that were taken
            out of the episode; JSON values. None: they are not cached.
        of_episodes: the same that differs between episodes, by position.
        given: gives the reducer's last argument for the episode at a position.
        made: gives a member of the result from its position and its content.
        positions: of the episodes in which it looks; all unless given.
        remark: called with every content in order, and at the end without one; returns a note, or nothing.
    """

    what: str
    begin: Callable[[SelectedEpisode, Selection, str, Any], Reducer]
    per_head: bool
    made: Callable[[int, Any], Member]
    arguments: Mapping[str, Any] | None = None
    of_episodes: Sequence[Any] = ()
    given: Callable[[int], Any] = lambda _position: None
    positions: Sequence[int] | None = None
    remark: Callable[[int | None, Any], str | None] = field(default=lambda _position, _content: None)


def scan(question: Question, looks: Sequence[Look[Any]]) -> list[Sequence[Any]]:
    """What every look finds, a sequence each; a terminal sees the progress.

    Raises:
        CorruptEpisode: rows are not those that were sealed, or do not add up.
    """
    selected, site = question.selected, question.site
    places = [range(len(selected)) if look.positions is None else look.positions for look in looks]
    questions, extra = [], []
    for look, of_look in zip(looks, places, strict=True):
        own = dict(zip(of_look, look.of_episodes or [None] * len(of_look), strict=True))
        axes = {name: getattr(question.selection, name) for name in ("layers", "denoise", "heads")}
        asked = None
        if look.arguments is not None:
            asked = CachedQuestion(look.what, {**look.arguments, **axes, "per_head": look.per_head, "site": site})
        questions.append(asked)
        extra.append({i: [selected[i].without, one] for i, one in own.items()})
    found = [OnDisk[Any](look.made, of_look) for look, of_look in zip(looks, places, strict=True)]
    selections = [replace(question.selection, per_head=look.per_head) for look in looks]
    with progress_bar(len(selected), "episodes") as advance:

        def read(wanted: Sequence[tuple[int, Sequence[int]]]) -> Iterator[list[Any]]:
            given = (
                (selected[i].fresh(), [(looks[j].begin, selections[j], looks[j].given(i)) for j in which])
                for i, which in wanted
            )
            return each_episode(partial(_scanned, site=site), given, advance)

        for i, contents in enumerate(remembered(questions, [one.episode for one in selected], read, extra, advance)):
            for j, content in contents.items():
                looks[j].remark(i, content)
                found[j].append(content)
    for note in filter(None, (look.remark(None, None) for look in looks)):
        warnings.warn(note, Note, stacklevel=2)
    return list(found)


Begun = tuple[Callable[[SelectedEpisode, Selection, str, Any], Reducer], Selection, Any]


def _scanned(given: tuple[SelectedEpisode, Sequence[Begun]], site: str) -> list[Any]:
    """The contents of an episode, of each reducer that is begun in it."""
    item, begun = given
    reducers = [(begin(item, selection, site, one), selection) for begin, selection, one in begun]
    reading = [(reducer, selection) for reducer, selection in reducers if reducer.keys is not None]
    if reading:
        wanted = [reducer.keys for reducer, _ in reading if reducer.keys is not None]
        first, stop = min(keys.start for keys in wanted), max(keys.stop for keys in wanted)
        keys = whole_spans(item.tokens.layout, item.episode.array(f"{site}/rows").metadata, first, stop)
        per_head = any(selection.per_head for _, selection in reading)
        for part in layer_rows(item.store.attributes, item.episode, reading[0][1], site, per_head, keys):
            over_heads = replace(part, rows=part.of_heads(False)) if per_head else part
            for reducer, selection in reading:
                reducer.add(part if selection.per_head else over_heads)
    contents = [reducer.content() for reducer, _ in reducers]
    item.episode.forget()  # one that is elsewhere stays open for the next scan
    return contents


class OnDisk(Sequence[Member], Generic[Member]):
    """A sequence whose members are made, at every access, from contents that lie in a temporary file.

    The file has no name, and its space is free again when this object is gone. It lies where temporary files do
    (`TMPDIR`).
    """

    def __init__(
        self,
        make: Callable[[int, Any], Member] = lambda _position, content: content,
        positions: Sequence[int] | None = None,
        contents: Iterable[Any] = (),
    ) -> None:
        """Begin with some contents, each of which is written as soon as it is there.

        make: gives a member from its position and its content; the content itself unless given. positions: what `make`
        is given instead of 0, 1, ...

        Raises:
            BadArgument: there is no room for them.
        """
        self._make, self._positions, self._ends = make, positions, [0]
        try:
            self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        except OSError as error:
            raise _no_room(error) from None
        weakref.finalize(self, self._file.close)
        for content in contents:
            self.append(content)

    def append(self, content: Any) -> None:
        """Write one more content; `BadArgument` when there is no room for it."""
        rest = memoryview(pickle.dumps(content, protocol=pickle.HIGHEST_PROTOCOL))
        end = self._ends[-1] + len(rest)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise _no_room(error) from None
        self._ends.append(end)

    def __len__(self) -> int:
        """Number of members."""
        return len(self._ends) - 1

    def __getitem__(self, index: Any) -> Any:
        """One member, made now; no slices."""
        position = range(len(self))[index]
        start, end = self._ends[position], self._ends[position + 1]
        # With its place, and not from where the last reading ended: several threads may read.
        content = pickle.loads(os.pread(self._file.fileno(), end - start, start))  # noqa: S301 - this process wrote it
        return self._make(position if self._positions is None else self._positions[position], content)


def _no_room(error: OSError) -> BadArgument:
    try:
        where = f" in {tempfile.gettempdir()}"
    except OSError:
        where = ""
    return BadArgument(
        f"Cannot keep what was measured in a temporary file{where}: {error.strerror or error}; set TMPDIR to a folder "
        "with room."
    )
