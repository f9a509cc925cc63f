"""How often the enrichment over its place finds an object that attention follows, and one that it does not.

Made-up first policy calls: pictures of 16 x 16 patches, an object of 2 x 2 patches near the middle that stands
elsewhere in every episode, and maps that are a blob in the middle with noise. In "own place" the blob's place differs
between episodes, independently of the object; in "follows" attention is doubled where the object is.

Usage: python benchmarks/spatial_control.py [--stores 200]
"""

from __future__ import annotations

import argparse
import warnings

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.core.object_maps import enrichment_on
from vla_attention.analyze.statistics.intervals import (
    POSITIVE,
    Interval,
    estimates,
    mean_over_episodes,
    ratio_of_means_over_episodes,
)
from vla_attention.analyze.statistics.units import Units

SIZE = 16
ROW, COLUMN = np.divmod(np.arange(SIZE**2), SIZE)
#: Name, episodes of a task, tasks, spread of the blob's place between episodes, how much the object attracts.
CASES = (
    ("fixed", 10, 1, 0.0, 0.0),
    ("fixed", 5, 1, 0.0, 0.0),
    ("own place", 10, 1, 1.0, 0.0),
    ("own place", 5, 1, 1.0, 0.0),
    ("own place", 5, 10, 1.0, 0.0),
    ("follows", 10, 1, 1.0, 1.0),
    ("follows", 5, 1, 1.0, 1.0),
    ("follows", 5, 10, 1.0, 1.0),
)


def covered(centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Areas (patch, 1) of a square of 2 x 2 patches with its centre (2,)."""
    sides = [np.clip(1.5 - abs(place + 0.5 - centre[axis]), 0.0, 1.0) for axis, place in enumerate((ROW, COLUMN))]
    return np.asarray(sides[0] * sides[1])[:, None]


def intervals_of_store(
    generator: np.random.Generator, episodes: int, tasks: int, spread: float, follow: float
) -> tuple[Interval | None, Interval | None]:
    """The intervals of the enrichment and of the enrichment over its place."""
    enrichment, elsewhere = [], []
    for _ in range(tasks):
        maps, areas, base = [], [], SIZE / 2 + generator.normal(0, 1.5, 2)
        for _ in range(episodes):
            area = covered(np.clip(base + generator.normal(0, 2.0, 2), 2, SIZE - 2))
            middle = (SIZE - 1) / 2 + generator.normal(0, spread, 2)
            blob = 0.2 + np.exp(-((ROW - middle[0]) ** 2 + (COLUMN - middle[1]) ** 2) / 18)
            own = blob * np.exp(generator.normal(0, 0.3, SIZE**2)) * (1 + follow * area[:, 0])
            maps.append(own / own.sum())
            areas.append(area)
        total = np.sum(areas, axis=0)
        pairs = list(zip(maps, areas, strict=True))
        enrichment += [enrichment_on(own, place, [SIZE**2])[0] for own, place in pairs]
        elsewhere += [enrichment_on(own, total - place, [SIZE**2])[0] for own, place in pairs]
    of_task = np.repeat(np.arange(tasks), episodes)
    statistics = [mean_over_episodes(enrichment, POSITIVE), ratio_of_means_over_episodes(enrichment, elsewhere)]
    plain, over = (one.interval() for one in estimates(statistics, Units.of(of_task)))
    return plain, over


def main() -> None:
    """Print a line per case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stores", type=int, default=200, help="made-up stores per case (default: 200)")
    stores = parser.parse_args().stores
    print("maps        episodes x tasks   plain interval above 1   over its place: holds 1   above 1")
    for name, episodes, tasks, spread, follow in CASES:
        generator = np.random.default_rng(0)
        found = [intervals_of_store(generator, episodes, tasks, spread, follow) for _ in range(stores)]
        plain = [interval.low > 1 for interval, _ in found if interval]
        holds = [interval.low <= 1 <= interval.high for _, interval in found if interval]
        above = [interval.low > 1 for _, interval in found if interval]
        shares = (f"{np.mean(values):>8.1%}" for values in (plain, holds, above))
        print(f"{name:<12}{episodes:>8} x {tasks:<8}" + "".join(f"{share:>20}" for share in shares), flush=True)


if __name__ == "__main__":
    warnings.simplefilter("error")
    main()
