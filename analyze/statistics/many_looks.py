"""What may be said after many looks: adjusted p-values. Pure functions.

The largest of many estimates is large by selection too: among ten words that are read alike, one is always first.
`adjusted_p_values` bounds the expected share of false findings among those that are named (Benjamini & Hochberg 1995,
Journal of the Royal Statistical Society B 57).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: A name is printed when its p-value is at most this, divided by the number of names that a text could print.
NAMED_AT = 0.05
#: Of what is done and of the words that are read, wherever they are named: the screen of `language` names three kinds
#: of things, and `words` says of one table what it says. Also of outcomes and of parts of an episode, as several things
#: are compared at once (rates: benchmarks/README.md).
SHOWN_AT = NAMED_AT / 3


def adjusted_p_values(p_values: Sequence[float | None]) -> list[float | None]:
    """Benjamini-Hochberg q of every p (None stays None and does not count as a look).

    q_(i) = min over j >= i of p_(j) * n / j, with p sorted upwards. Naming all items with q <= 0.05 makes at most 5 %
    of the named ones false on average, for independent and for positively dependent p-values.
    """
    known = [i for i, p in enumerate(p_values) if p is not None]
    p = np.array([p_values[i] for i in known], dtype=np.float64)
    order = np.argsort(p, kind="stable")
    scaled = p[order] * len(p) / np.arange(1, len(p) + 1)
    adjusted = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    by_place: list[float | None] = [None] * len(p_values)
    for place, q in zip(order, adjusted, strict=True):
        by_place[known[place]] = float(q)
    return by_place


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's adjusted p-values (1979, Scandinavian Journal of Statistics 6): of all claims, none is false in 95 %."""
    order, adjusted, least = sorted(range(len(p_values)), key=p_values.__getitem__), [1.0] * len(p_values), 0.0
    for rank, place in enumerate(order):
        least = adjusted[place] = max(least, min(1.0, (len(order) - rank) * p_values[place]))
    return adjusted
