"""Progress at a terminal; quiet everywhere else."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

from vla_attention.schemas.safe_text import plain_stderr


@contextmanager
def progress_bar(total: int, unit: str, *, hidden: bool = False) -> Iterator[Callable[[int], object]]:
    """Yield a function that advances a bar. The bar is drawn at a terminal only, when the work takes over a second."""
    hidden = hidden or not sys.stderr.isatty()
    bar = tqdm(total=total, unit=f" {unit}", file=plain_stderr(), disable=hidden, delay=1.0, leave=False)
    try:
        yield bar.update
    finally:
        bar.close()
