"""The stores of a page: their episodes and their summaries."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from pathlib import Path

from vla_attention.analyze.view.summaries import Summary
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.root import episode_folders
from vla_attention.schemas.stores.store_format import StoreError


@dataclass
class ServedStore:
    """One store of the page.

    Attributes:
        store: as it was opened last.
        summary: what Python's analysis says of its episodes.
    """

    store: Store
    summary: Summary
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def refresh(self) -> None:
        """List the episodes of a store of this machine anew: a capture may add some while the page is open."""
        place = self.store.path
        if not isinstance(place, Path):
            return
        with self._lock:
            try:
                names = {folder.name for folder in episode_folders(place)}
                if names == {one.name for one in self.store.episodes}:
                    return
                self.store = open_store(place)
            except StoreError:  # moved away, or being replaced; the page says so when it reads
                return
            self.summary.begin(self.store)
