"""What is measured of episodes: once, where the cache has it, and kept on disk: of thousands it would not fit."""

from __future__ import annotations

import os
import pickle
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Generic, TypeVar

from numpy.typing import NDArray

from vla_attention.analyze.cache.remembered import CachedQuestion, remembered
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.progress_bar import progress_bar

Member = TypeVar("Member")


def measured_once(
    what: str,
    selected: Sequence[SelectedEpisode],
    selection: Selection,
    site: str,
    measure: Callable[[Any], dict[str, NDArray[Any]]],
    arguments: Mapping[str, Any],
    of_episodes: Sequence[Any] | None = None,
    given: Callable[[int], Any] | None = None,
) -> Iterator[dict[str, NDArray[Any]]]:
    """The arrays of every episode, in order: from the cache, or measured now and kept. A terminal sees the progress.

    Args:
        what: the kind of numbers.
        selected: the episodes.
        selection: layers, denoise steps and heads.
        site: the softmax family.
        measure: gives the arrays of an episode; a function of a module, or a `functools.partial` of one.
        arguments: what the numbers depend on besides the episode, the selection, the site and the keys that were taken
            out of the episode; JSON values.
        of_episodes: the same that differs between episodes.
        given: what `measure` is called with for the episode at a position; the episode, unread, unless given.
    """
    axes = {"layers": selection.layers, "denoise": selection.denoise, "heads": selection.heads}
    question = CachedQuestion(what, {**arguments, **axes, "per_head": selection.per_head, "site": site})
    own = of_episodes or [None] * len(selected)
    extra = [[item.without, one] for item, one in zip(selected, own, strict=True)]
    with progress_bar(len(selected), "episodes") as advance:

        def scan(positions: Sequence[int]) -> Iterator[dict[str, NDArray[Any]]]:
            return each_episode(measure, (given(i) if given else selected[i].fresh() for i in positions), advance)

        yield from remembered(question, [item.episode for item in selected], scan, extra, advance)


class OnDisk(Sequence[Member], Generic[Member]):
    """A sequence whose members are made, at every access, from contents that lie in a temporary file.

    The file has no name, and its space is free again when this object is gone. It lies where temporary files do
    (`TMPDIR`).
    """

    def __init__(
        self, contents: Iterable[Any], make: Callable[[int, Any], Member] = lambda _position, content: content
    ) -> None:
        """Write the contents, each as soon as it is there.

        make: gives a member from its position and its content; the content itself unless given.

        Raises:
            BadArgument: there is no room for them.
        """
        self._make, self._ends = make, [0]
        try:
            self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        except OSError as error:
            raise _no_room(error) from None
        weakref.finalize(self, self._file.close)
        for content in contents:
            rest = memoryview(pickle.dumps(content, protocol=pickle.HIGHEST_PROTOCOL))
            self._ends.append(self._ends[-1] + len(rest))
            try:
                while rest:
                    rest = rest[self._file.write(rest) :]
            except OSError as error:
                raise _no_room(error) from None

    def __len__(self) -> int:
        """Number of members."""
        return len(self._ends) - 1

    def __getitem__(self, index: Any) -> Any:
        """One member, made now; no slices."""
        position = range(len(self))[index]
        start, end = self._ends[position], self._ends[position + 1]
        # With its place, and not from where the last reading ended: several threads may read.
        content = pickle.loads(os.pread(self._file.fileno(), end - start, start))  # noqa: S301 - this process wrote it
        return self._make(position, content)


def _no_room(error: OSError) -> BadArgument:
    try:
        where = f" in {tempfile.gettempdir()}"
    except OSError:
        where = ""
    return BadArgument(
        f"Cannot keep what was measured in a temporary file{where}: {error.strerror or error}; set TMPDIR to a folder "
        "with room."
    )
