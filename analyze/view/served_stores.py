"""The stores of a page: their episodes and their summaries."""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from vla_attention.analyze.view.summaries import Summary
from vla_attention.schemas.stores.outcomes import OUTCOMES_FILE
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.root import episode_folders
from vla_attention.schemas.stores.seal import SEAL_FILE
from vla_attention.schemas.stores.store_format import StoreError
from vla_attention.schemas.stores.store_url import local_path


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
    _states: dict[str, tuple[int, ...]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Keep in which state the files of the store were when it was opened."""
        self._states = self._look()

    def refresh(self) -> None:
        """Open a store of this machine anew if it is not as it was: captured further, again, or another one.

        An episode whose files are as they were stays the object that it was, so that what is known of it is kept.
        """
        if not isinstance(self.store.path, Path):
            return
        with self._lock:
            states = self._look()
            if states == self._states:
                return
            try:
                store = open_store(self.store.path)
            except StoreError:  # moved away, or being replaced; the page says so when it reads
                return
            known = {one: one for one in self.store.episodes if self._states.get(one.name) == states.get(one.name)}
            self.store = replace(store, episodes=tuple(known.get(one, one) for one in store.episodes))
            self._states = states
            self.summary.begin(self.store)

    def _look(self) -> dict[str, tuple[int, ...]]:
        """The state of the files that tell stores and episodes apart: root, outcomes, and every episode's seal."""
        place = self.store.path
        if not isinstance(place, Path):
            return {}
        files = {"": place / "zarr.json", OUTCOMES_FILE: place / OUTCOMES_FILE}
        with suppress(StoreError):
            files |= {folder.name: local_path(folder) / SEAL_FILE for folder in episode_folders(place)}
        found: dict[str, tuple[int, ...]] = {}
        for name, file in files.items():
            with suppress(OSError):
                about = file.stat()
                found[name] = (about.st_ino, about.st_mtime_ns, about.st_size)
        return found
