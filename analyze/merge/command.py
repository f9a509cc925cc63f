"""Printing what `vla-attention copy A B --output C` made: one store of the episodes of several."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.stores.store_url import StorePlace


def merge(places: Sequence[StorePlace], target: Path, *, copy: bool, packed: bool) -> int:
    """Make one store of several, and print what it holds; returns the exit code."""
    from vla_attention.analyze.merge.merging import merge_stores
    from vla_attention.analyze.show.numbers import plural
    from vla_attention.schemas.progress_bar import progress_bar
    from vla_attention.schemas.stores.reader import open_store

    stores = [open_store(path) for path in places]
    with progress_bar(sum(len(store.episodes) for store in stores), "episodes") as advance:
        merged = merge_stores(stores, target, advance, link=not copy, packed=packed)
    parts = ", ".join(f"{len(store.episodes)} of {store.path}" for store in stores)
    shared = f"; {format_bytes(merged.linked_bytes)} are shared with the given stores" if merged.linked_bytes else ""
    print(f"{target}: {plural(merged.episodes, 'episode')} ({parts}), all whole{shared}.")
    return 0
