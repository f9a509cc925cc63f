"""Stage two: from stored rows, without the model: masses, ratios, statistics, tables, plots. Never imports torch or mujoco.

For notebooks and programs there is `analyze.open`; see docs/python.md. Importing this package imports no library.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analyze.api import OpenStores

__all__ = ["open"]


def open(stores: str | Path | Sequence[str | Path]) -> OpenStores:
    """Open one store, or several that are analysed as one, and return what answers questions about them.

    >>> import analyze
    >>> run = analyze.open(store)
    >>> run.ratios().filter(layer="layers_avg")["scope"].to_list()
    ['task', 'task', 'all']

    Raises:
        StoreNotFound, StoreError: there is no store, or it cannot be read.
    """
    # Imported here: `vla-analyze --help` and `import analyze` must not wait for polars and zarr.
    from analyze.api import open_stores

    return open_stores(stores)
