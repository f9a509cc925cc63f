"""The stores of a page: their episodes, their summaries, and the bytes of their files."""

from __future__ import annotations

import os
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vla_attention.analyze.view.summaries import Summary
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.remote_source import source_of
from vla_attention.schemas.stores.root import episode_folders
from vla_attention.schemas.stores.store_format import StoreError
from vla_attention.schemas.stores.store_url import StorePlace

#: Bytes of a file that are read at once.
_PIECE = 4_000_000


@dataclass
class ServedStore:
    """One store of the page.

    Attributes:
        store: as it was opened last.
        summary: what Python's analysis says of its episodes.
    """

    store: Store
    summary: Summary
    _sizes: dict[str, int] = field(default_factory=dict, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @property
    def place(self) -> StorePlace:
        """Where it is."""
        return self.store.path

    def refresh(self) -> None:
        """List the episodes of a store of this machine anew: a capture may add some while the page is open."""
        if not isinstance(self.place, Path):
            return
        with self._lock:
            try:
                names = {folder.name for folder in episode_folders(self.place)}
                if names == {one.name for one in self.store.episodes}:
                    return
                self.store = open_store(self.place)
            except StoreError:  # moved away, or being replaced; the page says so when it reads
                return
            self.summary.begin(self.store)

    def size(self, file: str) -> int:
        """Bytes of a file; raises `OSError` for what is no regular file of the store.

        Those of a file elsewhere are asked for once.
        """
        if isinstance(self.place, Path):
            # The folder may have got links that lead elsewhere, also while the page is open.
            path, place = os.path.realpath(self.place / file), os.path.realpath(self.place)
            if not path.startswith(f"{place}{os.sep}") or not os.path.isfile(path):
                raise FileNotFoundError(file)
            return os.stat(path).st_size
        if file not in self._sizes:
            self._sizes[file] = source_of(self.place).size(file)
        return self._sizes[file]

    def pieces(self, file: str, first: int, end: int) -> Iterator[bytes]:
        """The bytes [first, end) of a file, some megabytes at a time."""
        source = source_of(self.place)
        for at in range(first, end, _PIECE):
            yield source.part(file, at, min(_PIECE, end - at))


def stores_document(stores: Sequence[ServedStore], with_paths: bool = False) -> dict[str, Any]:
    """`stores.json`: what the page can show, and where it is, relative to the page.

    with_paths: also where the stores are on this machine, for commands to copy; sites of others do not say it.
    """
    counts = Counter(store.place.name for store in stores)
    return {
        "stores": [
            {
                "name": store.place.name if counts[store.place.name] == 1 else str(store.place),
                "root": f"stores/{number}/",
                "episodes": [{"name": episode.name} for episode in store.store.episodes],
                "summary": f"stores/{number}.summary.json",
                **({"path": str(store.place)} if with_paths else {}),
            }
            for number, store in enumerate(stores)
        ]
    }
