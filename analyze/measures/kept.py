"""What is measured of the rows of an episode is measured once: the seam between measures and the cache."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

from vla_attention.analyze.cache.remembered import CachedQuestion, remembered
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.selection import Selection


def measured_once(
    what: str,
    selected: Sequence[SelectedEpisode],
    selection: Selection,
    site: str,
    measure: Callable[[Sequence[int]], Iterable[dict[str, NDArray[Any]]]],
    arguments: Mapping[str, Any],
    of_episodes: Sequence[Any] | None = None,
    progress: Callable[[int], object] | None = None,
) -> Iterator[dict[str, NDArray[Any]]]:
    """The arrays of every episode, in order: from the cache, or measured now and kept.

    Args:
        what: the kind of numbers.
        selected: the episodes.
        selection: layers, denoise steps and heads.
        site: the softmax family.
        measure: gives the arrays of the episodes at these positions, one after the other, and reports its progress.
        arguments: what the numbers depend on besides the episode, the selection, the site and the keys that were taken
            out of the episode; JSON values.
        of_episodes: the same that differs between episodes.
        progress: called with the number of episodes that need not be measured.
    """
    axes = {"layers": selection.layers, "denoise": selection.denoise, "heads": selection.heads}
    question = CachedQuestion(
        what,
        {**arguments, **axes, "per_head": selection.per_head, "site": site},
    )
    own = of_episodes or [None] * len(selected)
    extra = [[item.without, one] for item, one in zip(selected, own, strict=True)]
    return remembered(question, [item.episode for item in selected], measure, extra, progress)
